"""An arm whose drives are on CAN. Driver `can`: torque, velocity or position, at this PC's pace."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from enum import Enum, auto
from typing import Any

import numpy as np

from asc_rt.core.types import JointCommand, JointState, RobotFlag, StopRequest, Vector, vector
from drivers.base import (
    DriverCaps,
    DriverError,
    Dynamics,
    Finding,
    HandshakeError,
    LinkError,
    Pacing,
    ProtocolError,
    RobotFaulted,
    WireTap,
    WriteReceipt,
)
from drivers.can import bus_load, export, home, service, start_up
from drivers.can.arm import Feedback, Power, Target
from drivers.can.arms import ARMS
from drivers.can.cia402 import PowerState
from drivers.can.frame import bundle, unbundle
from drivers.can.leave import come_to_rest, leave, stop_path
from drivers.can.link import Clock, Link, Open, opener
from drivers.can.options import Options
from drivers.can.reactions import Fault
from drivers.can.stopping import StopPath
from drivers.can.stream import Stream, move
from drivers.can.watch import URAD
from drivers.owner import OwnerLock

# What every axis tells while commands are recorded: with another state the frames would be others.
_IN_MOTION = Feedback(Power.ENABLED, 0.0, 0.0, 0.0, None, False, "enabled", raw=PowerState.OPERATION_ENABLED.value[1])


class Phase(Enum):
    CLOSED = auto()
    CONFIGURED = auto()
    ACTIVE = auto()


def no_weight(q: Vector, dq: Vector, ddq: Vector) -> Vector:
    return vector(np.zeros_like(q))


class Can:
    """Errors: LinkError, HandshakeError, ProtocolError, RobotFaulted, OwnershipError.

    `dynamics` tells the torque that a motion needs; without it an arm that the drives' own gains cannot carry sags.
    """

    def __init__(
        self,
        options: dict[str, Any],
        tap: WireTap | None = None,
        open_bus: Open | None = None,
        clock: Clock | None = None,
    ) -> None:
        self._options = o = Options.parse(options)
        self._codec = ARMS[o.arm]
        self.dynamics: Dynamics = no_weight
        self.fault: RobotFaulted | None = None
        self.checklist: list[Finding] = []
        is_fd = self._codec.data_bitrate > 0.0
        more = {} if clock is None else {"clock": clock}
        self._link = Link(open_bus or opener(o.interface, o.channel, is_fd), **more)
        self._lock = OwnerLock(f"can-{o.interface}-{o.channel}", o.lock_dir)
        self._tap = tap
        self._phase = Phase.CLOSED
        self._stream = self._new_stream()
        self._load = 0.0
        self._fresh = False  # a command has gone since the last sample
        self._brake: tuple[StopPath, int] | None = None  # since when, while the core has nothing to say

    def _new_stream(self) -> Stream:
        o = self._options
        return Stream(self._link, self._codec, o.period_ns, round(o.stale_ms * 1e6), self._tap)

    # --- life --------------------------------------------------------------------------------------------------------

    def configure(self) -> DriverCaps:
        if self._phase is Phase.ACTIVE:
            self.stop()
        self._lock.acquire()
        self.checklist = list(self._examine(self._options.period_ns))
        if failed := [line for line in self.checklist if not line.ok]:
            self._link.close()
            self._lock.release()
            told = "; ".join(f"{line.name}: {line.detail}" for line in failed)
            error = LinkError if failed[0].name == start_up.BUS else HandshakeError
            raise error(f"start-up refused: {told}", hint=failed[0].fix)
        self._phase = Phase.CONFIGURED
        return DriverCaps(
            dof=len(self._codec.joints),
            pacing=Pacing.HOST,
            kinds=self._codec.kinds,
            period_ns=self._options.period_ns,
            reach=(vector([j.q_min for j in self._codec.joints]), vector([j.q_max for j in self._codec.joints])),
            identity=f"{self._options.arm} on {self._options.interface} {self._options.channel}",
        )

    def examine(self, period_ns: int) -> Iterator[Finding]:
        """The start-up checklist as far as nothing is enabled by it."""
        yield from self._alone(self._examine(period_ns))

    def drives(self, period_ns: int) -> Iterator[Finding]:
        """See `drivers.base.Serviceable`."""
        yield from self._alone(service.tell(self._link, self._codec, self._options, period_ns))

    def reset(self, period_ns: int, axes: Sequence[int], supported: bool) -> Iterator[Finding]:
        """See `drivers.base.Serviceable`."""
        n = len(self._codec.joints)
        if wrong := [axis for axis in axes if not 1 <= axis <= n]:
            yield Finding("axis", False, f"{wrong} of {n}", f"axes count from 1 to {n}")
            return
        which = [axis - 1 for axis in axes]
        yield from self._alone(service.reset(self._link, self._codec, self._options, period_ns, which, supported))

    def assign(self, number: int) -> Iterator[Finding]:
        """See `drivers.base.Serviceable`."""
        yield from self._alone(service.assign(self._link, self._codec, self._options, number))

    def _alone(self, lines: Iterator[Finding]) -> Iterator[Finding]:
        """On a bus of which nobody else on this machine is the master."""
        try:
            self._lock.acquire()
            yield from lines
        except DriverError as error:
            yield Finding("owner", False, str(error), error.hint)
        finally:
            self.close()

    def _examine(self, period_ns: int) -> Iterator[Finding]:
        self._link.close()
        return start_up.examine(self._link, self._codec, self._options, period_ns)

    def activate(self, period_ns: int) -> JointState:
        if self._phase is not Phase.CONFIGURED:
            raise LinkError("the drives are not configured", hint="configure() comes before activate()")
        if period_ns != self._options.period_ns:
            raise HandshakeError(
                f"the driver's period is {self._options.period_ms:g} ms, the cell's {period_ns * 1e-6:g} ms",
                hint="make the cell's period_ms and driver.period_ms equal",
            )
        try:
            self._load = bus_load.check(
                self._codec.budget(), period_ns * 1e-9, self._codec.bitrate, self._codec.data_bitrate
            )
        except bus_load.BusOverload as error:
            raise HandshakeError(str(error), hint="a longer period_ms, fewer axes on this bus, or CAN FD") from error
        self.fault, self._stream = None, self._new_stream()
        self._phase = Phase.ACTIVE
        try:
            self.checklist += start_up.enable(self._stream, self._options, self.dynamics)
        except DriverError:
            self.stop()
            raise
        home.begin(self._options.home)
        self._fresh, self._brake = False, None
        self._stream.pause()
        return self._sample()

    def stop(self, request: StopRequest | None = None) -> None:
        """Coordinated stop, hold, and leave: see `leave`."""
        if self._phase is not Phase.ACTIVE:
            return
        self._phase = Phase.CONFIGURED
        stream = self._stream
        with suppress(DriverError, ValueError):
            if not stream.is_cut and stream.has_spoken:
                come_to_rest(stream, self.dynamics)
                leave(stream, self.dynamics)
            if not stream.found and stream.has_spoken:
                home.end(self._options.home, stream.pose()[0])
        self._blame()

    def close(self) -> None:
        self.stop()
        self._phase = Phase.CLOSED
        self._link.close()
        self._lock.release()

    # --- a cycle -----------------------------------------------------------------------------------------------------

    def read(self, deadline_ns: int) -> JointState | None:
        """None: no axis answered this cycle. RobotFaulted: nothing can be said on the bus any more."""
        stream = self._active()
        if not self._fresh:  # the core had nothing to say: the drives must not hear silence, nor the old torque again
            stream.send(self._braking())
        self._fresh = False
        stream.collect(deadline_ns)
        if stream.is_cut:
            self._blame()
            assert self.fault is not None
            raise self.fault
        if not stream.found and all(missed > 0 for missed in stream.missed):
            return None
        return self._sample()

    def write(self, command: JointCommand) -> WriteReceipt:
        stream = self._active()
        t_ns, frames, taken = stream.send(self._targets(command))
        self._fresh, self._brake = True, None
        said = zip(self._codec.encoded(frames), command.q, strict=True)
        return WriteReceipt(t_ns, stream.seq, vector([q if sent is None else sent for sent, q in said]), taken)

    def _braking(self) -> list[Target]:
        """The coordinated stop from the last set-point on, as long as the core says nothing."""
        stream = self._stream
        if self._brake is None:
            q, dq = (np.array([getattr(target, name) for target in stream.targets]) for name in ("q", "dq"))
            self._brake = stop_path(stream, q, dq), stream.link.now_ns()
        path, begin_ns = self._brake
        q, dq, ddq = path.at((stream.link.now_ns() - begin_ns) * 1e-9)
        targets = move(q, dq, self.dynamics(q, dq, ddq))  # in the mode that is running: a change would be a jerk
        return [replace(target, kind=last.kind) for target, last in zip(targets, stream.targets, strict=True)]

    def _targets(self, command: JointCommand) -> list[Target]:
        values = np.concatenate((command.q, command.dq, command.tau))
        if len(values) != 3 * len(self._codec.joints) or not np.isfinite(values).all():
            raise ValueError("the drives take finite numbers only, one for each joint")
        rows = zip(command.q, command.dq, command.tau, strict=True)
        return [Target(command.kind, float(q), float(dq), float(tau)) for q, dq, tau in rows]

    def _sample(self) -> JointState:
        stream = self._stream
        q, dq, tau = stream.pose()
        flags = RobotFlag.READY | RobotFlag.SERVO_ON
        if stream.asks_to_slow:
            flags |= RobotFlag.WARM
        if stream.found:
            flags = RobotFlag.FAULTED
            if any(found.fault is Fault.NO_VOLTAGE for found in stream.found):
                flags |= RobotFlag.EMERGENCY_STOP
        return JointState(
            t_rx_ns=stream.t_rx_ns,
            t_device_ns=0,  # these drives tell no time
            seq=stream.seq,
            q=q,
            dq=dq,
            current=tau,
            flags=flags,
            tool_id=0,
            dq_is_estimated=True,
        )

    def _active(self) -> Stream:
        if self._phase is not Phase.ACTIVE:
            raise LinkError("the drives are not active", hint="activate() comes before read() and write()")
        return self._stream

    def _blame(self) -> None:
        """The first of the worst: later faults mostly follow from it."""
        if self._stream.found and self.fault is None:
            first = max(self._stream.found, key=lambda found: found.rule.reaction.value)
            self.fault = RobotFaulted(str(first), hint=first.rule.do)

    # --- for the record and the report -------------------------------------------------------------------------------

    def report(self) -> dict[str, Any]:
        """What the session cost and met; JSON-able."""
        return {
            "bus_load": round(self._load, 4),
            **asdict(self._stream.counters),
            "faults": [str(found) for found in self._stream.found],
            "checklist": [f"{'ok' if line.ok else 'FAIL'} {line.name}: {line.detail}" for line in self.checklist],
        }

    @property
    def resolution(self) -> float:
        return self._codec.resolution

    def export(self, packets: Iterable[tuple[str, int, bytes]], path: str) -> int:
        """See `drivers.base.Exportable`."""
        if not path.endswith(export.FORMATS):
            raise ValueError(f"{path}: a CAN log ends in {', '.join(export.FORMATS)}")
        return export.write(packets, path, self._options.channel)

    def decode_sample(self, data: bytes) -> tuple[int, Vector, Vector] | None:
        """Of a bundle of every axis' newest answer."""
        seq, _, carried, frames = unbundle(data)
        if len(frames) != len(self._codec.joints):
            return None
        told: dict[int, Feedback] = {}
        for frame in frames:
            heard = self._codec.decode(frame)
            if heard is not None and isinstance(heard[1], Feedback):
                told[heard[0]] = heard[1]
        if len(told) != len(frames):
            raise ProtocolError("a sample without an answer of every axis")
        q = [told[i].q + URAD * on for i, on in enumerate(carried)]
        return seq, vector(q), vector([told[i].tau for i in range(len(told))])

    def encode_command(self, seq: int, command: JointCommand) -> bytes:
        return bundle(seq, self._codec.encode(seq, self._targets(command), [_IN_MOTION] * len(self._codec.joints)))
