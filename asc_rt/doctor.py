"""`asc doctor`: is this PC, and this cell, fit to run? Every finding says what to do about it. Nothing is changed."""

from __future__ import annotations

import os
import platform
import resource
import shutil
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

from asc_rt import realtime
from asc_rt.config import Cell, ConfigError, load_cell

Check = dict[str, Any]
SHARED_MEMORY_MB = 256  # two rings of 40 s


def examine(cell_name: str) -> dict[str, Any]:
    """All checks; `ok` when all of them hold."""
    checks = [_processor(), _kernel(), _priority(), _memory_lock(), _clock(), _shared_memory()]
    try:
        cell = load_cell(cell_name)
    except ConfigError as error:
        checks += [_check("cell", False, line, "correct the file") for line in error.lines]
    else:
        checks += [_check("cell", True, f"{cell.path.name} is in order"), _bus_port(cell)]
    return {"checks": checks, "ok": all(check["ok"] for check in checks)}


def _check(name: str, ok: bool, detail: str, fix: str = "") -> Check:
    return {"name": name, "ok": ok, "detail": detail, "fix": "" if ok else fix}


def _read(path: str, otherwise: str = "") -> str:
    try:
        return Path(path).read_text().strip()
    except OSError:
        return otherwise


def _processor() -> Check:
    cores = len(os.sched_getaffinity(0))
    return _check("processor", cores >= 2, f"{cores} cores", "two cores at least: one for the loop, one for the rest")


def _kernel() -> Check:
    """A real-time kernel is wanted on a real robot, yet nothing fails without: it is told, not refused."""
    real_time = _read("/sys/kernel/realtime") == "1"
    return _check("kernel", True, f"{platform.release()}, {'PREEMPT_RT' if real_time else 'not a real-time kernel'}")


def _priority() -> Check:
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    allowed = _may(lambda: os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1)))
    if allowed:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    fix = "as root add '@realtime - rtprio 99' to /etc/security/limits.d/realtime.conf and join that group"
    return _check("priority", allowed, f"SCHED_FIFO {'allowed' if allowed else f'refused (limit {limit})'}", fix)


def _memory_lock() -> Check:
    limit = realtime.lock_memory_limit()
    enough = limit < 0 or limit >= 1 << 30
    detail = "no limit" if limit < 0 else f"limit {limit / 1e6:.0f} MB"
    return _check("memory lock", enough, detail, "add '@realtime - memlock unlimited' to the same file as for priority")


def _clock() -> Check:
    source = _read("/sys/devices/system/clocksource/clocksource0/current_clocksource", "unknown")
    fast = source in ("tsc", "arch_sys_counter", "kvm-clock", "unknown")
    return _check("clock", fast, f"clock source {source}", "boot with clocksource=tsc: reading other sources is slow")


def _shared_memory() -> Check:
    free = shutil.disk_usage("/dev/shm").free / 1e6
    return _check(
        "shared memory", free > SHARED_MEMORY_MB, f"{free:.0f} MB free in /dev/shm", "remove dead sessions' asc-*"
    )


def _bus_port(cell: Cell) -> Check:
    host, _, port = cell.bus_endpoint.removeprefix("tcp/").rpartition(":")
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        free = _may(lambda: probe.bind((host, int(port))))
    detail = f"{cell.bus_endpoint} {'free' if free else 'in use'}"
    return _check("bus", free, detail, "end the session that runs, or set another bus.endpoint")


def _may(action: Callable[[], object]) -> bool:
    try:
        action()
    except OSError:
        return False
    return True
