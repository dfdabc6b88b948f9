"""From power on to holding still: a list of lines, each with a verdict. The first part enables nothing."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator

import numpy as np

from asc_rt.core.types import Vector
from drivers.base import Dynamics, Finding, HandshakeError, LinkError, RobotFaulted
from drivers.can import bus_load, home
from drivers.can.arm import ArmCodec, Power, Target, Wish
from drivers.can.link import Link
from drivers.can.options import Options
from drivers.can.stream import Stream, hold, look

BUS, LISTEN = "robot", "listen"  # names of the lines that say whether anybody is there, and nobody else
LEAST_QUEUE, FD_MTU = 64, 72  # frames that the interface holds for us, two cycles' and more; bytes of one of CAN FD
LISTENED = 16  # frames of others that are told by identifier
REHEARSAL = 50  # cycles before anything is enabled
LOSSES = 2  # answers of one axis that may be lost meanwhile
SETTLE = 15  # cycles
ENABLE_CYCLES = 25  # for one axis
BRAKE_S = 0.3  # for its brake to open, and to tell so
SEED = 0.005  # rad between two looks at an arm that stands still
SAG = 0.05  # rad that the arm may give way when it is enabled


def examine(link: Link, codec: ArmCodec, options: Options, period_ns: int) -> Iterator[Finding]:
    """Opens the link and leaves it open. Raises nothing of the wire's."""
    yield _load(codec, period_ns)
    yield _silence(codec)
    for line in examine_bus(link, codec, options):
        yield line
        if not line.ok and line.name in (BUS, LISTEN):  # what is asked next would disturb the session of the other one
            return
    yield from codec.start_up(link, period_ns, options.serials)
    h = link.health
    wrong = [name for name in ("passive", "off", "unacknowledged", "backlog", "gone") if getattr(h, name)]
    yield Finding("bus state", not wrong, ", ".join(wrong) or "error active", "check termination, cabling and power")


def examine_bus(link: Link, codec: ArmCodec, options: Options) -> Iterator[Finding]:
    """Is it there, at the right speed, and ours alone? Says nothing on it."""
    try:
        link.open()
    except LinkError as error:
        yield Finding(BUS, False, str(error), error.hint)
        return
    yield Finding(BUS, True, f"{options.interface} {options.channel} is open")
    yield bit_timing(codec, options.interface, options.channel)
    yield _listen(link, options)


def bit_timing(codec: ArmCodec, interface: str, channel: str) -> Finding:
    """SocketCAN takes its bit rates from `ip link`, whatever a program asks for."""
    if interface != "socketcan":
        return Finding("bit timing", True, f"{interface} does not tell; a wrong one shows in the scan")
    try:
        (link,) = json.loads(shown_by_ip(channel))
    except ValueError:
        return Finding("bit timing", False, f"no such interface: {channel}", f"ip link show {channel}")
    told, wrong = link.get("linkinfo", {}), []
    if "UP" not in link.get("flags", ()):
        wrong.append("it is down")
    if told.get("info_kind") != "vcan":  # which has no wire
        data = told.get("info_data", {})
        rate, data_rate = (data.get(key, {}).get("bitrate", 0) for key in ("bittiming", "data_bittiming"))
        if rate != codec.bitrate:
            wrong.append(f"{rate} bit/s, not {codec.bitrate:.0f}")
        if codec.data_bitrate and data_rate != codec.data_bitrate:
            wrong.append(f"{data_rate} bit/s in the data phase, not {codec.data_bitrate:.0f}")
        if (queue := link.get("txqlen", 0)) < LEAST_QUEUE:
            wrong.append(f"a queue of {queue} frames, at least {LEAST_QUEUE}")
    if codec.data_bitrate and link.get("mtu", 0) < FD_MTU:
        wrong.append("it carries no CAN FD")
    fd = f" dbitrate {codec.data_bitrate:.0f} fd on" if codec.data_bitrate else ""
    fix = f"ip link set {channel} down; ip link set {channel} txqueuelen {LEAST_QUEUE} up type can "
    return Finding(
        "bit timing", not wrong, ", ".join(wrong) or "as the arm needs it", f"{fix}bitrate {codec.bitrate:.0f}{fd}"
    )


def shown_by_ip(channel: str) -> str:
    """What the kernel says of an interface; empty: there is none, or no `ip` to ask."""
    try:
        asked = ["ip", "-details", "-json", "link", "show", channel]
        return subprocess.run(asked, capture_output=True, text=True, timeout=5.0, check=False).stdout
    except (OSError, subprocess.TimeoutExpired):
        return ""


def _load(codec: ArmCodec, period_ns: int) -> Finding:
    share = bus_load.load(codec.budget(), period_ns * 1e-9, codec.bitrate, codec.data_bitrate)
    rate = f"{codec.bitrate * 1e-6:g}" + (f"/{codec.data_bitrate * 1e-6:g}" if codec.data_bitrate else "")
    detail = f"{share:.1%} of {rate} Mbit/s in the worst case, at most {bus_load.LIMIT:.0%}"
    return Finding("bus load", share <= bus_load.LIMIT, detail, "a longer period_ms, fewer axes, or CAN FD")


def _silence(codec: ArmCodec) -> Finding:
    """What happens when this PC dies: an axis without brake must not go limp."""
    falls = [i + 1 for i, joint in enumerate(codec.joints) if not joint.has_brake and not joint.holds_on_silence]
    detail = f"axes {falls} have no brake and go limp" if falls else "every axis has a brake, or holds by itself"
    return Finding("when this PC dies", not falls, detail, "fit brakes, or drives that hold when nobody talks to them")


def _listen(link: Link, options: Options) -> Finding:
    """Another master would command the same drives."""
    heard: list[int] = []
    deadline_ns = link.now_ns() + round(options.listen_s * 1e9)
    while (frame := link.receive(deadline_ns)) is not None:
        if not 0x700 <= frame.id < 0x780:  # heartbeats and boot-ups of CANopen
            heard.append(frame.id)
    ids = ", ".join(f"{i:03X}h" for i in sorted(set(heard))[:LISTENED])
    return Finding(LISTEN, not heard, f"others send {ids}" if heard else "silence", "take the other master off")


def enable(stream: Stream, options: Options, dynamics: Dynamics) -> Iterator[Finding]:
    """Rehearse, seed, enable axis by axis, hold. HandshakeError: a line fails; RobotFaulted: a fault meanwhile."""
    yield _rehearse(stream)
    q = _seed(stream)
    yield _checked(home.check(options.home, q, tuple(stream.codec.joints)))
    for i in range(len(q)):
        _cycle(stream, hold(q, _weight(dynamics, q)))
        yield _checked(stream.codec.guard(stream.link, i, round(options.watchdog_ms * 1e6)))
        stream.pause()
    for _ in range(SETTLE):  # heartbeats are heard again
        _cycle(stream, hold(q, _weight(dynamics, q)))
    for i in range(len(q)):
        yield _enable_axis(stream, i, q, dynamics)
    for _ in range(max(1, round(options.hold_s * 1e9 / stream.period_ns))):
        _cycle(stream, hold(q, _weight(dynamics, q)))
    sag = float(np.max(np.abs(stream.pose()[0] - q)))
    fix = "support the arm; check brakes, payload and gains"
    yield _checked(Finding("hold", sag <= SAG, f"gave way {sag * 1e3:.1f} mrad, at most {SAG * 1e3:.0f}", fix))


def _rehearse(stream: Stream) -> Finding:
    """The cycle as it will be, without commanding anything: losses show here, not in motion.

    A loss is an answer that never comes. One that comes late is judged by its age, as in motion: who is told too late
    to go on there does not begin.
    """
    stream.pause()
    for _ in range(REHEARSAL):
        _cycle(stream, look(len(stream.axes)))
    powers = stream.powers()
    may = (Power.DISABLED, Power.ENABLED)  # enabled: an axis without brake, as the last session left it
    wrong = [
        f"axis {i + 1}: {axis.feedback.words if axis.feedback else 'silent'}"
        for i, (axis, power) in enumerate(zip(stream.axes, powers, strict=True))
        if power not in may[: 1 if stream.codec.joints[i].has_brake else 2]
    ]
    fix = "find the cause; then a person resets the drive: asc drives CELL --reset AXIS. Nothing is reset by itself"
    _checked(Finding("power", not wrong, ", ".join(wrong) or "as it was left, and without fault", fix))
    lost = max(axis.lost for axis in stream.axes)
    detail = "; ".join([f"{lost} of {REHEARSAL} answers of an axis lost", *map(str, stream.found)])
    ok = lost <= LOSSES and not stream.found
    return _checked(Finding("rehearsal", ok, detail, "check cabling and the load of this PC"))


def _seed(stream: Stream) -> Vector:
    """The pose to hold: measured twice, and the same."""
    first = stream.pose()[0]
    _cycle(stream, look(len(first)))
    q = stream.pose()[0]
    moved = float(np.max(np.abs(q - first)))
    _checked(Finding("seed", moved <= SEED, f"the arm moves: {moved * 1e3:.1f} mrad in a cycle", "let it come to rest"))
    return q


def _enable_axis(stream: Stream, i: int, q: Vector, dynamics: Dynamics) -> Finding:
    """The axes before it hold, those after it stay as they are."""
    axis, tells = stream.axes[i], stream.codec.tells_brakes and stream.codec.joints[i].has_brake
    for _ in range(ENABLE_CYCLES + (round(BRAKE_S * 1e9 / stream.period_ns) if tells else 0)):
        targets = hold(q, _weight(dynamics, q))
        targets[i] = hold(q, _weight(dynamics, q), Wish.ENABLE)[i]
        _cycle(stream, targets)
        if stream.powers()[i] is Power.ENABLED and (not tells or axis.brake_closed is False):
            stream.expects_power[i] = True
            return Finding(f"enable axis {i + 1}", True, "enabled" + (", its brake is open" if tells else ""))
    if stream.powers()[i] is Power.ENABLED:
        detail = "its brake does not tell that it has opened"
        return _checked(Finding(f"brake of axis {i + 1}", False, detail, "check the brake, its supply and its contact"))
    detail = f"stays {axis.feedback.words if axis.feedback else 'silent'}"
    return _checked(Finding(f"enable axis {i + 1}", False, detail, "check power and the emergency stop circuit"))


def _cycle(stream: Stream, targets: list[Target]) -> None:
    """One whole period. RobotFaulted."""
    begin_ns = stream.link.now_ns()
    stream.send(targets)
    stream.collect(begin_ns + stream.period_ns, begin_ns + stream.period_ns)
    if any(stream.expects_power) and stream.found:
        raise RobotFaulted(str(stream.found[0]), hint=stream.found[0].rule.do)
    if stream.is_cut:
        raise RobotFaulted(str(stream.found[-1]), hint=stream.found[-1].rule.do)


def _weight(dynamics: Dynamics, q: Vector) -> Vector:
    zero = np.zeros_like(q)
    return dynamics(q, zero, zero)


def _checked(line: Finding) -> Finding:
    if not line.ok:
        raise HandshakeError(f"start-up refused: {line.name}: {line.detail}", hint=line.fix)
    return line
