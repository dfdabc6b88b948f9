"""What viewers that know nothing of us draw: the arm as URDF with moving frames, its joints as plots, the modes as log
lines. Foxglove's messages are protobuf; the other two must be ROS 2 CDR to be recognised.
"""

from __future__ import annotations

import math
import operator
import struct
import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from asc_rt.core.params import Params
from asc_rt.core.types import Mode, StopReason
from asc_rt.fixed_protobuf import Buffer
from asc_rt.record import RecordLayout
from logs import schema
from logs.log_file import LogFile

PERIOD_NS = 33_000_000  # smooth to the eye; every cycle is in the cycle channel
Quaternion = tuple[float, float, float, float]  # x, y, z, w

_CDR = b"\x00\x01\x00\x00"  # little-endian
_LEVELS = {Mode.STOPPING: "WARNING", Mode.STOPPED: "WARNING", Mode.FAULT: "ERROR"}


@dataclass(frozen=True, slots=True)
class Frame:
    """One joint of the URDF: where the child is in the parent, and the axis it turns about (unit, in the child)."""

    joint: str
    parent: str
    child: str
    translation: tuple[float, float, float]  # m
    rotation: Quaternion  # at joint angle 0
    axis: tuple[float, float, float]


def frames(urdf: str) -> list[Frame]:
    """All joints of a URDF whose moving joints turn."""
    found = []
    for joint in ET.fromstring(urdf).iter("joint"):
        ends = joint.find("parent"), joint.find("child")
        if ends[0] is None or ends[1] is None:
            continue  # a joint of a transmission or a mimic
        origin, axis = joint.find("origin"), joint.find("axis")
        xyz, rpy = (_triple(origin, key, "0 0 0") for key in ("xyz", "rpy"))
        turn = _triple(axis, "xyz", "1 0 0")
        length = math.hypot(*turn)
        unit = (turn[0] / length, turn[1] / length, turn[2] / length)
        name = joint.get("name", "")
        found.append(Frame(name, ends[0].get("link", ""), ends[1].get("link", ""), xyz, _from_rpy(*rpy), unit))
    return found


def _triple(element: ET.Element | None, key: str, default: str) -> tuple[float, float, float]:
    x, y, z = map(float, (element.get(key, default) if element is not None else default).split())
    return x, y, z


def _from_rpy(roll: float, pitch: float, yaw: float) -> Quaternion:
    x, y, z = (about(axis, angle) for axis, angle in (((1, 0, 0), roll), ((0, 1, 0), pitch), ((0, 0, 1), yaw)))
    return product(z, product(y, x))


def about(axis: Sequence[float], angle: float) -> Quaternion:
    s = math.sin(angle / 2)
    return axis[0] * s, axis[1] * s, axis[2] * s, math.cos(angle / 2)


def product(a: Quaternion, b: Quaternion) -> Quaternion:
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


class Display:
    """Writes the drawn channels of one session; `begin` for each of its files."""

    def __init__(self, params: Params, layout: RecordLayout) -> None:
        self._robot, self._dtype = params.robot, layout.dtype
        self._frames = frames(params.robot.urdf)
        self._index = {name: i for i, name in enumerate(params.robot.joints)}
        places = [layout.dtype.fields[path][1] for path in ("state.mode", "state.reason")]  # type: ignore[index]
        self._said_in: Callable[[Buffer], tuple[int, int]] = operator.itemgetter(*places)
        self._said = (-1, -1)
        self._next_ns = 0
        self._names = _cdr_strings(params.robot.joints)
        self._transforms = schema.FrameTransforms()
        for frame in self._frames:
            made = self._transforms.transforms.add(parent_frame_id=frame.parent, child_frame_id=frame.child)
            made.translation.x, made.translation.y, made.translation.z = frame.translation

    def begin(self, log: LogFile, t_ns: int) -> None:
        """The robot itself. Shapes of primitives are in the text; meshes are found where the URDF says."""
        text = self._robot.urdf.encode() + b"\0"
        log.message(schema.ROBOT_DESCRIPTION, t_ns, _CDR + struct.pack("<I", len(text)) + text)

    def cycle(self, log: LogFile, t_ns: int, record: Buffer) -> None:
        said = self._said_in(record)
        if said != self._said:
            self._tell(log, t_ns, said)
        if t_ns < self._next_ns:
            return
        self._next_ns = t_ns + PERIOD_NS
        row = np.frombuffer(record, self._dtype)[0]
        present = bool(row["inputs.joint.present"])
        q = row["inputs.joint.q" if present else "state.q_cmd"].tolist()
        dq = row["inputs.joint.dq" if present else "state.dq_cmd"].tolist()
        effort = row["inputs.joint.current"].tolist() if present else [0.0] * len(q)
        wall_ns = log.wall_ns(t_ns)
        log.message(schema.JOINT_STATES, t_ns, self._joint_state(wall_ns, q, dq, effort))
        log.message(schema.TRANSFORMS, t_ns, self._pose(wall_ns, q))

    def _tell(self, log: LogFile, t_ns: int, said: tuple[int, int]) -> None:
        mode, reason = Mode(said[0]), StopReason(said[1])
        before = f"{Mode(self._said[0]).name} -> " if self._said[0] >= 0 else ""
        because = f" ({reason.name})" if reason else ""
        level = _LEVELS.get(mode, "INFO")
        log.message(schema.LOG, t_ns, schema.log_message(log.wall_ns(t_ns), level, f"{before}{mode.name}{because}"))
        self._said = said

    def _joint_state(self, wall_ns: int, *columns: list[float]) -> bytes:
        """sensor_msgs/JointState: header, names, then position, velocity and effort (here: motor current)."""
        data = bytearray(_CDR + struct.pack("<iI", *divmod(wall_ns, 1_000_000_000)) + _cdr_string("base"))
        _align(data, 4)
        data += self._names
        for column in columns:
            _align(data, 4)
            data += struct.pack("<I", len(column))
            _align(data, 8)
            data += struct.pack(f"<{len(column)}d", *column)
        return bytes(data)

    def _pose(self, wall_ns: int, q: list[float]) -> bytes:
        for frame, transform in zip(self._frames, self._transforms.transforms, strict=True):
            transform.timestamp.FromNanoseconds(wall_ns)
            i = self._index.get(frame.joint)
            turned = frame.rotation if i is None else product(frame.rotation, about(frame.axis, q[i]))
            to = transform.rotation
            to.x, to.y, to.z, to.w = turned
        data: bytes = self._transforms.SerializeToString()
        return data


def _cdr_string(text: str) -> bytes:
    data = text.encode() + b"\0"
    return struct.pack("<I", len(data)) + data


def _cdr_strings(names: Sequence[str]) -> bytes:
    """A sequence of strings, each beginning at a multiple of 4."""
    data = bytearray(struct.pack("<I", len(names)))
    for name in names:
        data += bytes(-len(data) % 4) + _cdr_string(name)
    return bytes(data)


def _align(data: bytearray, size: int) -> None:
    """Alignment counts from the end of the encapsulation header."""
    data += bytes(-(len(data) - len(_CDR)) % size)
