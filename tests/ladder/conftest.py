from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from asc_rt.config import CELLS
from asc_rt.ladder.rules import Run
from asc_rt.ladder.steps import Step, load_steps
from calibration.geometry import pose
from calibration.result import Result, pose_value, rows
from sim_hil.calibration_cell import LOOKING
from tests.ladder.rig import Mischief, Rig

NEAR_GOALS = "task.goals_deg=[[-15, 5, 0, 0, -85, 0], [15, 5, 10, 0, -80, 0]]"
HOLDS = {1: 0.5, 2: 0.5, 3: 1.0, 8: 2.5, 10: 5.5}  # s, in simulated time
SECONDS = {7: 3.0, 10: 8.0}


def short(number: int) -> Step:
    """The step as it is, but for how long it lasts."""
    step = load_steps()[number - 1]
    task = replace(step.task, hold_s=HOLDS.get(number, step.task.hold_s), seconds=SECONDS.get(number, 6.0))
    limits = {**step.limits, "goals": min(step.limits.get("goals", 0), 14)}
    if number == 3:
        limits["active_s"] = 0.8
    if number == 5:
        task, limits = replace(task, count=2, speed=0.05), {**limits, "goals": 2, "speed_share": 0.055}
    return replace(step, task=task, limits=limits)


Climb = Callable[..., Run]


@pytest.fixture
def climb(tmp_path_factory: pytest.TempPathFactory) -> Climb:
    """climb(number, settings, mischief, cell): a step in lockstep, as it comes."""

    def run(
        number: int, settings: Sequence[str] = (), mischief: Mischief | None = None, name: str = "fanuc-sim-truth"
    ) -> Run:
        log = tmp_path_factory.mktemp("step") / "log.mcap"
        return Rig(short(number), log, [NEAR_GOALS, *settings], name, mischief).climb()

    return run


@pytest.fixture(scope="session")
def passed(tmp_path_factory: pytest.TempPathFactory) -> Callable[[int], Run]:
    """A run of this step in which nothing went wrong; the same each time."""

    @cache
    def run(number: int) -> Run:
        return Rig(short(number), tmp_path_factory.mktemp("passed") / "log.mcap", [NEAR_GOALS]).climb()

    return run


@pytest.fixture
def real(tmp_path: Path) -> Path:
    """A real cell that keeps what it is rehearsed with."""
    place = pose_value(pose(LOOKING, np.array([2.0, 0.0, 0.6])))
    about = {"serials": {"camera": "c1"}, "mode": "640x480"}
    Result("hand-eye", "T_base_cam", place, rows(np.eye(6) * 1e-8), "test", **about).save(tmp_path / "eye.json")
    text = (CELLS / "fanuc-sim-truth.toml").read_text()
    for old, new in {
        'name = "fanuc-sim-truth"': 'name = "mine"',
        "simulated = true ": f'certificates = "{CELLS / "certificates"}"\nsimulated = false ',
        'host = "127.0.0.1"': 'host = "192.168.1.10"',
        'calibration = "ground-truth"': 'camera = "c1"\ncamera_mode = "640x480"\ncalibration = "eye.json"',
        "[sim.human]": f'[sim.human]\ncalibration = "{tmp_path / "eye.json"}"',
    }.items():
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "mine.toml"
    path.write_text(text)
    return path
