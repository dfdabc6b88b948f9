"""An arm that is driven by torque, in closed loop with the exact motion that its torques make."""

from __future__ import annotations

import dataclasses

import numpy as np
import pinocchio as pin
import pytest

from asc_rt.config import load_cell
from asc_rt.core.abstraction import least_distance, separation
from asc_rt.core.fusion import heard
from asc_rt.core.people import predict
from asc_rt.core.step import step
from asc_rt.core.system import System, initial
from asc_rt.core.types import (
    CycleInputs,
    EventKind,
    Goal,
    Health,
    HumanState,
    JointState,
    Mode,
    OperatorEvent,
    RobotFlag,
    Vector,
    vector,
)

SEEN = HumanState(0, 1, 1, 0, Health.OK, 1.0, True, *[np.zeros((0, 3))] * 4, *[np.zeros(0)] * 3, np.zeros(0, np.int64))
INSIDE = 0.04  # m under d_min, where a person stands
APPROACH = 0.01  # m/s, of a robot that comes closer


def somebody_at(point: np.ndarray) -> HumanState:
    """A head, still, as a sensor sees it."""
    place, still, one = point[None], np.zeros((1, 3)), np.ones(1)
    return dataclasses.replace(
        SEEN, p0=place, p1=place, v0=still, v1=still, radius=0.1 * one, position_bound=0.02 * one,
        velocity_bound=0.3 * one, visibility=np.zeros(1, np.int64),
    )  # fmt: skip


def on_the_way(system: System, q: Vector, goal: Vector, distance: float) -> HumanState:
    """Somebody so far from the arm, where its end is to go."""
    model = system.model.pin_model
    ends = []
    for pose in (q, goal):
        data = model.createData()
        pin.forwardKinematics(model, data, pose)
        ends.append(np.array(data.oMi[system.n].translation))
    ahead = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    for way in np.linspace(0.0, 1.0, 2001):
        who = somebody_at(ends[0] + way * ahead)
        if least_distance(system.model.chain, system.model.capsules, predict(who, 0.0), q) >= distance:
            return who
    raise AssertionError("nowhere")


@pytest.mark.parametrize("name", ["panda-torque-sim", "openarm-sim"])
def test_held_off_by_a_person_it_stands_still(name: str) -> None:
    """The goal is behind somebody who came nearer than d_min. The rows end the approach; they must not shake the arm,
    which would come closer in every second cycle."""
    cell = load_cell(name)
    system = System(cell.params)
    T, n, p = system.params.period, system.n, system.params
    q, dq, state = np.radians(cell.sim["can"]["start_deg"]), np.zeros(n), initial(system)
    goal = Goal(1, vector(q + np.radians([40.0, 20.0, 0.0, 20.0, 0.0, 0.0, 0.0])))
    who = on_the_way(system, vector(q), goal.q, p.safety.d_min - INSIDE)
    closing, changes = [], []
    for k in range(400):
        now = k * p.period_ns
        human = dataclasses.replace(SEEN if k < 10 else who, t_capture_ns=now, seq=k)
        events = (OperatorEvent(1, EventKind.ARM),) if k == 2 else ()
        flags = RobotFlag.READY | RobotFlag.SERVO_ON
        joint = JointState(now, 0, k, vector(q), vector(dq), system.zero, flags, 0, True)
        told = goal if k > 20 else None
        before = state.ddq_cmd
        x = CycleInputs(k, now, p.period_ns, joint, human, 0, heard(human, 0), told, events, 0, False)
        state, out = step(system, state, x)
        u = state.ddq_cmd
        q, dq = q + T * dq + T * T * u / 2.0, dq + T * u
        if k > 100:
            s = p.safety
            pairs = separation(
                system.model.chain, system.model.capsules, predict(human, 0.0), q, dq, s.activation_distance, 0.0
            )
            near = pairs.d < s.d_min
            closing.append(float(np.max(-pairs.d_dot_robot[near], initial=0.0)))
            changes.append(float(np.max(np.abs(u - before))))
    assert state.mode is Mode.ACTIVE and out.command is not None
    assert max(closing) < APPROACH
    assert max(changes) < 1.0, "rad/s2 from one cycle to the next"


@pytest.mark.parametrize("name", ["panda-torque-sim", "openarm-sim"])
def test_a_goal_that_was_reached_is_held_stiffly(name: str) -> None:
    """Torques that are off by as much as 0.5 rad/s2 in each joint: the arm stays within 1 mrad of where it is sent."""
    cell = load_cell(name)
    system = System(cell.params)
    T, n, p = system.params.period, system.n, system.params
    q, dq, state = np.radians(cell.sim["can"]["start_deg"]), np.zeros(n), initial(system)
    goal, off, fastest = Goal(1, vector(q + 0.1)), 0.5, []
    flags = RobotFlag.READY | RobotFlag.SERVO_ON
    for k in range(round(4.0 / T)):
        now = k * p.period_ns
        human = dataclasses.replace(SEEN, t_capture_ns=now, seq=k)
        events = (OperatorEvent(1, EventKind.ARM),) if k == 2 else ()
        joint = JointState(now, 0, k, vector(q), vector(dq), system.zero, flags, 0, True)
        x = CycleInputs(k, now, p.period_ns, joint, human, 0, heard(human, 0), goal, events, 0, False)
        was_held = state.reached_id == 1
        state, _ = step(system, state, x)
        if k == round(3.0 / T):
            assert was_held
            off = -off  # what was held stiffly against one side now is pushed to the other
        u = state.ddq_cmd + (off if was_held else 0.0)
        q, dq = q + T * dq + T * T * u / 2.0, dq + T * u
        fastest.append(float(np.max(np.abs(dq))) if was_held else 0.0)
    assert state.mode is Mode.ACTIVE
    assert np.max(np.abs(q - goal.q)) < 1e-3
    assert max(fastest) < 3.0 * p.task.goal_tolerance + 0.02, "rad/s, where it only had to stay"
