"""Set up the calling process for the loop, check it, and say what was achieved: nothing is silently missing.

Called last before the loop, when every library has started its own threads: a thread made after the priority was raised
would inherit it and could starve the loop.
"""

from __future__ import annotations

import ctypes
import gc
import os
import resource
import sys
import threading
from collections.abc import Callable
from typing import Any

BLAS_VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
TIMER_SLACK_NS = 1  # the default of 50 us is added to every wake-up of a non-real-time process

_PR_SET_TIMERSLACK = 29
_MCL_CURRENT, _MCL_FUTURE = 1, 2


def one_blas_thread() -> None:
    """Must run before numpy is imported; RuntimeError if it is too late."""
    if "numpy" in sys.modules:
        raise RuntimeError("numpy was imported before its threads were limited")
    for variable in BLAS_VARIABLES:
        os.environ[variable] = "1"


def leave(cpu: int | None) -> None:
    """This process, and all that it starts, leaves core `cpu` to the loop, which pins itself there: whoever else has a
    real-time priority must not be able to hold it up. With no other core nothing changes."""
    if others := os.sched_getaffinity(0) - {cpu}:
        os.sched_setaffinity(0, others)


def set_up(priority: int, cpu: int | None) -> dict[str, Any]:
    """Priority, core, memory, timer, garbage collector. The report: what was achieved, and `missing` with reasons."""
    missing: list[str] = []
    report: dict[str, Any] = {
        "fifo_priority": _try(missing, "SCHED_FIFO", lambda: _fifo(priority)),
        "cpu": _try(missing, "core affinity", lambda: _pin(cpu)),
        "memory_locked": bool(_try(missing, "memory lock", _lock_memory)),
        "timer_slack_ns": _try(missing, "timer slack", _timer_slack),
        "blas_threads": os.environ.get(BLAS_VARIABLES[0], "not limited"),
        "python_threads": threading.active_count(),
    }
    if report["python_threads"] > 1:
        missing.append(f"single thread: {', '.join(t.name for t in threading.enumerate())} run in this interpreter")
    if report["blas_threads"] != "1":
        missing.append("one BLAS thread: set before numpy is imported")
    gc.collect()
    gc.freeze()
    gc.disable()
    report["gc"] = "off"
    report["missing"] = missing
    return report


def lock_memory_limit() -> int:
    """Bytes that this process may lock; -1: no limit."""
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    return -1 if limit == resource.RLIM_INFINITY or os.geteuid() == 0 else limit


def _try(missing: list[str], name: str, action: Callable[[], Any]) -> Any:
    try:
        return action()
    except OSError as error:
        missing.append(f"{name}: {error.strerror}")
        return None


def _fifo(priority: int) -> int:
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    return priority


def _pin(cpu: int | None) -> list[int]:
    if cpu is not None:
        os.sched_setaffinity(0, {cpu})
    return sorted(os.sched_getaffinity(0))


def _lock_memory() -> bool:
    """Future pages too only where the limit allows it: else the next allocation beyond it would fail."""
    flags = _MCL_CURRENT | (_MCL_FUTURE if lock_memory_limit() < 0 else 0)
    _check(ctypes.CDLL(None, use_errno=True).mlockall(flags))
    return True


def _timer_slack() -> int:
    _check(ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(TIMER_SLACK_NS), 0, 0, 0))
    return TIMER_SLACK_NS


def _check(result: int) -> None:
    if result != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
