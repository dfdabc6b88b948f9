"""The start of the control process stays small, and what only the start needs does not stay at all."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
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


KERNEL = """
from numba import njit

@njit(cache=True)
def twice(x):
    return 2.0 * x
"""
PROGRAM_OF_IT = """
import os, sys
from asc_rt import footprint
os.environ["NUMBA_CACHE_DIR"] = sys.argv[1] + "/cache"
sys.path.insert(0, sys.argv[1])
from kernel_of_it import twice
print("begins")
with footprint.anew_if_compiled():
    twice(1.0)
print("goes on", sys.argv[2])
"""


def test_what_had_to_compile_starts_anew_with_what_is_in_the_cache(tmp_path: Path) -> None:
    (tmp_path / "kernel_of_it.py").write_text(KERNEL)
    program = tmp_path / "program.py"
    program.write_text(PROGRAM_OF_IT)

    def told() -> list[str]:
        command = [sys.executable, str(program), str(tmp_path), "an argument"]
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=100, env=ENVIRONMENT)
        return done.stdout.splitlines()

    assert told() == ["begins", "begins", "goes on an argument"]
    assert told() == ["begins", "goes on an argument"]


def test_where_no_kernel_can_be_kept_it_goes_on_with_what_it_compiled(tmp_path: Path) -> None:
    (tmp_path / "kernel_of_it.py").write_text(KERNEL.replace("cache=True", "cache=False"))
    (tmp_path / "program.py").write_text(PROGRAM_OF_IT)
    command = [sys.executable, str(tmp_path / "program.py"), str(tmp_path), "an argument"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=100, env=ENVIRONMENT)
    assert done.stdout.splitlines() == ["begins", "begins", "goes on an argument"]
