"""The real core drives the simulated arms by torque, in lockstep: driver, bus, drives and MuJoCo in one thread."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from can_rig import Rig

from asc_rt.config import load_cell
from asc_rt.core import torque
from asc_rt.core.fusion import heard
from asc_rt.core.step import step
from asc_rt.core.system import System, initial
from asc_rt.core.types import (
    CycleInputs,
    CycleOutputs,
    EventKind,
    Goal,
    Health,
    HumanState,
    Mode,
    OperatorEvent,
    Status,
    StopReason,
    vector,
)
from drivers.base import JointState
from sim_hil.can.line import TICK_NS
from sim_hil.person import Person
from sim_hil.plant import MujocoPlant
from sim_hil.trials.episode import Armer
from sim_hil.trials.judge import Judge
from sim_hil.trials.sensing import Camera, Quality

LONG = (pytest.mark.slow, pytest.mark.timeout(1200))
NOBODY = HumanState(
    0, 1, 1, 0, Health.OK, 1.0, True, *[np.zeros((0, 3))] * 4, *[np.zeros(0)] * 3, np.zeros(0, np.int64)
)


class Arm:
    """The MuJoCo arm as mechanics of a line."""

    def __init__(self, params: Any, q0: np.ndarray) -> None:
        self.plant = MujocoPlant(dataclasses.replace(params, period_ns=TICK_NS), q0)

    @property
    def q(self) -> np.ndarray:
        return self.plant.q

    @property
    def dq(self) -> np.ndarray:
        return self.plant.dq

    def step(self, tau: np.ndarray, braked: np.ndarray, seconds: float) -> None:
        self.plant.set_torque(tau)
        self.plant.set_brakes(braked)
        self.plant.step()


class Session:
    """A cell with nobody in it, from the first sample on."""

    def __init__(self, name: str) -> None:
        cell = load_cell(name)
        self.system = System(cell.params)
        self.q0 = np.radians(cell.sim["can"]["start_deg"])
        self.rig = Rig(cell.driver["arm"], mechanics=Arm(cell.params, self.q0))
        self.rig.line.on_stand = "stand" in cell.sim["can"]
        driver = self.rig.driver
        driver.dynamics = lambda q, dq, ddq: torque.set_point(self.system, q, dq, ddq).tau
        driver.configure()
        driver.activate(cell.params.period_ns)
        self.state, self.tick = initial(self.system), 0
        self.period_ns = cell.params.period_ns

    def run(self, cycles: int, goal: Goal | None = None, arm: bool = False) -> list[CycleOutputs]:
        made = []
        for k in range(cycles):
            joint = self.sample()
            events = (OperatorEvent(self.tick + 1, EventKind.ARM),) if arm and k == 0 else ()
            out = self.decide(self.inputs(joint, NOBODY, 0, goal, events))
            if out.stop is not None:
                break
            made.append(out)
        return made

    def sample(self) -> JointState | None:
        self.rig.wait()
        return self.rig.driver.read(self.rig.now_ns() + self.period_ns // 4)

    def decide(self, x: CycleInputs) -> CycleOutputs:
        self.state, out = step(self.system, self.state, x)
        if out.command is not None:
            self.rig.driver.write(out.command)
        if out.stop is not None:
            self.rig.driver.stop(out.stop)
        self.tick += 1
        return out

    def inputs(
        self,
        joint: JointState | None,
        human: HumanState,
        age_ns: int,
        goal: Goal | None,
        events: tuple[OperatorEvent, ...] = (),
    ) -> CycleInputs:
        now = self.rig.now_ns()
        human = dataclasses.replace(human, t_capture_ns=now - age_ns, seq=self.tick)
        return CycleInputs(
            self.tick, now, self.period_ns, joint, human, age_ns, heard(human, age_ns), goal, events, 0, False
        )

    @property
    def q(self) -> np.ndarray:
        return self.rig.line.mechanics.q


@pytest.mark.parametrize("name", ["openarm-sim", "panda-torque-sim"])
def test_it_moves_to_a_goal_and_holds_it_under_gravity(name: str) -> None:
    """Holding, and at a goal in ACTIVE, where the reference is far softer: a step of a wrist's torque would show."""
    session = Session(name)
    session.run(150)
    assert session.state.mode is Mode.HOLD
    assert np.max(np.abs(session.q - session.state.q_cmd)) < 1e-3, "holds where it was enabled"
    goal = Goal(1, vector(session.q0 + np.radians([15, 5, 0, -10, 5, 5, 5])))
    session.run(1000, goal, arm=True)
    assert session.state.mode is Mode.ACTIVE and session.state.reached_id == 1
    worst = np.zeros(7)
    for _ in range(100):
        session.run(1, goal)
        worst = np.maximum(worst, np.abs(session.q - goal.q))
    print(name, "steady error mrad", worst * 1e3)
    assert worst.max() < 1e-3, f"steady error {worst * 1e3} mrad"
    assert session.rig.driver.report()["missed"] == 0


@pytest.mark.parametrize("name", ["openarm-sim", "panda-torque-sim"])
def test_an_axis_that_something_holds_is_seen_under_torque_control(name: str) -> None:
    session = Session(name)
    goal = Goal(1, vector(session.q0 + np.radians([60, 0, 0, 0, 0, 0, 0])))
    session.run(20)
    session.run(60, goal, arm=True)
    assert session.state.mode is Mode.ACTIVE and session.rig.line.mechanics.dq[0] > 0.2
    session.rig.strike("block", 1)
    made = session.run(40, goal)
    assert session.state.reason is StopReason.ROBOT_FAULTED and len(made) < 30
    assert "axis 1: following error" in str(session.rig.driver.fault)


@pytest.mark.parametrize("name", ["openarm-sim", "panda-torque-sim"])
def test_a_drive_that_fails_in_motion_ends_the_session_and_the_rest_of_the_arm_stops_and_holds(name: str) -> None:
    session = Session(name)
    goal = Goal(1, vector(session.q0 + np.radians([30, 5, 0, -10, 5, 5, 5])))
    session.run(20)
    session.run(60, goal, arm=True)
    session.rig.strike("trip", 7)
    session.run(5, goal)
    assert session.state.mode is Mode.FAULT and session.state.reason is StopReason.ROBOT_FAULTED
    rest = session.q
    session.rig.run(500_000_000)
    np.testing.assert_allclose(session.q[:6], rest[:6], atol=0.02)
    assert np.max(np.abs(session.rig.line.mechanics.dq[:6])) < 0.02


@pytest.mark.parametrize("name", ["openarm-sim", "panda-torque-sim"])
def test_a_hot_drive_slows_the_arm_down_until_it_has_cooled(name: str) -> None:
    session = Session(name)
    task, dq_max = session.system.params.task, session.system.bounds.dq_max
    goal = Goal(1, vector(session.q0 + np.radians([60, 0, 0, 0, 0, 0, 0])))
    session.run(20)
    session.run(60, goal, arm=True)
    slow = 1.15 * min(task.speed, task.slow_speed) * dq_max[0]  # a reference without integral: to a tenth

    def speed() -> float:
        return float(session.rig.line.mechanics.dq[0])

    assert speed() > 1.5 * slow
    session.rig.strike("hot", 7, 86.0)
    session.run(120, goal)
    assert session.state.mode is Mode.ACTIVE and session.state.slow is StopReason.ROBOT_WARM
    assert 0.5 * slow < speed() <= slow
    session.rig.strike("hot", 7, 50.0)
    session.run(40, goal)
    assert session.state.slow is StopReason.NONE and speed() > 1.5 * slow


@pytest.mark.parametrize("name", ["openarm-sim", "panda-torque-sim"])
@pytest.mark.parametrize(
    ("seconds", "seed"), [(15.0, 1), *[pytest.param(60.0, seed, marks=LONG) for seed in range(2, 6)]]
)
def test_beside_a_person_it_comes_no_closer_by_itself_and_does_not_shake(name: str, seconds: float, seed: int) -> None:
    """Who walks in and out and reaches, seen at 60 Hz, 30 to 45 ms old, with noise. The speeds are the driver's: told
    in coarse steps, or differenced."""
    session, cell = Session(name), load_cell(name)
    plant, T = session.rig.line.mechanics.plant, session.period_ns * 1e-9
    person, operator, judge = Person(seed), Armer(T), Judge(session.system, plant)
    camera = Camera(person, Quality(60.0, (0.03, 0.045), 0.01, 0.1, 0.02, 0.3), seed)
    goals, goal, changes = [vector(q) for q in cell.goals], None, []
    for k in range(round(seconds / T)):
        plant.set_person(person.at(k * T))
        judge.look(k * T)
        joint, seen = session.sample(), camera.at((k + 1) * T)
        if k > 10 and (goal is None or session.state.reached_id == goal.id):
            number = 1 if goal is None else goal.id + 1
            goal = Goal(number, goals[number % len(goals)])
        x = session.inputs(joint, seen[0] if seen else NOBODY, round(seen[1] * 1e9) if seen else 0, goal)
        before = session.state
        out = session.decide(dataclasses.replace(x, events=operator.events(session.state, x)))
        judge.note(k * T, before, session.state, out)
        if out.decision.status is Status.FILTERED:
            changes.append(np.max(np.abs(session.state.ddq_cmd - before.ddq_cmd)))
    assert session.state.mode is Mode.ACTIVE and session.state.reached_id > seconds / 6.0
    print(name, seed, "least distance", judge.min_distance, "goals", session.state.reached_id, np.median(changes))
    assert judge.robot_caused == 0 and judge.infeasible == 0 and judge.stops == 0
    assert np.median(changes) < 2.0, "rad/s2 from one cycle to the next while a row binds"
    assert session.rig.driver.report()["missed"] == 0
