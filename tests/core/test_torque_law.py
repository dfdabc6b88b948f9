"""The torque of a set-point against Pinocchio, and what the reference and the stop ask for, joint by joint."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from asc_rt.config import load_cell
from asc_rt.core.levels import LEVELS
from asc_rt.core.smoothing import SmoothingError
from asc_rt.core.system import System, initial
from asc_rt.core.torque import HELD, ON_THE_WAY, REST_SPEED, reference, set_point, stop
from asc_rt.core.types import Goal, Mode, StopReason, vector

ONE = np.array([1.0, -1.0, 0.5, -0.5, 0.25, -0.25, 0.1])


@functools.cache
def panda() -> System:
    return System(load_cell("panda-torque-sim").params)


def middle(system: System) -> Any:
    return vector(0.5 * (system.bounds.q_min + system.bounds.q_max))


def moving(q: Any, dq: Any, **changes: Any) -> Any:
    return dataclasses.replace(initial(panda()), q_cmd=vector(q), dq_cmd=vector(dq), **changes)


def sampled(bench: Any, q: Any, dq: Any) -> Any:
    return bench.inputs(bench.joint(q, dq=vector(dq)))


def acceleration(q: Any, dq: Any, tau: Any) -> Any:
    """What the torque does to the arm, by Pinocchio."""
    model = panda().model.pin_model
    return pin.aba(model, model.createData(), np.array(q), np.array(dq), np.array(tau))


def test_the_torque_of_a_set_point_is_that_of_the_inverse_dynamics() -> None:
    system, rng = panda(), np.random.default_rng(0)
    T, b = system.params.period, system.bounds
    for _ in range(20):
        q, dq, u = rng.uniform(b.q_min, b.q_max), rng.uniform(-b.dq_max, b.dq_max), rng.uniform(-5.0, 5.0, system.n)
        point = set_point(system, vector(q), vector(dq), vector(u))
        np.testing.assert_allclose(point.q, q + T * dq, rtol=1e-12)
        np.testing.assert_allclose(point.dq, dq + T * u, rtol=1e-12)
        np.testing.assert_array_equal(point.ddq, u)
        np.testing.assert_allclose(acceleration(q, dq, point.tau), u, atol=1e-8)


@pytest.mark.parametrize("speed", [0.002, 1.0])
@pytest.mark.parametrize("heard", [True, False])
def test_a_stop_takes_the_speed_away_in_four_cycles_or_as_fast_as_it_may(bench: Any, speed: float, heard: bool) -> None:
    """Of the measured arm; without a sample of the one that was commanded."""
    system = panda()
    dq, q = speed * ONE, middle(system)
    x = sampled(bench, q, dq) if heard else dataclasses.replace(sampled(bench, q, dq), joint=None)
    state = moving(q, 0.5 * ONE) if heard else moving(q, dq)
    point = stop(system, state, x)
    wanted = np.clip(-dq / (4.0 * system.params.period), -system.bounds.ddq_max, system.bounds.ddq_max)
    np.testing.assert_allclose(point.ddq, wanted, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(acceleration(q, dq, point.tau), wanted, rtol=1e-4, atol=1e-4)


def test_at_rest_the_stop_holds_the_pose_that_was_sent(bench: Any) -> None:
    system = panda()
    off = 1e-4 * ONE
    sent = middle(system)
    point = stop(system, moving(sent, 0.0 * ONE), sampled(bench, sent - off, 0.01 * off))
    assert (point.q == sent).all() and not point.dq.any() and not point.ddq.any()
    wanted = HELD[1] * (HELD[0] * off - 0.01 * off)
    np.testing.assert_allclose(acceleration(sent - off, 0.01 * off, point.tau), wanted, rtol=1e-4, atol=1e-6)


def test_an_arm_that_its_torques_cannot_hold_is_left_to_its_brakes(bench: Any) -> None:
    params = panda().params
    weak = System(dataclasses.replace(params, robot=dataclasses.replace(params.robot, effort=(0.1,) * 7)))
    q = middle(weak)
    with pytest.raises(SmoothingError):
        stop(weak, moving(q, 0.1 * ONE), sampled(bench, q, 0.1 * ONE))


@pytest.mark.parametrize(
    ("slow", "slow_speed", "share"),
    [(StopReason.NONE, 0.1, 0.5), (StopReason.LATE, 0.1, 0.1), (StopReason.LATE, 0.9, 0.5)],
)
def test_far_from_the_goal_all_joints_go_alike_at_the_tasks_speed(
    slow: StopReason, slow_speed: float, share: float
) -> None:
    task = dataclasses.replace(panda().params.task, speed=0.5, slow_speed=slow_speed)
    system = System(dataclasses.replace(panda().params, task=task))
    dq, q = 0.05 * ONE[::-1], middle(system)
    for side in (1.0, -1.0):
        way = side * 0.9 * np.abs(ONE)
        state = moving(q, dq, goal=Goal(1, vector(q + way)), slow=slow)
        speeds = reference(system, state) / ON_THE_WAY[1] + dq  # what the joints are to go
        assert np.max(side * speeds / system.bounds.dq_max) == pytest.approx(share)
        np.testing.assert_allclose(speeds / way, np.full(7, speeds[0] / way[0]))


@pytest.mark.parametrize("where", ["near", "reached", "reached, one joint off", "in place, not reached"])
def test_a_goal_is_approached_softly_and_held_stiffly(where: str) -> None:
    system = panda()
    tolerance, q, dq = system.params.task.goal_tolerance, middle(system), 0.001 * ONE
    way = {"near": 0.05 * ONE, "reached, one joint off": 0.1 * tolerance * ONE}.get(where, 0.01 * tolerance * ONE)
    if where == "reached, one joint off":
        way = np.where(np.arange(7) == 1, -1.1 * tolerance, way)
    state = moving(q, dq, goal=Goal(3, vector(q + way)), reached_id=3 if where.startswith("reached") else 2)
    a, b = HELD if where == "reached" else ON_THE_WAY
    np.testing.assert_allclose(reference(system, state), b * (a * way - dq), rtol=1e-9)


def test_a_held_goal_is_crept_back_to() -> None:
    """At the edge of the tolerance no faster than the arm came in."""
    system = panda()
    tolerance, q = system.params.task.goal_tolerance, middle(system)
    way = 0.9 * tolerance * np.sign(ONE)
    state = moving(q, 0.0 * ONE, goal=Goal(3, vector(q + way)), reached_id=3)
    np.testing.assert_allclose(reference(system, state) / HELD[1], ON_THE_WAY[0] * tolerance * np.sign(ONE), rtol=1e-9)


TRACK = LEVELS["torque"].track


@pytest.mark.parametrize("mode", list(Mode))
def test_what_is_measured_is_followed_in_motion_only(bench: Any, mode: Mode) -> None:
    """At rest nothing may drag the held pose along; without a sample there is nothing to follow."""
    system, q = panda(), middle(panda())
    state = moving(q, 0.1 * ONE, mode=mode, ddq_cmd=vector(0.3 * ONE))
    x = sampled(bench, q + 0.01, 0.2 * ONE)
    assert TRACK(system, state, dataclasses.replace(x, joint=None)) is state
    after = TRACK(system, state, x)
    if mode in (Mode.ACTIVE, Mode.STOPPING):
        assert (after.q_cmd == q + 0.01).all() and (after.dq_cmd == 0.2 * ONE).all()
        assert (after.ddq_cmd == state.ddq_cmd).all()
    else:
        assert after is state


@pytest.mark.parametrize("mode", [Mode.ACTIVE, Mode.STOPPING])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_stop_ends_where_every_joint_hardly_moves(bench: Any, mode: Mode, side: float) -> None:
    system, q = panda(), middle(panda())
    state = moving(q, 0.1 * ONE, mode=mode, ddq_cmd=vector(0.3 * ONE))
    for share in (0.99, 1.01):
        dq = np.where(np.arange(7) == 3, side * share * REST_SPEED, 0.0)
        after = TRACK(system, state, sampled(bench, q + 0.01, dq))
        assert (after.q_cmd == q + 0.01).all()
        rests = mode is Mode.STOPPING and share < 1.0
        assert (after.dq_cmd == (0.0 * dq if rests else dq)).all()
        assert after.ddq_cmd.any() != rests
