"""The protective separation distance: the standard's sum, what it must grow with, and speeds against Pinocchio."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from asc_rt.core.params import MonitorParams
from asc_rt.core.separation_monitor import greatest_speed, protective_distance, ramped_down, stopping_time, watch
from asc_rt.core.system import System, initial
from asc_rt.core.types import vector

times, speeds, lengths = st.floats(0.0, 2.0), st.floats(0.0, 5.0), st.floats(0.0, 1.0)
monitors = st.builds(MonitorParams, human_speed=speeds, intrusion_distance=lengths, robot_uncertainty=lengths)


def test_the_budget_of_the_fact_sheet() -> None:
    """Age and reaction 0.16 s, stop 0.30 s, robot 1 m/s, C 0.30, Z_d 0.04, Z_r 0.01: 1.35 m, of which S_s 0.15 m by
    the S-curve instead of the sheet's 0.10 m."""
    found = protective_distance(MonitorParams(1.6, 0.30, 0.01), 1.0, 0.06, 0.10, 0.30, 0.04)
    assert found.S_h == pytest.approx(0.736)
    assert (found.S_r, found.S_s) == pytest.approx((0.10, 0.15))
    assert found.S_p == pytest.approx(0.736 + 0.10 + 0.15 + 0.30 + 0.04 + 0.01)


@given(monitor=monitors, v=speeds, age=times, react=times, stop=times, z=lengths, more=st.floats(0.01, 1.0))
def test_more_of_anything_asks_for_more_distance(
    monitor: MonitorParams, v: float, age: float, react: float, stop: float, z: float, more: float
) -> None:
    now = (v, age, react, stop, z)
    here = protective_distance(monitor, *now).S_p
    assert math.isfinite(here) and here >= 0.0
    for i in range(len(now)):
        grown = [value + more * (i == k) for k, value in enumerate(now)]
        assert protective_distance(monitor, *grown).S_p >= here
    for name in ("human_speed", "intrusion_distance", "robot_uncertainty"):
        worse = dataclasses.replace(monitor, **{name: getattr(monitor, name) + more})
        assert protective_distance(worse, *now).S_p >= here


@given(monitor=monitors, v=speeds, age=times, react=times, stop=st.floats(1e-3, 2.0), z=lengths)
def test_it_holds_what_may_happen_until_the_robot_stands(
    monitor: MonitorParams, v: float, age: float, react: float, stop: float, z: float
) -> None:
    """A person who walks straight in at v_h and a robot that meets them and brakes evenly do not touch."""
    steps = np.linspace(0.0, react + stop, 200)
    brakes = np.maximum(steps - react, 0.0)
    slowing = 0.5 * v * brakes**2 / max(stop, 1e-3)
    robot = v * steps - slowing
    person = monitor.human_speed * (age + steps)
    found = protective_distance(monitor, v, age, react, stop, z)
    assert np.all(robot + person <= found.S_p - found.C - found.Z_d - found.Z_r + 1e-9)


def test_data_from_the_future_make_no_distance_smaller() -> None:
    assert protective_distance(MonitorParams(), 1.0, -5.0, 0.1, 0.2, 0.0).S_h == pytest.approx(1.6 * 0.3)


@given(speed=st.floats(0.0, 6.0), A=st.floats(1.0, 100.0), J=st.floats(10.0, 2000.0))
def test_the_stopping_time_is_that_of_ruckig(speed: float, A: float, J: float) -> None:
    ruckig = pytest.importorskip("ruckig")
    request = ruckig.InputParameter(1)
    request.control_interface = ruckig.ControlInterface.Velocity
    request.current_velocity, request.target_velocity = [speed], [0.0]
    request.max_acceleration, request.max_jerk = [A], [J]
    plan = ruckig.Trajectory(1)
    ruckig.Ruckig(1).calculate(request, plan)
    found = stopping_time(np.array([speed]), np.array([A]), np.array([J]))
    assert found == pytest.approx(plan.duration, rel=1e-6, abs=1e-6)


def test_the_last_joint_counts_whichever_way_it_turns() -> None:
    limits = np.full(3, 10.0), np.full(3, 100.0)
    found = [stopping_time(np.array(dq), *limits) for dq in ([0.1, -4.0, 1.0], [4.0, 0.1, -1.0], [-1.0, 1.0, 4.0])]
    assert found == pytest.approx([4.0 / 10.0 + 10.0 / 100.0] * 3)


def test_a_joint_of_unknown_speed_never_rests() -> None:
    assert stopping_time(np.array([1.0, np.nan]), np.full(2, 10.0), np.full(2, 100.0)) == np.inf


def test_the_fastest_point_against_pinocchio(bench: Any) -> None:
    system = bench.system()
    rng = np.random.default_rng(3)
    model, params = system.model.pin_model, system.params
    data = model.createData()
    for _ in range(20):
        q, dq = rng.uniform(params.robot.q_min, params.robot.q_max), rng.normal(0.0, 1.0, params.n)
        pin.forwardKinematics(model, data, q, dq)
        pin.updateFramePlacements(model, data)
        fastest = 0.0
        for spec in (*params.robot.capsules, *params.tool.capsules):
            frame = model.getFrameId(spec.link, pin.BODY)
            v = pin.getFrameVelocity(model, data, frame, pin.LOCAL)
            if model.frames[frame].parentJoint == 0:
                continue
            ends = [np.linalg.norm(v.linear + np.cross(v.angular, p)) for p in (spec.p0, spec.p1)]
            fastest = max(fastest, max(ends) + spec.radius * float(np.linalg.norm(v.angular)))
        assert greatest_speed(system.model.chain, system.model.capsules, q, dq) == pytest.approx(fastest, rel=1e-9)


def test_a_speed_that_is_no_number_is_the_greatest(bench: Any) -> None:
    system = bench.system()
    assert greatest_speed(system.model.chain, system.model.capsules, bench.HOME, np.full(6, np.nan)) == np.inf


@example(v=0.5, a=-1.0, J=100.0)
@example(v=-0.5, a=1.0, J=100.0)
@given(v=st.floats(-6.0, 6.0), a=st.floats(-100.0, 100.0), J=st.floats(10.0, 2000.0))
def test_an_acceleration_is_ramped_down_before_the_joint_brakes(v: float, a: float, J: float) -> None:
    """Against the ramp itself, step by step: the joint is never faster than told, at its end as fast as told."""
    fastest, ramp = ramped_down(np.array([v]), np.array([a]), np.array([J]))
    t = np.linspace(0.0, abs(a) / J, 400)
    speeds = v + a * t - np.sign(a) * J * t * t / 2.0
    if v * a >= 0.0 or speeds[-1] * v < 0.0:
        assert ramp == pytest.approx(abs(a) / J)
        assert fastest[0] == pytest.approx(speeds[-1], abs=1e-9)
    else:
        assert (fastest[0], ramp) == (v, 0.0)
    assert np.all(np.abs(speeds) <= max(abs(v), abs(fastest[0])) + 1e-9)


def test_the_distance_is_that_of_the_motion_the_robot_was_told(bench: Any) -> None:
    """The arm is measured at rest in all of these: what was sent acts one latency later and may still grow."""
    rig = bench.Rig(bench.system(), lambda t: bench.human([[1.15, 0.0, 0.3]]))
    x, state, one = rig.cycle().x, rig.state, np.eye(6)[0]

    def told(dq: Any, ddq: Any) -> Any:
        found = watch(rig.system, dataclasses.replace(state, dq_cmd=vector(dq), ddq_cmd=vector(ddq)), x)
        assert found is not None
        return found

    rest, moves, starts = told(0 * one, 0 * one), told(one, 0 * one), told(0 * one, 5.0 * one)
    J = rig.system.bounds.dddq_max[0]
    assert rest.robot_speed == 0.0 and rest.stopping_time == 0.0
    assert moves.robot_speed == pytest.approx(
        greatest_speed(rig.system.model.chain, rig.system.model.capsules, state.q_cmd, one)
    )
    assert starts.reaction_time == pytest.approx(rest.reaction_time + 5.0 / J)
    after = (rig.system.params.period * 5.0 + 5.0**2 / (2.0 * J)) * one
    assert starts.stopping_time == pytest.approx(
        stopping_time(after, rig.system.bounds.ddq_max, rig.system.bounds.dddq_max)
    )
    assert rest.protective_distance < starts.protective_distance < moves.protective_distance


def seen_by(bench: Any, *people: Any, robot: Any = None, monitor: MonitorParams | None = None, **changes: Any) -> Any:
    """The figures of an arm at rest at HOME that people of these (place, position bound) are told of."""
    system = bench.system()
    if monitor is not None:
        system = System(dataclasses.replace(system.params, monitor=monitor))
    places, bounds = [place for place, _ in people], vector([bound for _, bound in people])
    human = bench.human(places, position_bound=bounds)
    joint = bench.joint(bench.HOME) if robot is None else robot
    state = dataclasses.replace(initial(system), q_cmd=vector(bench.HOME))
    return watch(system, state, bench.inputs(joint, human, **changes))


NEAR, AWAY = ([0.9, 0.0, 0.4], 0.0), ([1.5, 0.5, 0.4], 0.0)


def test_without_robot_or_people_there_are_no_figures(bench: Any) -> None:
    system = bench.system()
    joint, human = bench.joint(bench.HOME), bench.human([NEAR[0]])
    assert watch(system, initial(system), bench.inputs(joint, human)) is not None
    assert watch(system, initial(system), dataclasses.replace(bench.inputs(joint, human), human=None)) is None
    assert watch(system, initial(system), bench.inputs(None, human)) is None


def test_the_oldest_sensor_with_its_clock_error_is_the_age(bench: Any) -> None:
    system = bench.system()
    x = bench.inputs(bench.joint(bench.HOME), bench.human([NEAR[0]]))
    ages = ((90_000_000, 5_000_000), (10_000_000, 1_000_000))
    sensors = tuple(dataclasses.replace(x.sensors[0], age_ns=age, sigma_ns=sigma) for age, sigma in ages)
    for human_age_ns, age in ((30_000_000, 0.095), (120_000_000, 0.120)):
        found = watch(system, initial(system), dataclasses.replace(x, sensors=sensors, human_age_ns=human_age_ns))
        assert found.age == pytest.approx(age)


def test_an_arm_at_rest_reacts_within_a_cycle_and_its_latency(bench: Any) -> None:
    params = bench.system().params
    assert seen_by(bench, NEAR).reaction_time == pytest.approx(params.period + params.robot.command_latency_ns * 1e-9)


def test_the_least_certain_part_of_a_person_counts(bench: Any) -> None:
    certain = seen_by(bench, NEAR, AWAY)
    unsure = seen_by(bench, (NEAR[0], 0.02), (AWAY[0], 0.05))
    terms = certain.robot_speed, certain.age, certain.reaction_time, certain.stopping_time
    for found, bound in ((certain, 0.0), (unsure, 0.05)):
        expected = protective_distance(bench.system().params.monitor, *terms, bound).S_p
        assert found.protective_distance == pytest.approx(expected)
    assert unsure.distance == certain.distance > 0.0  # the bound is in S_p, and not in the distance as well


def test_a_person_at_an_unknown_place_is_at_the_robot(bench: Any) -> None:
    assert seen_by(bench, ([np.nan, 0.0, 0.4], 0.0)).distance == 0.0


@pytest.mark.parametrize("human_speed", [1.6, 0.0])
def test_a_robot_of_unknown_speed_is_never_far_enough(bench: Any, human_speed: float) -> None:
    joint = bench.joint(bench.HOME, dq=vector(np.full(6, np.nan)))
    found = seen_by(bench, AWAY, robot=joint, monitor=MonitorParams(human_speed=human_speed))
    assert found.protective_distance == math.inf and not found.is_kept
