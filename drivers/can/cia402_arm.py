"""An arm of CiA 402 drives on CANopen: RPDOs, then SYNC; each drive answers the SYNC with its TPDO.

RPDO2 = controlword, mode of operation, torque offset goes in every cycle; with it goes RPDO1 = controlword, target
position, torque offset where a position is commanded, RPDO3 = target velocity where a velocity is. All are taken over
at the SYNC, so that mode and target change together. The torque offset 60B2h is the feed-forward of positions and
velocities and, with a target torque of 0, the whole torque of the torque mode. Our heartbeat goes with every BEAT-th
cycle. While axes are enabled or braked one of them a cycle is told what its brake has to do (60FEh), or asked what the
contact of the brake tells (60FDh), in turn and by service data.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from canopen import SdoCommunicationError
from canopen.sdo.exceptions import SdoError

from asc_rt.core.types import CommandKind
from drivers.base import Finding, ProtocolError
from drivers.can import cia402, lss
from drivers.can.arm import Brake, Emergency, Feedback, Heard, Heartbeat, Joint, Power, Target, Wish
from drivers.can.bus_load import FrameSize
from drivers.can.cia402 import Control, Mode, Nmt, PowerState, Scale, StatusFlag
from drivers.can.dither import dithered
from drivers.can.frame import Frame
from drivers.can.link import Link
from drivers.can.sdo import Service, answers

MASTER = 127  # our own node number, as the drives watch it
BEAT = 3  # cycles between our heartbeats
SCAN_NODES = range(1, 16)
BOOT_NS = 200_000_000  # a node that begins anew is back by then, ASSUMED
RPDO2_BASE, RPDO3_BASE = 0x300, 0x400
RPDO2_MAP = (0x6040_0010, 0x6060_0008, 0x60B2_0010)
RPDO3_MAP = (0x60FF_0020,)
NOT_VALID = 1 << 31  # of a COB-ID: this PDO is off
SDO_REQUEST, SDO_ANSWER, DOWNLOAD, UPLOAD, UPLOADED = 0x600, 0x580, 0x23, 0x40, 0x43  # of four bytes at once
SET_BRAKE = 1 << 0  # of the digital outputs
QUICK_STOP_AND_STAY, ON_LOSS_QUICK_STOP = 6, 3  # of 605Ah and 6007h
WANTED_MODES = (Mode.CYCLIC_POSITION, Mode.CYCLIC_VELOCITY, Mode.CYCLIC_TORQUE)
_MODES = {
    CommandKind.POSITION: Mode.CYCLIC_POSITION,
    CommandKind.VELOCITY: Mode.CYCLIC_VELOCITY,
    CommandKind.TORQUE: Mode.CYCLIC_TORQUE,
}


@dataclass(frozen=True, slots=True)
class Cia402Arm:
    joints: tuple[Joint, ...]
    nodes: tuple[int, ...]
    scales: tuple[Scale, ...]
    revisions: tuple[int, ...]  # of 1018h:03, known to be good
    bitrate: float = 1e6
    data_bitrate: float = 0.0
    brake_contact: int | None = 16  # ASSUMED bit of the digital inputs 60FDh: closed; None: none tells
    heartbeat_ns: int = 50_000_000
    kinds: frozenset[CommandKind] = frozenset(CommandKind)

    @property
    def tells_brakes(self) -> bool:
        return self.brake_contact is not None

    @property
    def resolution(self) -> float:
        return max(1.0 / abs(scale.counts_per_radian) for scale in self.scales)

    def budget(self) -> list[FrameSize]:
        """Of positions and with a brake that is asked, which takes most."""
        n, asked = len(self.nodes), 2 if self.tells_brakes else 0
        return [FrameSize(8)] * (2 * n + asked) + [FrameSize(5)] * n + [FrameSize(1), FrameSize(0)]

    # --- a cycle -----------------------------------------------------------------------------------------------------

    def encode(self, seq: int, targets: Sequence[Target], last: Sequence[Feedback | None]) -> list[Frame]:
        frames = []
        for node, scale, target, told in zip(self.nodes, self.scales, targets, last, strict=True):
            if target.wish is not Wish.LOOK:
                frames += self._command(seq, node, scale, target, told)
        frames += self._ask_brake(seq, targets)
        if seq % BEAT == 0:
            frames.append(Frame(cia402.HEARTBEAT_BASE + MASTER, bytes([cia402.NodeState.OPERATIONAL])))
        return [*frames, Frame(cia402.SYNC_ID, b"")]

    def _ask_brake(self, seq: int, targets: Sequence[Target]) -> list[Frame]:
        """At most one frame, so that the load stays what `budget` says."""
        asked = [i for i, target in enumerate(targets) if target.wish in (Wish.ENABLE, Wish.BRAKE)]
        if not asked or not self.tells_brakes:
            return []
        turn, i = divmod(seq, len(asked))
        close = SET_BRAKE if targets[asked[i]].wish is Wish.BRAKE else 0
        write = struct.pack("<BHBI", DOWNLOAD, 0x60FE, 1, close)
        data = struct.pack("<BHB4x", UPLOAD, 0x60FD, 0) if turn % 2 else write
        return [Frame(SDO_REQUEST + self.nodes[asked[i]], data)]

    def _brake(self, data: bytes) -> Brake:
        if len(data) != 8 or self.brake_contact is None or data[:4] != struct.pack("<BHB", UPLOADED, 0x60FD, 0):
            return Brake(None)
        return Brake(bool(struct.unpack_from("<I", data, 4)[0] >> self.brake_contact & 1))

    def _command(self, seq: int, node: int, scale: Scale, target: Target, told: Feedback | None) -> list[Frame]:
        tau = dithered(target.tau, scale.rated_torque / 1000.0, 0.0, seq)
        control = _control(target.wish, told)
        data = struct.pack("<HbH", control, _MODES[target.kind], scale.per_mille(tau) & 0xFFFF)
        frames = [Frame(RPDO2_BASE + node, data)]
        if target.kind is CommandKind.POSITION:
            position = cia402.encode_target(scale, cia402.Target(control, target.q, tau))
            frames.insert(0, Frame(cia402.RPDO1_BASE + node, position))
        elif target.kind is CommandKind.VELOCITY:
            frames.append(Frame(RPDO3_BASE + node, struct.pack("<i", scale.counts_per_second(target.dq))))
        return frames

    def encoded(self, frames: Sequence[Frame]) -> list[float | None]:
        told = {frame.id: frame.data for frame in frames}
        return [
            cia402.decode_target(scale, data).q if (data := told.get(cia402.RPDO1_BASE + node)) else None
            for node, scale in zip(self.nodes, self.scales, strict=True)
        ]

    def decode(self, frame: Frame) -> tuple[int, Heard] | None:
        base, node = frame.id & 0x780, frame.id & 0x7F
        if node not in self.nodes:
            return None
        i = self.nodes.index(node)
        match base:
            case cia402.TPDO1_BASE:
                return i, _feedback(cia402.decode_actual(self.scales[i], frame.data))
            case base if base == SDO_ANSWER:
                return i, self._brake(frame.data)
            case cia402.HEARTBEAT_BASE:
                return i, Heartbeat(cia402.decode_heartbeat(frame.data) is cia402.NodeState.OPERATIONAL)
            case cia402.EMCY_BASE:
                told = cia402.decode_emergency(frame.data)
                return i, Emergency(f"EMCY {told.code:04X}h" if told.code >> 8 else "")
        return None

    def leave(self) -> list[Frame]:
        """Out of the cycle: a drive that is not operational does not miss our heartbeat."""
        return [Frame(cia402.NMT_ID, cia402.encode_nmt(Nmt.PRE_OPERATIONAL, 0))]

    # --- start-up ----------------------------------------------------------------------------------------------------

    def start_up(self, link: Link, period_ns: int, serials: Sequence[int]) -> Iterator[Finding]:
        link.send([Frame(cia402.NMT_ID, cia402.encode_nmt(Nmt.PRE_OPERATIONAL, 0))])
        counts = {node: answers(link, node) for node in SCAN_NODES}
        wrong = [f"node {n}: {c} answers" for n, c in counts.items() if c != int(n in self.nodes)]
        detail = "; ".join(wrong) or f"{len(self.nodes)} nodes, one answer each"
        fix = "check power, cabling and that no two drives have one node number"
        nameless = lss.is_nameless_there(link)
        if nameless:
            detail += "; a drive that has no node number"
            fix = "see that it is the right one, then asc drives CELL --assign NODE"
        yield Finding("scan", not wrong and not nameless, detail, fix)
        if wrong or nameless:
            return
        for i, node in enumerate(self.nodes):
            try:
                yield from self._examine(i, Service(link, node), period_ns, serials)
            except (SdoError, SdoCommunicationError, KeyError) as error:
                yield Finding(f"axis {i + 1}", False, f"node {node}: {error}", "the drive lacks what the cycle needs")
        link.send([Frame(cia402.NMT_ID, cia402.encode_nmt(Nmt.START, 0))])

    def _examine(self, i: int, node: Service, period_ns: int, serials: Sequence[int]) -> Iterator[Finding]:
        name, scale = f"axis {i + 1}", self.scales[i]
        if serials:
            serial = node[0x1018][4].raw
            fix = "this is another drive than in driver.serials: check its zero, then enter its number"
            yield Finding(f"{name} identity", serial == serials[i], f"serial {serial}, expected {serials[i]}", fix)
        revision = node[0x1018][3].raw
        fix = f"known good: {self.revisions}; update, or extend the arm's list after a test on the bench"
        yield Finding(f"{name} firmware", revision in self.revisions, f"revision {revision}", fix)
        told = (node[0x608F][1].raw, node[0x608F][2].raw, node[0x6091][1].raw, node[0x6091][2].raw, node[0x6076].raw)
        wanted = (scale.resolution, 1, scale.gear.numerator, scale.gear.denominator, round(scale.rated_torque * 1000))
        yield Finding(
            f"{name} scale", told == wanted, f"{told}, expected {wanted}", "set 608F, 6091, 6076 of the drive"
        )
        yield _limits(name, node, scale, self.joints[i])
        modes = node[0x6502].raw
        missing = [mode.name for mode in WANTED_MODES if not modes >> (mode - 1) & 1]
        yield Finding(f"{name} modes", not missing, f"lacks {missing}" if missing else "cyclic ones", "another drive")
        yield self._set(name, node, period_ns)

    def _set(self, name: str, node: Service, period_ns: int) -> Finding:
        """Mapping, interpolation period, reactions: written, then read back.

        RPDO4 and TPDO2 are off: by default anybody who sends on them commands the axis."""
        number = node.rx_cobid - 0x600
        _map(node, 0x1400, cia402.RPDO1_BASE + number, cia402.RPDO1_MAP)
        _map(node, 0x1401, RPDO2_BASE + number, RPDO2_MAP)
        _map(node, 0x1800, cia402.TPDO1_BASE + number, cia402.TPDO1_MAP)
        _map(node, 0x1402, RPDO3_BASE + number, RPDO3_MAP)
        for spare in (0x1403, 0x1801):
            node[spare][1].raw = node[spare][1].raw | NOT_VALID
        wanted = {
            (0x60C2, 1): period_ns // 1_000_000,
            (0x60C2, 2): -3,
            (0x605A, 0): QUICK_STOP_AND_STAY,
            (0x6007, 0): ON_LOSS_QUICK_STOP,
            (0x6071, 0): 0,
        }
        if self.tells_brakes:
            wanted[0x60FE, 2] = SET_BRAKE
        return _write(f"{name} settings", node, wanted)

    def reset(self, link: Link, i: int) -> Finding:
        """By service data, because no SYNC goes. After a loss of communication a drive may want its communication to be
        reset first."""
        number, name = self.nodes[i], f"axis {i + 1} reset"
        try:
            state = _reset(Service(link, number))
            if state is PowerState.FAULT:
                link.send([Frame(cia402.NMT_ID, cia402.encode_nmt(Nmt.RESET_COMMUNICATION, number))])
                _wait(link, BOOT_NS)
                state = _reset(Service(link, number))
        except (SdoError, SdoCommunicationError, ProtocolError) as error:
            return Finding(name, False, str(error), "check the cable of the drive")
        ok = state is PowerState.SWITCH_ON_DISABLED
        words = state.name.replace("_", " ").lower()
        fix = "the cause is not over; if the drive is enabled, switch its power off"
        return Finding(name, ok, f"it is {words}", fix)

    def assign(self, link: Link, number: int) -> Finding:
        if number not in self.nodes:
            return Finding("number", False, f"{number} is no node of this arm", f"one of {list(self.nodes)}")
        if answers(link, number):
            return Finding("number", False, f"node {number} is there already", "asc drives tells which one is missing")
        try:
            identity = lss.assign(link, number)
        except lss.LssError as error:
            return Finding("number", False, str(error), "one drive without number on the bus at a time, and in reach")
        _wait(link, BOOT_NS)
        told = answers(link, number)
        detail = f"{told} answers as node {number}: vendor, product, revision, serial {identity}"
        return Finding("number", told == 1, detail, "switch the drive off and on, and look again: asc drives")

    def guard(self, link: Link, i: int, watchdog_ns: int) -> Finding:
        ms = watchdog_ns // 1_000_000
        wanted = {
            (0x1016, 1): MASTER << 16 | ms,
            (0x1017, 0): self.heartbeat_ns // 1_000_000,
            (0x1401, 5): ms,
        }
        try:
            return _write(f"axis {i + 1} watchdog", Service(link, self.nodes[i]), wanted)
        except (SdoError, SdoCommunicationError) as error:
            return Finding(f"axis {i + 1} watchdog", False, str(error), "the drive does not take its time-outs")


def _reset(node: Service) -> PowerState:
    """A rising edge of bit 7, then none; the state after it."""
    for word in (Control.DISABLE_VOLTAGE, cia402.FAULT_RESET, Control.DISABLE_VOLTAGE):
        node[0x6040].raw = int(word)
    return PowerState.of(node[0x6041].raw)


def _limits(name: str, node: Service, scale: Scale, joint: Joint) -> Finding:
    """The drive's software position limits equal the joint's to the count: the second line of defence of the arm."""
    wanted = tuple(sorted((scale.counts(joint.q_min), scale.counts(joint.q_max))))
    told = (node[0x607D][1].raw, node[0x607D][2].raw)
    degrees = " to ".join(f"{math.degrees(q):.3f}" for q in sorted(map(scale.radians, told)))
    return Finding(
        f"{name} limits",
        told == wanted,
        f"607Dh is {told[0]} to {told[1]} counts ({degrees} deg), expected {wanted[0]} to {wanted[1]}",
        f"set 607Dh:01 = {wanted[0]} and 607Dh:02 = {wanted[1]} in the drive, or correct the joint's range in arms.py",
    )


def _map(node: Service, communication: int, cob_id: int, entries: Sequence[int]) -> None:
    """The order that the standard wants: off, emptied, filled, on."""
    mapping = communication + 0x200
    node[communication][1].raw = cob_id | NOT_VALID
    node[communication][2].raw = cia402.SYNC_TYPE
    node[mapping][0].raw = 0
    for k, entry in enumerate(entries):
        node[mapping][k + 1].raw = entry
    node[mapping][0].raw = len(entries)
    node[communication][1].raw = cob_id


def _wait(link: Link, ns: int) -> None:
    """And hear nothing of what is said meanwhile."""
    deadline_ns = link.now_ns() + ns
    while link.receive(deadline_ns) is not None:
        pass


def _write(name: str, node: Service, wanted: dict[tuple[int, int], int]) -> Finding:
    wrong = []
    for (index, sub), value in wanted.items():
        entry = node[index][sub] if sub else node[index]
        entry.raw = value
        if (told := entry.raw) != value:
            wrong.append(f"{index:04X}h:{sub:02X} is {told}, not {value}")
    detail = "; ".join(wrong) or "read back as written"
    return Finding(name, not wrong, detail, "the drive does not take this setting: do not use it")


def _control(wish: Wish, told: Feedback | None) -> int:
    """The controlword. An axis that fell out stays out, and one that has stopped by itself goes on holding."""
    state = PowerState.of(told.raw) if told is not None else PowerState.NOT_READY
    if wish is Wish.ENABLE:
        return cia402.towards_enabled(state) or Control.DISABLE_VOLTAGE
    if wish is Wish.DISABLE:
        return cia402.towards_disabled(state) or Control.DISABLE_VOLTAGE
    if state is PowerState.OPERATION_ENABLED:
        return Control.ENABLE_OPERATION
    return Control.QUICK_STOP if state is PowerState.QUICK_STOP else Control.DISABLE_VOLTAGE


def _feedback(actual: cia402.Actual) -> Feedback:
    state, words = actual.state, actual.state.name.replace("_", " ").lower()
    if state in (PowerState.FAULT, PowerState.FAULT_REACTION, PowerState.QUICK_STOP):
        power = Power.FAULT
    elif not actual.flags & StatusFlag.VOLTAGE:
        power, words = Power.NO_VOLTAGE, "no voltage"
    elif state is PowerState.OPERATION_ENABLED and actual.flags & StatusFlag.FOLLOWS:
        power = Power.ENABLED
    else:
        power = Power.DISABLED
        if state is PowerState.OPERATION_ENABLED:
            words = "enabled, and ignores its targets"
    warning = bool(actual.flags & StatusFlag.WARNING)
    return Feedback(power, actual.q, None, actual.tau, None, warning, words, actual.state.value[1])
