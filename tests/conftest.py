"""For all tests: kernels are compiled before any test runs, hypothesis draws its examples, and nobody is judged by the
clock."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import settings

import asc_rt  # noqa: F401  (it chooses where the compiled kernels are)

# The tests start a hundred processes: each would compile its imports, 15 s of CPU, where Python may not keep them.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

settings.register_profile("asc", deadline=None)  # the machines are shared: a slow example is no fault
settings.load_profile("asc")

KERNELS = Path(os.environ["NUMBA_CACHE_DIR"])
COMPILE = """
from asc_rt.config import load_cell
from asc_rt.core.system import System
from asc_rt.core.warm import warm_up

for cell in ("fanuc-sim-truth", "panda-torque-sim"):  # one of each control level
    warm_up(System(load_cell(cell).params))
"""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests marked `real_time` are repeated, twice at most: the report counts them as reruns. A virtual machine stands
    still for up to 79 ms (MEASURED, by a SCHED_FIFO process that only sleeps); a session in it rightly ends then, and
    proves nothing of what was to be seen. What is wrong by itself fails three times."""
    for item in items:
        if item.get_closest_marker("real_time"):
            item.add_marker(pytest.mark.flaky(reruns=2))


def pytest_sessionstart(session: pytest.Session) -> None:
    """A minute of compiling, once: in a test it would count against that test's time limit, and both workers of a
    fresh tree would compile the same kernels at once."""
    if not hasattr(session.config, "workerinput") and not KERNELS.exists():
        subprocess.run([sys.executable, "-c", COMPILE], check=False)
