"""An arm of MIT-mode drives: one command and one answer for each axis and cycle, no other traffic."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from asc_rt.core.types import CommandKind
from drivers.base import Finding
from drivers.can import mit
from drivers.can.arm import Feedback, Heard, Joint, Power, Target, Wish
from drivers.can.bus_load import FrameSize
from drivers.can.dither import dithered
from drivers.can.frame import Frame
from drivers.can.link import Link

ANSWER_NS = 20_000_000  # for a register; a drive takes less than 1 ms
SCAN_IDS = range(1, 16)
RESET_LOOKS = 5
TIMEOUT_UNIT_NS = 50_000
MIT_MODE = 1


@dataclass(frozen=True, slots=True)
class MitAxis:
    motor: str  # of mit.MOTORS
    command_id: int
    answer_id: int
    kp: float  # Nm/rad and Nms/rad of positions and of every hold
    kd: float
    fine_kd: float  # Nms/rad of torques, see `_torque`: hardly a damping
    sign: int = 1
    zero: float = 0.0  # rad of the motor at joint zero
    firmware: tuple[int, ...] = ()  # versions that are known to be good; (): any

    @property
    def type(self) -> mit.MotorType:
        return mit.MOTORS[self.motor]


@dataclass(frozen=True, slots=True)
class MitArm:
    joints: tuple[Joint, ...]
    axes: tuple[MitAxis, ...]
    bitrate: float
    data_bitrate: float
    heartbeat_ns: int = 0
    kinds: frozenset[CommandKind] = frozenset(CommandKind)
    tells_brakes: bool = False

    @property
    def resolution(self) -> float:
        return max(axis.type.position for axis in self.axes) / 0xFFFF

    @property
    def is_fd(self) -> bool:
        return self.data_bitrate > 0.0

    def budget(self) -> list[FrameSize]:
        return [FrameSize(8, self.is_fd, self.is_fd)] * (2 * len(self.axes))

    # --- a cycle -----------------------------------------------------------------------------------------------------

    def encode(self, seq: int, targets: Sequence[Target], last: Sequence[Feedback | None]) -> list[Frame]:
        return [
            Frame(mit.REGISTER_ID, mit.refresh(axis.command_id), self.is_fd)
            if target.wish is Wish.LOOK
            else Frame(axis.command_id, self._command(seq, axis, target, told), self.is_fd)
            for axis, target, told in zip(self.axes, targets, last, strict=True)
        ]

    def _command(self, seq: int, axis: MitAxis, target: Target, told: Feedback | None) -> bytes:
        if target.wish is Wish.ENABLE and (told is None or told.power is not Power.ENABLED):
            return mit.special(mit.Special.ENABLE)
        if target.wish is Wish.DISABLE:
            return mit.special(mit.Special.DISABLE)
        q, dq, tau = axis.sign * target.q + axis.zero, axis.sign * target.dq, axis.sign * target.tau
        tau = min(max(tau, -axis.type.torque), axis.type.torque)
        if target.kind is CommandKind.TORQUE:
            return mit.encode(axis.type, _torque(axis, q, dq, tau, seq))
        kp = axis.kp if target.kind is CommandKind.POSITION else 0.0
        return mit.encode(axis.type, mit.SetPoint(q, dq, kp, axis.kd, tau))

    def encoded(self, frames: Sequence[Frame]) -> list[float]:
        """ProtocolError: a frame that is no set-point."""
        points = [mit.decode(axis.type, frame.data) for axis, frame in zip(self.axes, frames, strict=True)]
        return [axis.sign * (point.q - axis.zero) for axis, point in zip(self.axes, points, strict=True)]

    def decode(self, frame: Frame) -> tuple[int, Heard] | None:
        for i, axis in enumerate(self.axes):
            if frame.id == axis.answer_id:
                return i, self._feedback(axis, mit.decode_answer(axis.type, axis.command_id, frame.data))
        return None

    def _feedback(self, axis: MitAxis, answer: mit.Answer) -> Feedback:
        return Feedback(
            power=_POWER.get(answer.status, Power.FAULT),
            q=axis.sign * (answer.q - axis.zero),
            dq=axis.sign * answer.dq,
            tau=axis.sign * answer.tau,
            hottest_c=float(max(answer.power_stage_c, answer.coil_c)),
            warning=False,
            words=answer.status.name.replace("_", " ").lower(),
            dq_step=2.0 * axis.type.velocity / 0xFFF,
        )

    def leave(self) -> list[Frame]:
        """An axis without brake holds on with its last set-point: its watchdog would end that."""
        return [
            self._register(mit.write_register(axis.command_id, mit.Register.TIMEOUT, 0))
            for axis, joint in zip(self.axes, self.joints, strict=True)
            if not joint.has_brake
        ]

    # --- start-up ----------------------------------------------------------------------------------------------------

    def start_up(self, link: Link, period_ns: int, serials: Sequence[int]) -> Iterator[Finding]:
        yield self._scan(link)
        for i, axis in enumerate(self.axes):
            yield from self._examine(link, i, axis, serials)

    def guard(self, link: Link, i: int, watchdog_ns: int) -> Finding:
        wanted, node = watchdog_ns // TIMEOUT_UNIT_NS, self.axes[i].command_id
        link.send([self._register(mit.write_register(node, mit.Register.TIMEOUT, wanted))])
        self._collect(link, node, mit.Register.TIMEOUT)
        told = [value for _, _, value in self._ask(link, node, mit.Register.TIMEOUT)]
        detail = f"{told} x 50 us, expected {wanted}"
        fix = "the drive does not take its time-out: do not use it"
        return Finding(f"axis {i + 1} watchdog", told == [wanted], detail, fix)

    def reset(self, link: Link, i: int) -> Finding:
        axis = self.axes[i]
        link.send([Frame(axis.command_id, mit.special(mit.Special.CLEAR_ERROR), self.is_fd)])
        told: Feedback | None = None
        for _ in range(RESET_LOOKS):  # a cause that is still there trips it again
            link.send([Frame(mit.REGISTER_ID, mit.refresh(axis.command_id), self.is_fd)])
            deadline_ns = link.now_ns() + ANSWER_NS
            while (frame := link.receive(deadline_ns)) is not None:
                heard = self.decode(frame)
                told = heard[1] if heard is not None and heard[0] == i and isinstance(heard[1], Feedback) else told
        words = told.words if told else "silent"
        ok = told is not None and told.power is Power.DISABLED
        fix = "the cause is not over; if the drive is enabled, switch its power off"
        return Finding(f"axis {i + 1} reset", ok, f"it is {words}", fix)

    def assign(self, link: Link, number: int) -> Finding:
        fix = "set CAN ID and master ID with the maker's tool, this drive alone on the bus"
        return Finding("number", False, "these drives take no number over this bus", fix)

    def _scan(self, link: Link) -> Finding:
        """Reads a register of every identifier: nothing is enabled, as by an enable frame used as a ping."""
        wanted = {axis.command_id: axis.answer_id for axis in self.axes}
        wrong = []
        for node in SCAN_IDS:
            found = [frame.id for frame, _, _ in self._ask(link, node, mit.Register.ANSWER_ID)]
            expected = [wanted[node]] if node in wanted else []
            if found != expected:
                wrong.append(f"identifier {node}: answered by {_ids(found)}, expected {_ids(expected)}")
        detail = "; ".join(wrong) or f"{len(wanted)} drives, one answer each"
        return Finding("scan", not wrong, detail, "check power, cabling and that no two drives have one identifier")

    def _examine(self, link: Link, i: int, axis: MitAxis, serials: Sequence[int]) -> Iterator[Finding]:
        name = f"axis {i + 1}"

        def read(register: mit.Register) -> float | None:
            told = self._ask(link, axis.command_id, register)
            return told[0][2] if len(told) == 1 else None

        if serials:
            serial = read(mit.Register.SERIAL)
            fix = "this is another drive than in driver.serials: check its zero, then enter its number"
            yield Finding(f"{name} identity", serial == serials[i], f"serial {serial}, expected {serials[i]}", fix)
        firmware = read(mit.Register.FIRMWARE)
        known = firmware is not None and (not axis.firmware or int(firmware) in axis.firmware)
        fix = f"known good: {axis.firmware}; flash one of these, or extend the arm's list after a test on the bench"
        yield Finding(f"{name} firmware", known, f"version {firmware}", fix)
        mode = read(mit.Register.CONTROL_MODE)
        yield Finding(f"{name} mode", mode == MIT_MODE, f"control mode {mode}", "set control mode 1 (MIT) in the drive")
        yield _spans(name, axis.type, read)

    def _ask(self, link: Link, node: int, register: mit.Register) -> list[tuple[Frame, mit.Register, float]]:
        link.send([self._register(mit.read_register(node, register))])
        return self._collect(link, node, register)

    def _collect(self, link: Link, node: int, register: mit.Register) -> list[tuple[Frame, mit.Register, float]]:
        """Every answer, so that a second drive of the same identifier is seen; the last wait is short."""
        found: list[tuple[Frame, mit.Register, float]] = []
        deadline_ns = link.now_ns() + ANSWER_NS
        while (frame := link.receive(deadline_ns)) is not None:
            told = mit.decode_register(node, frame.data)
            if told is not None and told[0] is register:
                found.append((frame, *told))
                deadline_ns = min(deadline_ns, link.now_ns() + 1_000_000)
        return found

    def _register(self, data: bytes) -> Frame:
        return Frame(mit.REGISTER_ID, data, self.is_fd)


def _torque(axis: MitAxis, q: float, dq: float, tau: float, seq: int) -> mit.SetPoint:
    """tau = coarse + kd (v - dq).

    A step of the torque's code is 7 rad/s2 of a light wrist, far too much to hold a pose. What it leaves is said by a
    speed v beside the one that is expected, through so small a kd that a step of v is a hundredth of it."""
    step, fine = 2.0 * axis.type.torque / 0xFFF, 2.0 * axis.type.velocity / 0xFFF
    coarse = step * round((tau + axis.type.torque) / step) - axis.type.torque
    v = dithered(dq + (tau - coarse) / axis.fine_kd, fine, -axis.type.velocity, seq)
    v = min(max(v, -axis.type.velocity), axis.type.velocity)
    return mit.SetPoint(q, v, 0.0, axis.fine_kd, min(max(coarse, -axis.type.torque), axis.type.torque))


_POWER = {
    mit.DriveStatus.DISABLED: Power.DISABLED,
    mit.DriveStatus.ENABLED: Power.ENABLED,
    mit.DriveStatus.UNDER_VOLTAGE: Power.NO_VOLTAGE,
}


def _spans(name: str, motor: mit.MotorType, read: Callable[[mit.Register], float | None]) -> Finding:
    """The drive's ranges equal ours to the bit: a wrong one is a silent gain."""
    wanted = (motor.position, motor.velocity, motor.torque)
    registers = (mit.Register.POSITION_SPAN, mit.Register.VELOCITY_SPAN, mit.Register.TORQUE_SPAN)
    told = tuple(read(register) for register in registers)
    ok = None not in told and struct.pack("<3f", *told) == struct.pack("<3f", *wanted)
    return Finding(f"{name} scale", ok, f"ranges {told}, expected {wanted}", "set PMAX, VMAX, TMAX of the drive")


def _ids(ids: list[int]) -> str:
    return ", ".join(f"{i:03X}h" for i in ids) or "nobody"
