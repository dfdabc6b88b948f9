"""A look at the robot without moving it: is the wire there, is it the right robot, and how punctual are both?"""

from __future__ import annotations

import fcntl
import socket
import struct
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Protocol

import numpy as np

from drivers.base import DriverCaps, DriverError, Finding, LinkError
from drivers.fanuc_stream_motion.packets import Status, sequence_distance
from drivers.fanuc_stream_motion.transport import local_address

_SIOCGIFADDR = 0x8915
STATUSES = 100
QUESTIONS = 20
CYCLE_TOLERANCE = 0.1  # of the mean cycle; 2, 4 and 8 ms are a factor of two apart
GAP_CYCLES = 5  # the longest wait for a status; what a controller buffers covers it
ANSWER_CYCLES = 3  # to a question: the robot looks once a cycle, and answers in the next


class Examined(Protocol):
    @property
    def host(self) -> str: ...
    def configure(self) -> DriverCaps: ...
    def watch(self, count: int) -> list[tuple[int, Status]]: ...
    def ask(self) -> int | None: ...
    def check_pose(self, status: Status) -> None: ...
    def findings(self) -> Iterator[Finding]: ...
    def close(self) -> None: ...


def examine(robot: Examined, period_ns: int) -> Iterator[Finding]:
    """The findings in the order of a bring-up; what cannot be looked at for want of another is left out."""
    yield _network(robot.host)
    try:
        caps = robot.configure()
    except DriverError as error:
        name = "robot" if isinstance(error, LinkError) else "robot handshake"
        yield Finding(name, False, str(error), error.hint)
        return
    try:
        yield Finding("robot", True, caps.identity)
        yield _limits(caps)
        yield from robot.findings()
        yield _round_trip(robot, period_ns)
        statuses = robot.watch(STATUSES)
        yield _cycle(statuses, period_ns)
        yield _punctuality(statuses, period_ns)
        yield _state(statuses[-1][1])
        robot.check_pose(statuses[-1][1])
        yield Finding("robot pose", True, "the face plate is where these angles have it")
    except DriverError as error:
        yield Finding("robot session", False, str(error), error.hint)
    finally:
        robot.close()


def _network(host: str) -> Finding:
    """By which card: wireless ones lose statuses for tens of milliseconds."""
    try:
        address = local_address((socket.gethostbyname(host), 9))
    except OSError as error:
        detail = f"no way to {host}: {error.strerror or error}"
        return Finding("robot network", False, detail, "correct driver.host; give this PC an address on its network")
    card = _card(address)
    wireless = (Path("/sys/class/net") / card / "wireless").exists()
    detail = f"{host} is reached from {address} by {card}{', which is wireless' if wireless else ''}"
    return Finding("robot network", not wireless, detail, "a cable of its own to the robot")


def _card(address: str) -> str:
    """The network card that has this address of ours."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        for _, name in socket.if_nameindex():
            with suppress(OSError):
                told = fcntl.ioctl(probe, _SIOCGIFADDR, struct.pack("256s", name.encode()))
                if told[20:24] == socket.inet_aton(address):
                    return name
    return "an unknown card"


def _limits(caps: DriverCaps) -> Finding:
    if caps.limits is None:
        return Finding("robot limits", True, "not asked for (driver.limits): the profile's are all there is")
    least = np.degrees([caps.limits.dq_max, caps.limits.ddq_max, caps.limits.dddq_max]).min(axis=1)
    return Finding("robot limits", True, "least {:.0f} deg/s, {:.0f} deg/s2, {:.0f} deg/s3".format(*least))


def _round_trip(robot: Examined, period_ns: int) -> Finding:
    fix = "check cable and real-time set-up: a wired card of its own, no power saving"
    took = [answer for answer in (robot.ask() for _ in range(QUESTIONS)) if answer is not None]
    if len(took) < QUESTIONS:
        return Finding("robot round trip", False, f"{QUESTIONS - len(took)} of {QUESTIONS} requests unanswered", fix)
    middle, longest = np.median(took) * 1e-6, max(took) * 1e-6
    good = middle <= ANSWER_CYCLES * period_ns * 1e-6
    return Finding("robot round trip", bool(good), f"median {middle:.1f} ms, longest {longest:.1f} ms", fix)


def _cycle(statuses: list[tuple[int, Status]], period_ns: int) -> Finding:
    (first_ns, first), (last_ns, last) = statuses[0], statuses[-1]
    cycles = sequence_distance(last.seq, first.seq)
    measured = (last_ns - first_ns) / max(1, cycles)
    good = abs(measured - period_ns) <= CYCLE_TOLERANCE * period_ns
    detail = f"{measured * 1e-6:.2f} ms, the cell's period is {period_ns * 1e-6:g} ms"
    return Finding("robot cycle", bool(good), detail, "set period_ms to the robot's cycle ($STMO.$COM_INT)")


def _punctuality(statuses: list[tuple[int, Status]], period_ns: int) -> Finding:
    lost = sequence_distance(statuses[-1][1].seq, statuses[0][1].seq) + 1 - len(statuses)
    gap = float(np.diff([t_ns for t_ns, _ in statuses]).max())
    detail = f"{lost} of {len(statuses) + lost} lost, longest gap {gap * 1e-6:.1f} ms"
    fix = "check cable, switch and real-time set-up; let nothing else run on this PC"
    return Finding("robot statuses", lost == 0 and gap <= GAP_CYCLES * period_ns, detail, fix)


def _state(status: Status) -> Finding:
    """Whether a program waits is told, not judged: it is started later."""
    if status.emergency_stop or not status.servo_on or status.trouble:
        detail = status.trouble or ("emergency stop" if status.emergency_stop else "servo power is off")
        return Finding("robot state", False, detail, "clear it at the pendant: release the emergency stop, press RESET")
    waits = "a program waits for set-points" if status.ready else "no program waits for set-points yet"
    return Finding("robot state", True, f"servo power on, {waits}")
