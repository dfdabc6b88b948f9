"""Small defects in the code that decides about safety are noticed by its tests."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

CAMPAIGN = Path(__file__).with_name("campaign.py")
SAMPLE = 3


def run(*options: str) -> dict[str, Any]:
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(CAMPAIGN), *options]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=CAMPAIGN.parents[2])
    result: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    assert (done.returncode == 0) == (not result["unexplained"] and not result["stale"]), done.stdout + done.stderr
    return result


@pytest.mark.timeout(900)  # cheap, but the machines are shared
def test_a_sample_of_mutants_is_killed() -> None:
    assert run("--sample", str(SAMPLE)) == {"mutants": SAMPLE, "killed": SAMPLE, "unexplained": [], "stale": []}


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_every_mutant_is_killed_or_has_a_reason() -> None:
    result = run("-j", str(os.cpu_count()))
    assert result["mutants"] > 500
    assert result["unexplained"] == result["stale"] == []
