"""Small requests and states for the tests of sampling, synthesis and certificates."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import pytest

from asc_rt.config import load_arm
from asc_rt.core import robot_model
from asc_rt.synthesis import sampling
from asc_rt.synthesis.certificate import Index
from asc_rt.synthesis.certify import Request, Result, certify
from asc_rt.synthesis.sampling import Ranges

RANGES = Ranges(
    d_low=0.05, d_high=0.8, v_max=1.0, speed_share=0.5, human_speed=1.0, human_acceleration=1.0, joint_limits=True,
    links="tool",
)  # fmt: skip
PAPER_LIKE = replace(RANGES, speed_share=1.0, human_speed=0.0, human_acceleration=0.0, joint_limits=False)


def make_request(robot: str = "panda", tool: str = "ee2", control: str = "torque", **changes: Any) -> Request:
    arm, held = load_arm(robot, tool)
    base = Request(arm, held, control, Index.PHI_STAR, RANGES, 0.05, 0.3, 1.0, 0.001, 3000, 7, 0.99)
    return replace(base, **changes)


@functools.cache
def make_result(**changes: Any) -> Result:
    return certify(make_request(**changes))


class _Names:
    RANGES, PAPER_LIKE = RANGES, PAPER_LIKE
    request, result = staticmethod(make_request), staticmethod(make_result)

    @staticmethod
    def model(robot: str = "panda", tool: str = "ee2", control: str = "torque") -> robot_model.RobotModel:
        return robot_model.load(*load_arm(robot, tool), control)

    @staticmethod
    def draw(model: robot_model.RobotModel, ranges: Ranges = RANGES, tool_capsules: int = 1) -> Any:
        return sampling.draw_of(model, tool_capsules, ranges)


@pytest.fixture(scope="session")
def bench() -> Any:
    """With --import-mode=importlib the tests cannot import from here."""
    return _Names()
