"""`asc doctor`: is this PC, and this cell, fit to run? Every finding says what to do about it. Nothing is changed.

A new check is a function and one line in `PC` (about this machine) or `CELL` (about a cell that can be loaded).
"""

from __future__ import annotations

import os
import platform
import resource
import shutil
import socket
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from asc_rt import realtime
from asc_rt.certified import require
from asc_rt.config import Cell, ConfigError, load_cell
from drivers import registry
from drivers.base import Examinable, Finding

SHARED_MEMORY_MB = 256  # two rings of 40 s
NOT_THERE = "robot"  # the driver's finding that nobody answers: a simulated robot need not be running


def examine(cell_name: str) -> dict[str, Any]:
    """All checks; `ok` when all of them hold."""
    findings = examine_pc()
    try:
        cell = load_cell(cell_name)
    except ConfigError as error:
        findings += [Finding("cell", False, line, "correct the file") for line in error.lines]
    else:
        findings += examine_cell(cell)
    return verdict(findings)


def verdict(findings: Sequence[Finding]) -> dict[str, Any]:
    """As --json tells it; what to do only where something is wrong."""
    checks = [asdict(replace(found, fix="" if found.ok else found.fix)) for found in findings]
    return {"checks": checks, "ok": all(found.ok for found in findings)}


def examine_pc() -> list[Finding]:
    return [check() for check in PC]


def examine_cell(cell: Cell) -> list[Finding]:
    return [finding for check in CELL for finding in check(cell)]


# --- this PC ---------------------------------------------------------------------------------------------------------


def _processor() -> Finding:
    cores = len(os.sched_getaffinity(0))
    return Finding("processor", cores >= 2, f"{cores} cores", "two cores at least: one for the loop, one for the rest")


def _kernel() -> Finding:
    """A real-time kernel is wanted on a real robot, yet nothing fails without: it is told, not refused."""
    real_time = _read("/sys/kernel/realtime") == "1"
    return Finding("kernel", True, f"{platform.release()}, {'PREEMPT_RT' if real_time else 'not a real-time kernel'}")


def _priority() -> Finding:
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    allowed = _may(lambda: os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1)))
    if allowed:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    fix = "as root add '@realtime - rtprio 99' to /etc/security/limits.d/realtime.conf and join that group"
    return Finding("priority", allowed, f"SCHED_FIFO {'allowed' if allowed else f'refused (limit {limit})'}", fix)


def _throttling() -> Finding:
    """Told, not refused, as the kernel is: it takes a core that real-time tasks fill to begin with."""
    runtime, period = (int(_read(f"/proc/sys/kernel/sched_rt_{name}_us", "-1")) for name in ("runtime", "period"))
    free = runtime < 0 or runtime >= period
    held = f"real-time tasks that fill a core are held back {(period - runtime) * 1e-3:.0f} ms in each second"
    return Finding("throttling", True, "real-time tasks are never held back" if free else held)


def _memory_lock() -> Finding:
    limit = realtime.lock_memory_limit()
    enough = limit < 0 or limit >= 1 << 30
    detail = "no limit" if limit < 0 else f"limit {limit / 1e6:.0f} MB"
    return Finding(
        "memory lock", enough, detail, "add '@realtime - memlock unlimited' to the same file as for priority"
    )


def _clock() -> Finding:
    source = _read("/sys/devices/system/clocksource/clocksource0/current_clocksource", "unknown")
    fast = source in ("tsc", "arch_sys_counter", "kvm-clock", "unknown")
    return Finding("clock", fast, f"clock source {source}", "boot with clocksource=tsc: reading other sources is slow")


def _shared_memory() -> Finding:
    free = shutil.disk_usage("/dev/shm").free / 1e6
    return Finding(
        "shared memory", free > SHARED_MEMORY_MB, f"{free:.0f} MB free in /dev/shm", "remove dead sessions' asc-*"
    )


PC: tuple[Callable[[], Finding], ...] = (
    _processor,
    _kernel,
    _priority,
    _throttling,
    _memory_lock,
    _clock,
    _shared_memory,
)


# --- the cell --------------------------------------------------------------------------------------------------------


def _file(cell: Cell) -> Iterator[Finding]:
    yield Finding("cell", True, f"{cell.path.name} is in order")


def _certificate(cell: Cell) -> Iterator[Finding]:
    name = "certificate"
    if cell.uncertified:
        yield Finding(name, True, "not asked for: the simulated cell says uncertified = true")
        return
    try:
        require(cell)
    except ConfigError as error:
        yield Finding(name, False, "; ".join(error.lines), "asc certify; without one asc run refuses the cell")
    else:
        yield Finding(name, True, f"covers tool {cell.params.tool.name} on {cell.params.robot.name}")


def _calibration(cell: Cell) -> Iterator[Finding]:
    """A file that must not be used is refused with the cell; here is what was found good."""
    for sensor in cell.params.human.sensors:
        number = sensor.calibration_hash
        detail = f"result file {number:016x} is accepted and valid" if number else "ground truth of the simulation"
        yield Finding("calibration", True, f"{sensor.name}: {detail}")


def _pose(cell: Cell) -> Iterator[Finding]:
    """Of a cell with an estimator: whether it takes the model is found out when perception starts."""
    pose = cell.perception and cell.perception.pose
    if not pose:
        return
    there = find_spec(pose.backend) is not None
    detail = f"{pose.backend} {'installed' if there else 'not installed'}, model {pose.model.name} {pose.digest.hex()}"
    yield Finding("pose", there, detail, "uv sync --extra pose, or take [perception.pose] out")


def _bus_port(cell: Cell) -> Iterator[Finding]:
    host, _, port = cell.bus_endpoint.removeprefix("tcp/").rpartition(":")
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        free = _may(lambda: probe.bind((host, int(port))))
    detail = f"{cell.bus_endpoint} {'free' if free else 'in use'}"
    yield Finding("bus", free, detail, "end the session that runs, or set another bus.endpoint")


def _robot(cell: Cell) -> Iterator[Finding]:
    """What the cell's driver sees of its robot, where it can look without moving it."""
    driver = registry.driver_class(cell.driver["name"])(cell.driver_options)
    if not isinstance(driver, Examinable):
        return
    for found in driver.examine(cell.params.period_ns):
        if cell.simulated and not found.ok and found.name == NOT_THERE:
            yield Finding(NOT_THERE, True, f"the simulated one is not examined: {found.detail}")
        else:
            yield found


CELL: tuple[Callable[[Cell], Iterator[Finding]], ...] = (_file, _calibration, _pose, _certificate, _bus_port, _robot)


# --- helpers ---------------------------------------------------------------------------------------------------------


def _read(path: str, otherwise: str = "") -> str:
    try:
        return Path(path).read_text().strip()
    except OSError:
        return otherwise


def _may(action: Callable[[], object]) -> bool:
    try:
        action()
    except OSError:
        return False
    return True
