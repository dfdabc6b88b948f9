"""The gate: a set-point exactly at a limit passes, one a little beyond it does not, for every limit and both ways."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from asc_rt.core.gate import ROUNDING, keeps_rows, may_pass, torque_may_pass
from asc_rt.core.safe_control import SOLVER_MARGIN
from asc_rt.core.smoothing import SetPoint
from asc_rt.core.system import System, initial
from asc_rt.core.types import CoreState, Mode, vector

T = 0.008
ONE = np.eye(6)[3]


def state_and_point(system: System, wide: float, side: float) -> dict[str, tuple[CoreState, SetPoint]]:
    """Joint 4 at `wide` times each of its limits, towards `side`, and everything else at rest."""
    b, zero = system.bounds, vector(np.zeros(6))
    rest = replace(initial(system), q_cmd=zero)
    still = SetPoint(zero, zero, zero, zero)
    end = np.where(ONE > 0, b.q_max if side > 0 else b.q_min, 0.0) + side * (wide - 1.0) * ONE
    speed, acceleration, jerk = (side * wide * limit * ONE for limit in (b.dq_max, b.ddq_max, b.dddq_max))
    return {
        "position": (replace(rest, q_cmd=vector(end)), replace(still, q=vector(end))),
        "speed": (rest, replace(still, dq=vector(speed))),
        "step": (rest, replace(still, q=vector(T * speed))),
        "acceleration": (replace(rest, ddq_cmd=vector(acceleration)), replace(still, ddq=vector(acceleration))),
        "jerk": (rest, replace(still, ddq=vector(T * jerk))),
    }


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("limit", ["position", "speed", "step", "acceleration", "jerk"])
def test_a_set_point_passes_up_to_each_limit_and_no_further(bench: Any, limit: str, side: float) -> None:
    system = bench.system()
    assert may_pass(system, *state_and_point(system, 1.0 + ROUNDING / 2, side)[limit])
    assert not may_pass(system, *state_and_point(system, 1.0 + 2 * ROUNDING, side)[limit])


@pytest.mark.parametrize("field", ["q", "dq", "ddq"])
def test_what_is_no_number_never_passes(bench: Any, field: str) -> None:
    system, zero = bench.system(), vector(np.zeros(6))
    still = SetPoint(zero, zero, zero, zero)
    rest = replace(initial(system), q_cmd=zero)
    assert may_pass(system, rest, still)
    for bad in (np.nan, np.inf):
        assert not may_pass(system, rest, replace(still, **{field: vector(np.where(ONE > 0, bad, 0.0))}))


def test_a_slower_tool_counts_while_it_works_and_the_arms_own_speed_while_it_stops(bench: Any) -> None:
    """Or a tool that came during a stop would end that stop in a fault."""
    params = bench.params()
    arms_own = np.array(params.robot.dq_max)
    slow = replace(params.robot, dq_max=tuple(0.5 * arms_own))
    system, zero = System(replace(params, robot=slow), arms_own), vector(np.zeros(6))
    for mode, fastest in ((Mode.ACTIVE, 0.5 * arms_own), (Mode.STOPPING, arms_own)):
        state = replace(initial(system), q_cmd=zero, mode=mode)
        for wide, passes in ((1.0, True), (1.01, False)):
            assert may_pass(system, state, SetPoint(zero, vector(wide * fastest * ONE), zero, zero)) is passes


def test_the_jerk_is_that_from_the_acceleration_before(bench: Any) -> None:
    system, zero = bench.system(), vector(np.zeros(6))
    one_period = T * system.bounds.dddq_max * ONE
    state = replace(initial(system), q_cmd=zero, ddq_cmd=vector(one_period))
    for share, passes in ((2.0, True), (2.01, False), (0.0, True), (-0.01, False)):
        assert may_pass(system, state, SetPoint(zero, zero, vector(share * one_period), zero)) is passes


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("field", ["tau", "ddq"])
def test_torque_passes_up_to_each_limit_and_no_further(bench: Any, field: str, side: float) -> None:
    effort = np.arange(10.0, 16.0)
    system: Any = SimpleNamespace(
        bounds=bench.system().bounds, model=SimpleNamespace(arm=SimpleNamespace(effort=effort))
    )
    limit = effort if field == "tau" else system.bounds.ddq_max
    zero = vector(np.zeros(6))
    still = SetPoint(zero, zero, zero, zero)
    for wide, passes in ((1.0 + ROUNDING / 2, True), (1.0 + 2 * ROUNDING, False), (np.nan, False)):
        assert torque_may_pass(system, replace(still, **{field: vector(side * wide * limit * ONE)})) is passes


def test_a_row_counts_as_kept_to_the_margin_of_the_solver() -> None:
    zero = vector(np.zeros(6))
    point = SetPoint(zero, zero, vector(2.0 * ONE), zero)
    C = np.array([ONE, -ONE])
    assert keeps_rows(point, C, np.array([2.0 + SOLVER_MARGIN / 2, -2.0]))
    assert not keeps_rows(point, C, np.array([2.0 + 2 * SOLVER_MARGIN, -2.0]))
    assert not keeps_rows(point, C, np.array([2.0, -2.0 + 2 * SOLVER_MARGIN]))
