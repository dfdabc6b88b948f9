"""The distances beside the rows, and what goes into the record of a decision."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from asc_rt.core.rows import Rows, decision, nearest_at_goal, nearest_measured, rows
from asc_rt.core.safe_control import Solution
from asc_rt.core.safety_index import phi_rate
from asc_rt.core.smoothing import SetPoint
from asc_rt.core.system import initial
from asc_rt.core.types import MAX_PAIRS, Goal, Mode, Status, StopReason, vector

AGE = 0.04  # s


def scene(bench: Any, count: int = 1) -> Any:
    """(state, inputs) of an arm that is measured elsewhere than it was sent, and people who come along y."""
    places = [[0.8 + 0.02 * i, 0.1, 0.4] for i in range(count)]
    human = bench.human(places, v=(0.0, -0.5, 0.0))
    x = bench.inputs(bench.joint(bench.HOME), human, human_age_ns=round(AGE * 1e9))
    system = bench.system()
    state = replace(initial(system), q_cmd=vector(bench.GOALS[1]), goal=Goal(1, vector(bench.GOALS[2])))
    return state, x


def after(human: Any, seconds: float) -> Any:
    return replace(human, p0=vector(human.p0 + seconds * human.v0), p1=vector(human.p1 + seconds * human.v1))


def test_the_measured_distance_is_of_the_arm_as_measured_from_the_people_of_now(bench: Any) -> None:
    system, (_, x) = bench.system(), scene(bench)
    expected = bench.true_distance(system, bench.HOME, after(x.human, AGE))
    assert nearest_measured(system, x) == pytest.approx(expected, abs=1e-9)
    assert nearest_measured(system, replace(x, joint=None)) == math.inf
    assert nearest_measured(system, replace(x, human=None)) == math.inf


def test_the_distance_at_the_goal_is_of_a_goal_that_there_is(bench: Any) -> None:
    system, (state, x) = bench.system(), scene(bench)
    expected = bench.true_distance(system, bench.GOALS[2], after(x.human, AGE))
    assert nearest_at_goal(system, state, x) == pytest.approx(expected, abs=1e-9)
    assert nearest_at_goal(system, replace(state, goal=replace(state.goal, id=0)), x) == math.inf
    assert nearest_at_goal(system, state, replace(x, human=None)) == math.inf


def answer(feasible: bool = True, filtered: bool = False) -> Solution:
    return Solution(vector(np.full(6, 0.1)), vector(np.full(6, 0.2)), feasible, filtered, 7, 0.25)


def told(bench: Any, state: Any, found: Rows | None, solution: Solution | None, ddq: Any = None) -> Any:
    zero = vector(np.zeros(6))
    point = None if ddq is None else SetPoint(zero, zero, vector(ddq), zero)
    return decision(bench.system(), state, found, solution, 0.5, 0.6, None, point)


def test_the_record_of_a_pair_is_its_row_and_what_was_sent(bench: Any) -> None:
    system, (state, x) = bench.system(), scene(bench, 2)
    found, ddq = rows(system, state, x), np.array([0.5, -0.4, 0.3, -0.2, 0.1, 0.6])
    made = told(bench, state, found, answer(), ddq)
    p, pairs = found.pairs, made.pairs
    assert made.pair_count == pairs.count == len(found.M) > 1
    np.testing.assert_allclose(pairs.achieved, found.C @ ddq, atol=1e-12)
    rates = [
        phi_rate(d, d_dot, achieved + drift, M, M_dot, system.index)
        for d, d_dot, achieved, drift, M, M_dot in zip(
            p.d, p.d_dot, found.C @ ddq, p.drift, found.M, found.M_dot, strict=True
        )
    ]
    np.testing.assert_allclose(pairs.phi_dot, rates, atol=1e-9)
    for name, expected in (
        ("robot", p.robot), ("human", p.human), ("d", p.d), ("d_dot", p.d_dot), ("M", found.M), ("M_dot", found.M_dot),
        ("phi", found.phi), ("floor", found.floor), ("basis", found.basis), ("outside", found.which[3]),
    ):  # fmt: skip
        np.testing.assert_array_equal(getattr(pairs, name), expected, name)
    assert not told(bench, state, found, answer(), None).pairs.achieved.any()


def test_more_pairs_than_there_is_room_for_are_counted(bench: Any) -> None:
    state, x = scene(bench, 12)
    found = rows(bench.system(), state, x)
    made = told(bench, state, found, answer())
    assert made.pair_count == len(found.M) > MAX_PAIRS == made.pairs.count
    np.testing.assert_array_equal(made.pairs.d, found.pairs.d[:MAX_PAIRS])


def test_without_rows_or_solution_the_record_has_none(bench: Any) -> None:
    state, _ = scene(bench)
    made = told(bench, state, None, None)
    assert (made.pair_count, made.pairs.count, made.iterations, made.share) == (0, 0, 0, 1.0)
    assert not made.u_ref.any() and not made.u_safe.any()
    assert (made.d_measured, made.d_goal) == (0.5, 0.6)
    solved, unsolved = told(bench, state, None, answer()), told(bench, state, None, answer(feasible=False))
    assert (solved.iterations, solved.share) == (unsolved.iterations, unsolved.share) == (7, 0.25)
    assert (solved.u_ref == 0.1).all() and (unsolved.u_ref == 0.1).all()
    assert (solved.u_safe == 0.2).all() and not unsolved.u_safe.any()


@pytest.mark.parametrize(
    ("mode", "reason", "solution", "status"),
    [
        (Mode.ACTIVE, StopReason.NONE, answer(), Status.PASS),
        (Mode.ACTIVE, StopReason.NONE, answer(filtered=True), Status.FILTERED),
        (Mode.STOPPING, StopReason.INFEASIBLE, answer(feasible=False), Status.INFEASIBLE),
        (Mode.STOPPING, StopReason.GATE, answer(), Status.STOPPED),
        (Mode.STOPPING, StopReason.HUMAN_STALE, None, Status.BAD_INPUT),
        (Mode.STOPPING, StopReason.OPERATOR_STOP, None, Status.STOPPED),
        (Mode.STOPPED, StopReason.HUMAN_STALE, None, Status.STOPPED),
        (Mode.ACTIVE, StopReason.NONE, None, Status.STOPPED),
    ],
)
def test_every_outcome_has_its_status(
    bench: Any, mode: Mode, reason: StopReason, solution: Solution | None, status: Status
) -> None:
    state, _ = scene(bench)
    assert told(bench, replace(state, mode=mode, reason=reason), None, solution).status is status
