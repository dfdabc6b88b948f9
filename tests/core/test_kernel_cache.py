"""No kernel ever runs as the machine code of an older source."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

PACKAGE = Path(__file__).parents[2] / "asc_rt"
CALLER = """
from numba import njit
from asc_rt.core.inner import inner

@njit(cache=True)
def outer(x):
    return 10.0 * inner(x)

print(outer(1.0))
"""
INNER = """
from numba import njit

@njit(cache=True)
def inner(x):
    return x + {}
"""


def test_a_kernel_is_compiled_anew_when_one_that_it_calls_has_changed(tmp_path: Path) -> None:
    core = tmp_path / "asc_rt" / "core"
    core.mkdir(parents=True)
    shutil.copy(PACKAGE / "__init__.py", core.parent)
    (core / "__init__.py").touch()
    (core / "outer.py").write_text(CALLER)

    def run() -> float:
        command = [sys.executable, "-c", "import asc_rt.core.outer"]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=100, check=True)
        return float(done.stdout)

    for added in (1.0, 25.0):  # of other lengths: Python itself tells two sources of one second apart by that alone
        (core / "inner.py").write_text(INNER.format(added))
        assert run() == 10.0 * (1.0 + added)
    assert len(list((core / "__pycache__").glob("kernels-*"))) == 2  # and it was a cache at work
