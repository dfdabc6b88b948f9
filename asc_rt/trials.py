"""`asc trials`: the suites run in the simulator's own process, which the product never imports."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress


def run_trials(arguments: Sequence[str]) -> int:
    """`python -m sim_hil trials ARGUMENTS` with our own stdin, stdout and stderr; its exit code."""
    process = subprocess.Popen([sys.executable, "-m", "sim_hil", "trials", *arguments])
    while True:
        with suppress(KeyboardInterrupt):  # Ctrl-C reaches it too, and it ends by itself with what it has
            return process.wait()
