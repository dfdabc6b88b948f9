"""Frames of all cameras and the arm's joints -> HumanState messages. Pure: no clock, no bus, no camera.

| what is there                                   | what is told                                                     |
| ----------------------------------------------- | ---------------------------------------------------------------- |
| all cameras in order, joints at the capture     | OK; no capsule means that nobody is there                        |
| a camera lost, another one in order             | DEGRADED, the coverage of what is left; the unseen grows         |
| the arm near a side of the guarded volume       | DEGRADED: who stands outside is nearer than `Identity.around`    |
| no camera in order, or no joints at the capture | FAULT: with joints, where people may have come to; else nothing  |

`health_bits` are the faults of all cameras (`CameraFault`), NO_JOINTS and UNWATCHED.
"""

from __future__ import annotations

import functools
import operator
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from asc_rt import human_state_pb2 as pb
from asc_rt.core.types import MAX_CAPSULES, Vector
from asc_rt.human_codec import FRAME, SCHEMA_VERSION
from asc_rt.perception.arm import JointHistory
from asc_rt.perception.eye import Eye
from asc_rt.perception.observer import Observer, Seen
from asc_rt.perception.pose.added import POSE_BODY, added
from asc_rt.perception.pose.limbs import Found
from asc_rt.perception.volume import REACH_SPEED
from drivers.cameras.base import Depth, DepthFrame
from drivers.cameras.watch import CameraFault

NO_JOINTS, UNWATCHED = 32, 64
ENTRY_S = 0.1  # s in which somebody who comes in is told: photon to command 104 ms in 99 %. MEASURED
SAME_NS = 1_000_000  # captures nearer than this are one; at 2 m/s that is 2 mm
BLIND_PERIODS = 2.5  # without any capture, after which the blind growth is told

Stamp = Callable[[int], tuple[int, int] | None]  # ours -> (the cell's, how far it may be off), ns; None: not known


@dataclass(frozen=True, slots=True)
class Identity:
    """What stays the same in all messages of a sensor."""

    id: int
    calibration: bytes  # 32, of all its cameras
    margin: float  # m
    detection: float  # m
    around: float  # m: nobody nearer to the arm may go unseen
    capsules: int = MAX_CAPSULES  # at most, its share of what control takes


def around(activation: float) -> float:
    """m: who is farther from the arm at a capture is not within `activation` (m) when control hears of it."""
    return activation + REACH_SPEED * ENTRY_S


@dataclass(slots=True)
class Capture:
    t_ns: int
    sigma_ns: int
    depths: list[Depth | None]


class Sensor:
    """`take` the frames as they come, `wait` when none do; each gives the messages to send."""

    def __init__(
        self, identity: Identity, eyes: Sequence[Eye], observer: Observer, clock: Callable[[], str], stamp: Stamp,
        limbs: Callable[[], Sequence[Found]] = tuple,
    ) -> None:  # fmt: skip
        """`clock`: name of the cell's clock; `stamp`: ours in its time; `limbs`: the newest of a pose estimator."""
        self.joints = JointHistory()  # stamped by the cell's clock
        self.eyes = tuple(eyes)
        self.observer = observer
        self._identity, self._clock, self._stamp, self._limbs = identity, clock, stamp, limbs
        self._session, self._seq, self._t_ns = str(uuid.uuid4()), 0, 0
        self._period_ns = min(eye.info.period_ns for eye in eyes)

    def take(self, frames: Mapping[int, DepthFrame], now_ns: int) -> list[bytes]:
        """`frames`: the newest of the cameras of these numbers."""
        messages = []
        for capture in self._captures(frames):
            if capture.t_ns <= self._t_ns:
                continue  # too late: what came after it is told already; its camera will be SILENT
            for eye, depth in zip(self.eyes, capture.depths, strict=True):
                if depth is not None:
                    eye.used(now_ns)
            messages.append(self._observe(capture, now_ns))
        return [message for message in messages if message] + self.wait(now_ns)

    def wait(self, now_ns: int) -> list[bytes]:
        """Time passes; without a camera for long, it is told where people may be now."""
        for eye in self.eyes:
            eye.wait(now_ns)
        if now_ns - self._t_ns <= BLIND_PERIODS * self._period_ns + self._latency_ns:
            return []
        message = self._observe(Capture(now_ns, 0, [None] * len(self.eyes)), now_ns)
        return [message] if message else []

    @property
    def fault(self) -> CameraFault:
        """Of all cameras."""
        return functools.reduce(operator.or_, (eye.fault for eye in self.eyes))

    @property
    def _latency_ns(self) -> int:
        return max(eye.info.latency_ns for eye in self.eyes)

    def _captures(self, frames: Mapping[int, DepthFrame]) -> list[Capture]:
        """In order of time; cameras that look at the same moment are one capture."""
        seen = [(frame, i, self.eyes[i].look(frame)) for i, frame in frames.items()]
        captures: list[Capture] = []
        for frame, i, depth in sorted(seen, key=lambda one: one[0].t_capture_ns):
            if depth is None:
                continue
            if not captures or frame.t_capture_ns - captures[-1].t_ns > SAME_NS:
                captures.append(Capture(frame.t_capture_ns, 0, [None] * len(self.eyes)))
            captures[-1].depths[i] = depth
            captures[-1].sigma_ns = max(captures[-1].sigma_ns, frame.t_capture_sigma_ns)
        return captures

    def _observe(self, capture: Capture, now_ns: int) -> bytes | None:
        """None: the cell's clock is not known, so nothing can be stamped."""
        stamped = self._stamp(capture.t_ns)
        if stamped is None:
            return None
        self._t_ns = capture.t_ns
        offset_ns = next((e.offset_ns for e, d in zip(self.eyes, capture.depths, strict=True) if d is not None), 0)
        q = self.joints.at(stamped[0] + offset_ns)
        seen = None if q is None else self.observer.observe(capture.t_ns, capture.depths, q)
        self._seq += 1
        bits = int(self.fault) | (NO_JOINTS if seen is None else UNWATCHED * (seen.around < self._identity.around))
        health = self._health(seen, bits)
        blind = all(depth is None for depth in capture.depths)
        message = pb.HumanState(
            schema_version=SCHEMA_VERSION,
            sensor_id=self._identity.id,
            session_uuid=self._session,
            seq=self._seq,
            clock_id=self._clock(),
            t_capture_ns=stamped[0],
            t_capture_sigma_ns=capture.sigma_ns + stamped[1],
            t_publish_ns=stamped[0] + now_ns - capture.t_ns,
            frame_id=FRAME,
            calibration_hash=self._identity.calibration,
            method=pb.METHOD_DEPTH,
            safety_rated=False,
            health=health,
            health_bits=bits,
            coverage=self.observer.coverage([eye.is_believed for eye in self.eyes]),
            blind_margin_m=self._identity.margin,
            detection_capability_m=self._identity.detection,
            bodies=[] if seen is None else [_body(seen, pb.PREDICTED if blind else pb.OBSERVED)],
            empty_certified=health == pb.HEALTH_OK,
        )
        if q is not None and seen is not None and (limbs := self._added(seen, q)):
            message.bodies.append(pb.Body(id=POSE_BODY, capsules=limbs))
            message.method = pb.METHOD_FUSED
        data: bytes = message.SerializeToString()
        return data

    def _added(self, seen: Seen, q: Vector) -> list[pb.Capsule]:
        """All else that is told is as without them."""
        believed = [one for one in self._limbs() if self.eyes[one.camera].is_believed]
        room = self._identity.capsules - len(seen.parts.radius)
        return added(believed, seen, room, lambda points: self.observer.to_arm(points, q))

    def _health(self, seen: Seen | None, bits: int) -> pb.Health:
        if seen is None or not any(eye.is_believed for eye in self.eyes):
            return pb.HEALTH_FAULT
        return pb.HEALTH_DEGRADED if bits else pb.HEALTH_OK


def _body(seen: Seen, visibility: pb.Visibility) -> pb.Body:
    p = seen.parts
    rows = zip(*(array.tolist() for array in (p.p0, p.p1, p.radius, p.velocity, p.velocity_bound)), strict=True)
    return pb.Body(
        id=1,
        capsules=[
            pb.Capsule(
                label=f"part{i}",
                p0=p0,
                p1=p1,
                radius=max(radius, LEAST_RADIUS),
                v0=velocity,
                v1=velocity,
                position_bound=seen.position_bound,
                velocity_bound=bound,
                visibility=visibility,
            )
            for i, (p0, p1, radius, velocity, bound) in enumerate(rows)
        ],
    )


LEAST_RADIUS = 1e-6  # m: a message may hold no capsule without one; a single voxel has it in its bound
