"""`asc trials`: the ladder is part of the product; the other suites run in the simulator's own process, which the
product never imports."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress

from asc_rt import realtime


def run_trials(arguments: Sequence[str]) -> int:
    """`python -m sim_hil trials ARGUMENTS` with our own stdin, stdout and stderr, or the ladder; the exit code."""
    if arguments[:1] == ["ladder"]:
        realtime.one_blas_thread()  # before numpy is imported: recordings are replayed here
        from asc_rt.ladder import command

        return command.main(list(arguments[1:]))
    process = subprocess.Popen([sys.executable, "-m", "sim_hil", "trials", *arguments])
    while True:
        with suppress(KeyboardInterrupt):  # Ctrl-C reaches it too, and it ends by itself with what it has
            return process.wait()
