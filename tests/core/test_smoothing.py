"""Set-points: the acceleration that was decided, reproduced; and the stop profile."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import ruckig

from asc_rt.core.brake import at_rest, brake
from asc_rt.core.gate import may_pass
from asc_rt.core.limits import command_box
from asc_rt.core.reference import reached, reference
from asc_rt.core.smoothing import SmoothingError, smooth
from asc_rt.core.system import initial
from asc_rt.core.types import Goal, StopReason, vector

T = 0.008


def states(system: Any, count: int, seed: int = 0) -> Any:
    """Any commanded state of an arm in motion, and controls at and between the bounds of its jerk box."""
    b = system.bounds
    rng = np.random.default_rng(seed)
    for i in range(count):
        dq, ddq = rng.uniform(-0.9, 0.9, 6) * b.dq_max, rng.uniform(-1.0, 1.0, 6) * b.ddq_max
        state = replace(initial(system), q_cmd=vector(rng.uniform(-1, 1, 6)), dq_cmd=vector(dq), ddq_cmd=vector(ddq))
        low, high = np.maximum(-b.ddq_max, ddq - T * b.dddq_max), np.minimum(b.ddq_max, ddq + T * b.dddq_max)
        share = rng.random(6) if i % 2 else rng.integers(0, 2, 6)
        yield state, low + (high - low) * share


def advance(state: Any, point: Any) -> Any:
    return replace(state, q_cmd=point.q, dq_cmd=point.dq, ddq_cmd=point.ddq)


def test_the_decided_acceleration_and_its_speed_are_what_is_sent(bench: Any) -> None:
    system = bench.system()
    for state, u in states(system, 1500):
        point = smooth(system, state, vector(u))
        np.testing.assert_allclose(point.ddq, u, atol=1e-9)
        np.testing.assert_allclose(point.dq, state.dq_cmd + T * (state.ddq_cmd + u) / 2.0, atol=1e-9)
        # `limits` counts on this way; Ruckig may bend within the period by a few micrometres' worth of jerk
        way = T * state.dq_cmd + T * T * (2.0 * state.ddq_cmd + u) / 6.0
        np.testing.assert_allclose(point.q, state.q_cmd + way, atol=2e-6)
        assert np.all(np.abs(point.ddq - state.ddq_cmd) <= T * system.bounds.dddq_max * (1.0 + 1e-9))


def test_a_control_that_no_profile_reaches_in_time_never_leaves_as_if_it_did(bench: Any) -> None:
    """Beyond the jerk limit, or no number: an error, or a set-point that the gate or the rows will refuse."""
    system = bench.system()
    rest = replace(initial(system), q_cmd=vector(bench.HOME))
    with pytest.raises(SmoothingError):
        smooth(system, rest, vector(np.full(6, np.nan)))
    late = smooth(system, rest, vector(3.0 * T * system.bounds.dddq_max))
    assert np.all(late.ddq <= T * system.bounds.dddq_max * (1.0 + 1e-5))


@pytest.mark.parametrize("result", [ruckig.Result.Error, ruckig.Result.ErrorExecutionTimeCalculation])
def test_a_planner_that_only_says_that_it_failed_is_believed(
    bench: Any, monkeypatch: pytest.MonkeyPatch, result: ruckig.Result
) -> None:
    system = bench.system()
    monkeypatch.setattr(system, "planner", SimpleNamespace(calculate=lambda request, plan: result))
    with pytest.raises(SmoothingError):
        smooth(system, initial(system), vector(np.zeros(6)))


def test_the_brake_comes_to_exact_rest_within_every_limit_and_its_bound_in_time(bench: Any) -> None:
    """From states that the joint bounds can bring about: driven there by an adversary at the bounds."""
    system = bench.system()
    b = system.bounds
    rng = np.random.default_rng(4)
    q, dq, ddq = np.zeros(6), np.zeros(6), np.zeros(6)
    side = np.ones(6)
    for k in range(4000):
        lower, upper = command_box(b, q, dq, ddq, T)
        if k % 97 == 0:
            side = rng.integers(0, 2, 6)
        u = lower + (upper - lower) * side
        q, dq, ddq = q + T * dq + T * T * (2.0 * ddq + u) / 6.0, dq + T * (ddq + u) / 2.0, u
        if k % 160 != 159:
            continue
        state = replace(initial(system), q_cmd=vector(q), dq_cmd=vector(dq), ddq_cmd=vector(ddq))
        peak = np.abs(dq) + ddq * ddq / (2.0 * b.dddq_max)
        longest = np.max(np.abs(ddq) / b.dddq_max + peak / b.ddq_max + 2.0 * b.ddq_max / b.dddq_max)
        cycles = 0
        while not at_rest(state):
            point = brake(system, state)
            assert may_pass(system, state, point)
            state = advance(state, point)
            cycles += 1
            assert cycles * T <= longest + 2.0 * T
        still = brake(system, state)
        np.testing.assert_array_equal(still.q, state.q_cmd)
        assert not np.any(still.dq) and not np.any(still.ddq)


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("joint", range(6))
def test_rest_is_every_joint_without_speed_and_acceleration(bench: Any, joint: int, side: float) -> None:
    state, one = initial(bench.system()), side * np.eye(6)[joint]
    assert at_rest(state)
    assert not at_rest(replace(state, dq_cmd=vector(1e-6 * one)))
    assert not at_rest(replace(state, ddq_cmd=vector(1e-3 * one)))


def test_planning_the_brake_anew_each_cycle_gives_the_same_profile(bench: Any) -> None:
    system = bench.system()
    r = system.params.robot
    for state, _ in states(system, 20, seed=2):
        request = ruckig.InputParameter(6)
        request.control_interface = ruckig.ControlInterface.Velocity
        request.synchronization = ruckig.Synchronization.No
        request.current_position, request.current_velocity = state.q_cmd.tolist(), state.dq_cmd.tolist()
        request.current_acceleration = state.ddq_cmd.tolist()
        request.target_velocity, request.target_acceleration = [0.0] * 6, [0.0] * 6
        request.max_acceleration, request.max_jerk = list(r.ddq_max), list(r.dddq_max)
        once = ruckig.Trajectory(6)
        ruckig.Ruckig(6).calculate(request, once)
        for k in range(1, 400):
            state = advance(state, brake(system, state))
            q, dq, _ = once.at_time(k * T)
            np.testing.assert_allclose(state.q_cmd, q, atol=5e-5)
            np.testing.assert_allclose(state.dq_cmd, dq, atol=1e-4)
            if at_rest(state):
                break
        assert at_rest(state)


def test_following_the_reference_reaches_the_goal_within_its_share_of_the_limits(bench: Any) -> None:
    system = bench.system()
    b, speed = system.bounds, system.params.task.speed
    state = replace(initial(system), q_cmd=vector(bench.HOME), goal=Goal(3, vector(bench.GOALS[0])))
    top = np.zeros(6)
    for _ in range(600):
        state = advance(state, smooth(system, state, reference(system, state)))
        top = np.maximum(top, np.abs(state.dq_cmd))
        if reached(system, state):
            break
    assert reached(system, state)
    assert np.all(np.abs(state.q_cmd - bench.GOALS[0]) <= system.params.task.goal_tolerance)
    assert np.all(top <= speed * b.dq_max * (1 + 1e-9)) and top.max() > 0.5


def test_passing_the_goal_in_motion_is_not_reaching_it(bench: Any) -> None:
    system = bench.system()
    state = replace(initial(system), q_cmd=vector(bench.HOME), goal=Goal(1, vector(bench.HOME)))
    assert reached(system, state)
    assert not reached(system, replace(state, dq_cmd=vector(np.full(6, 0.2))))
    assert not reached(system, replace(state, goal=Goal(0, vector(bench.HOME))))  # no goal was ever given


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("joint", range(6))
def test_a_goal_is_reached_from_either_side_by_every_joint(bench: Any, side: float, joint: int) -> None:
    system, one = bench.system(), side * np.eye(6)[joint]
    edge = system.params.task.goal_tolerance * one
    state = replace(initial(system), q_cmd=vector(bench.HOME), goal=Goal(1, vector(bench.HOME)))
    for share in (0.99, 1.01):
        assert reached(system, replace(state, q_cmd=vector(bench.HOME + share * edge))) == (share < 1.0)
        assert reached(system, replace(state, dq_cmd=vector(share * edge))) == (share < 1.0)


def test_the_reference_is_slow_where_something_asks_for_caution(bench: Any) -> None:
    system = bench.system()
    state = replace(initial(system), q_cmd=vector(bench.HOME), goal=Goal(3, vector(bench.GOALS[0])))
    top = {}
    for slow in (StopReason.NONE, StopReason.LATE):
        at = replace(state, slow=slow)
        speeds = []
        for _ in range(200):
            at = advance(at, smooth(system, at, reference(system, at)))
            speeds.append(np.max(np.abs(at.dq_cmd) / system.bounds.dq_max))
        top[slow] = max(speeds)
    assert top[StopReason.LATE] <= system.params.task.slow_speed * 1.002 < top[StopReason.NONE]


@pytest.mark.parametrize("result", [ruckig.Result.Error, ruckig.Result.ErrorExecutionTimeCalculation])
def test_a_way_that_cannot_be_planned_asks_for_no_acceleration(
    bench: Any, monkeypatch: pytest.MonkeyPatch, result: ruckig.Result
) -> None:
    system = bench.system()
    state = replace(initial(system), q_cmd=vector(bench.HOME), goal=Goal(3, vector(bench.GOALS[0])))
    assert np.any(reference(system, state))

    def fails(request: Any, plan: Any) -> ruckig.Result:
        ruckig.Ruckig(6).calculate(request, plan)  # there is something to take, but it is not to be trusted
        return result

    monkeypatch.setattr(system, "planner", SimpleNamespace(calculate=fails))
    assert not np.any(reference(system, state))


@pytest.mark.parametrize("wrong", ["position", "speed", "acceleration", "jerk", "jump", "nan"])
def test_the_gate_refuses_each_limit_that_is_broken(bench: Any, wrong: str) -> None:
    system = bench.system()
    b = system.bounds
    rest = replace(initial(system), q_cmd=vector(bench.HOME))
    good = brake(system, rest)
    assert may_pass(system, rest, good)
    one = np.eye(6)[2]
    bad, state = {
        "position": (replace(good, q=vector(b.q_max + 1e-4)), replace(rest, q_cmd=vector(b.q_max))),
        "speed": (replace(good, dq=vector(1.001 * b.dq_max * one)), rest),
        "acceleration": (
            replace(good, ddq=vector(1.001 * b.ddq_max * one)),
            replace(rest, ddq_cmd=vector(b.ddq_max * one)),
        ),
        "jerk": (replace(good, ddq=vector(1.01 * T * b.dddq_max * one)), rest),
        "jump": (replace(good, q=vector(bench.HOME + 1.01 * T * b.dq_max * one)), rest),
        "nan": (replace(good, q=vector(bench.HOME * np.nan)), rest),
    }[wrong]
    assert not may_pass(system, state, bad)
