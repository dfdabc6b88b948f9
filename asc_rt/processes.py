"""The processes of a session: what runs, what its death means, and in which order they are ended."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from asc_rt import topics
from asc_rt.bus import Bus, BusError, open_router
from asc_rt.config import Cell

END_TIMEOUT_S = {"control": 15.0, "logger": 30.0}  # to brake and say goodbye; to write what is in the ring
OTHER_END_TIMEOUT_S = 5.0
POLL_S = 0.02

_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None)


class Death(StrEnum):
    """What the end of a process means for the session."""

    SESSION_OVER = "the session is over; a moving robot stops by its own silence rule"
    SESSION_ENDS = "nothing is recorded any more: the session is ended"
    ROBOT_STOPS = "the control process notices and stops the robot"


@dataclass(frozen=True, slots=True)
class Spec:
    name: str
    argv: tuple[str, ...]  # after the interpreter
    death: Death
    outlives_us: bool = False  # it notices by itself that the supervisor died, and has something left to do


@dataclass(slots=True)
class Process:
    spec: Spec
    popen: subprocess.Popen[bytes]
    reported: bool = False  # its end has been told

    @property
    def name(self) -> str:
        return self.spec.name

    @property
    def code(self) -> int | None:
        """Exit code, negative: the signal that killed it; None while it runs."""
        return self.popen.poll()


def table(cell: Cell, ring: Path, log: Path) -> dict[str, Spec]:
    """Every process of `cell`, in the order of starting."""
    overrides = _overrides(cell)
    path = str(cell.path)
    logger = ("-m", "logs.writer", "--cell", path, "--ring", str(ring), "--out", str(log), *overrides)
    specs = [Spec("logger", logger, Death.SESSION_ENDS, outlives_us=True)]
    if cell.simulated:
        specs += [Spec(device, ("-m", "sim_hil", device, path, *overrides), Death.ROBOT_STOPS) for device in cell.sim]
    if cell.perception is not None and not cell.perception.remote:
        specs.append(Spec(topics.PERCEPTION, ("-m", "asc_rt.perception", path, *overrides), Death.ROBOT_STOPS))
    control = ("-m", "asc_rt.control", path, "--ring", str(ring), *overrides)
    return {spec.name: spec for spec in [*specs, Spec("control", control, Death.SESSION_OVER)]}


class Processes:
    """Started processes. Each has its own group, so that Ctrl-C reaches the supervisor alone, and dies with it."""

    def __init__(self) -> None:
        self._running: dict[str, Process] = {}

    def start(self, spec: Spec) -> None:
        popen = subprocess.Popen(
            [sys.executable, *spec.argv],
            stdin=subprocess.DEVNULL,
            stdout=sys.stderr,  # our own stdout belongs to the result
            process_group=0,
            preexec_fn=None if spec.outlives_us else _end_with_parent,
        )
        self._running[spec.name] = Process(spec, popen)

    def code(self, name: str) -> int | None:
        """None: it runs, or was never started."""
        process = self._running.get(name)
        return None if process is None else process.code

    def cpu_s(self) -> dict[str, float]:
        """Seconds of a core that each has used so far, all its threads; of those that run."""
        return {name: s for name, process in self._running.items() if (s := _cpu_s(process.popen.pid)) is not None}

    def newly_ended(self) -> Iterator[Process]:
        """Every process that has ended, once."""
        for process in self._running.values():
            if process.code is not None and not process.reported:
                process.reported = True
                yield process

    def wait(self, name: str, timeout_s: float) -> bool:
        """True: it has ended."""
        process = self._running.get(name)
        deadline = time.monotonic() + timeout_s
        while process is not None and process.code is None:
            if time.monotonic() > deadline:
                return False
            time.sleep(POLL_S)
        return True

    def end(self, name: str) -> None:
        """Ask it to end, wait, and kill it if it does not."""
        process = self._running.get(name)
        if process is None:
            return
        process.reported = True
        if process.code is None:
            process.popen.send_signal(signal.SIGTERM)
        if not self.wait(name, END_TIMEOUT_S.get(name, OTHER_END_TIMEOUT_S)):
            process.popen.kill()
            process.popen.wait()

    def end_all_but_logger(self) -> None:
        """The last started first: control, so that the robot rests before anything else goes; and nobody misses what
        it listens to."""
        for name in reversed([name for name in self._running if name != "logger"]):
            self.end(name)

    def end_logger(self) -> None:
        """It ends by itself once the ring is closed. A signal would hit it while it leaves, and look like a failure."""
        self.wait("logger", END_TIMEOUT_S["logger"])
        self.end("logger")


def run_device(cell: Cell, device: str, options: Sequence[str]) -> int:
    """One simulated device of `cell` alone, until it ends or Ctrl-C; its exit code."""
    return _run_alone(cell, ("-m", "sim_hil", device, str(cell.path), *_overrides(cell), *options))


def run_perception(cell: Cell, remote: bool) -> int:
    """The perception process of `cell` alone, until it ends or Ctrl-C; its exit code."""
    argv = ("-m", "asc_rt.perception", str(cell.path), *_overrides(cell))
    return _wait(_child([*argv, "--remote"])) if remote else _run_alone(cell, argv)


def _run_alone(cell: Cell, argv: Sequence[str]) -> int:
    """Who speaks on the bus needs one: made here, unless a cell is running and has one already."""
    try:
        router: Bus | None = open_router(cell.bus_endpoint)
    except BusError:
        router = None
    try:
        return _wait(_child(argv))
    finally:
        if router is not None:
            router.close()


def _wait(process: subprocess.Popen[bytes]) -> int:
    while True:
        with suppress(KeyboardInterrupt):  # Ctrl-C reaches it too, and it ends by itself
            return process.wait()


def _child(argv: Sequence[str]) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, *argv], preexec_fn=_end_with_parent)


def describe(code: int) -> str:
    """An exit code in words."""
    return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"


def _overrides(cell: Cell) -> tuple[str, ...]:
    return tuple(part for item in cell.overrides for part in ("--set", item))


def _cpu_s(pid: int) -> float | None:
    """User and system time of a process, s; None: it is gone."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2].split()
    except OSError:
        return None
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _end_with_parent() -> None:
    """In the child: SIGTERM when the supervisor dies, however it dies. So nobody runs on without an operator."""
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
