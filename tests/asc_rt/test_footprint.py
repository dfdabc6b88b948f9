"""The start of the control process stays small, and what only the start needs does not stay at all."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

GOAL_MB = 200.0  # of the whole start, kernels from their cache
PROGRAM = """
import json, re, sys
from pathlib import Path
from asc_rt import footprint, realtime
realtime.one_blas_thread()
footprint.lean_start()
from asc_rt import config, control
from asc_rt.core.system import System
from asc_rt.core.warm import warm_up

def held():  # MB of the pages that are as in the files of START_ONLY
    return sum(
        int(re.search(r"Rss: +([0-9]+)", figures)[1]) / 1024
        for _, _, rights, path, figures in footprint._MAPPING.findall(Path("/proc/self/smaps").read_text())
        if "w" not in rights and "Anonymous:             0 kB" in figures
        and any(name in path for name in ("llvmlite", "pinocchio", "coal", "eigenpy", "assimp"))
    )

cell = config.load_cell("fanuc-sim")
system = control.ready(cell)
peak = int(re.search(r"VmHWM:\\s+([0-9]+)", Path("/proc/self/status").read_text())[1]) / 1024
System(cell.params)  # as once the robot has told its limits
realtime.set_up(1, None)
before = held()
footprint.release()
after = held()
warm_up(system)  # decides as the loop does
print(json.dumps({"peak": peak, "before": before, "after": after, "in_loop": held(),
    "scipy": bool(sys.modules["scipy"])}))
"""


def start() -> Any:
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True, timeout=250)
    return json.loads(done.stdout.splitlines()[-1])


def test_the_start_is_small_and_gives_back_what_the_loop_does_not_need() -> None:
    start()  # may have to compile
    found = start()
    assert found["peak"] < GOAL_MB
    assert found["before"] > 5.0
    assert found["after"] == found["in_loop"] == 0.0
    assert not found["scipy"]
