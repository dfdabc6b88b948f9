"""`python can_mover.py`: a controller of the cell openarm-sim without core, person and log: sways the arm until killed.

Says "moving" once it does; ends with one line of JSON: why, and how many silent cycles had passed when the driver
noticed. A start that is refused is tried again, as a person would after reading why: a machine that is busy for a
moment loses answers.
"""

from __future__ import annotations

import json
import sys
import time

from asc_rt import realtime

if __name__ == "__main__":
    realtime.one_blas_thread()  # before anything below imports numpy

import numpy as np

from asc_rt.config import load_cell
from asc_rt.core import torque
from asc_rt.core.system import System
from asc_rt.core.types import CommandKind, JointCommand, Vector, vector
from drivers.base import DriverError
from drivers.can.driver import Can
from drivers.can.reactions import Fault

STARTS = 5  # at most
PRIORITY = 60


def main() -> int:
    cell = load_cell("openarm-sim")
    system = System(cell.params)
    driver = Can({**cell.driver_options, "hold_s": 0.1, "stale_ms": 100.0, "watchdog_ms": 100.0})
    driver.dynamics = lambda q, dq, ddq: torque.set_point(system, vector(q), vector(dq), vector(ddq)).tau
    driver.dynamics(*np.zeros((3, system.n)))  # its kernels are loaded now, or compiled, and not in the stream
    realtime.set_up(PRIORITY, None)
    silent, noticed, told = 0, 0, 0  # cycles without an answer; how many there were when the driver told of it
    try:
        q0 = start(driver, cell.params.period_ns)
        print("moving", flush=True)
        for k in range(5000):
            begin = time.monotonic_ns()
            q, dq = q0 + 0.4 * (1 - np.cos(k * 0.008)), 0.4 * 2.0 * np.sin(k * 0.008) * np.ones(7)
            tau = driver.dynamics(q, dq, np.zeros(7))
            driver.write(JointCommand(k, CommandKind.POSITION, vector(q), vector(dq), tau, False))
            time.sleep(max(0, begin + 4_000_000 - time.monotonic_ns()) * 1e-9)
            silent = silent + 1 if driver.read(time.monotonic_ns() + 1_000_000) is None else 0
            before, told = told, driver.report()["found"].get(Fault.SILENT, 0)
            if not silent:
                noticed = 0
            elif told > before and not noticed:
                noticed = silent
        why = "end"
    except DriverError as error:
        why, noticed = str(error), noticed or silent
    driver.close()
    print(json.dumps({"why": why, "noticed": noticed}), flush=True)
    return 0


def start(driver: Can, period_ns: int) -> Vector:
    """The pose at the start. DriverError: refused to the end."""
    for left in reversed(range(STARTS)):
        try:
            driver.configure()
            return driver.activate(period_ns).q
        except DriverError as error:
            print(f"start refused: {error} | do: {error.hint}", flush=True)
            if not left:
                raise
    raise AssertionError


if __name__ == "__main__":
    sys.exit(main())
