"""One trial: controller, arm and world in lockstep, each cycle of the controller one period of the physics.

A torque acts for the period after the sample that it was computed from. A set-point arrives late: the arm is at the
set-point of cycle k one command latency after the beginning of cycle k + 1, which is how the core counts (its own
state is the set-point sent last, reached one latency from now).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from asc_rt.core.step import step
from asc_rt.core.system import System, initial
from asc_rt.core.types import (
    CoreState,
    CycleInputs,
    EventKind,
    JointCommand,
    JointState,
    Mode,
    OperatorEvent,
    RobotFlag,
    vector,
)
from sim_hil.person import Array
from sim_hil.plant import MujocoPlant
from sim_hil.trials.judge import Judge, Outcome
from sim_hil.trials.sensing import Sensor, World
from sim_hil.trials.tasks import Task

REARM = 0.5  # s after the arm has come to rest, the operator arms it


@dataclass(frozen=True, slots=True)
class Setup:
    system: System
    q0: Array  # rad
    world: World
    sensor: Sensor
    task: Task
    seconds: float  # at most
    is_moving: bool  # the world
    ends_at_contact: bool


def run(setup: Setup) -> Outcome:
    """The episode from the arm at rest at q0 until the task is over, the time is up or the session has failed."""
    system, T = setup.system, setup.system.params.period
    plant = MujocoPlant(system.params, setup.q0)
    plant.set_person(setup.world.at(0.0))
    judge, arm, operator = Judge(system, plant), _Arm(plant, system), _Operator(T)
    state, k = initial(system), 0
    for k in range(round(setup.seconds / T)):
        if setup.is_moving:
            plant.set_person(setup.world.at(k * T))
        judge.look(k * T)
        if setup.ends_at_contact and judge.min_distance < 0.0:
            break
        before, x = state, _inputs(setup, plant, operator, state, k)
        state, out = step(system, state, x)
        judge.note(k * T, before, state, out)
        if out.command is None or setup.task.is_over:
            break
        arm.send(out.command)
        plant.step()
    return judge.outcome(k * T, k, state, setup.task.reached(state), reachable=True)


def _inputs(setup: Setup, plant: MujocoPlant, operator: _Operator, state: CoreState, k: int) -> CycleInputs:
    params, n = setup.system.params, setup.system.n
    t, t_ns = k * params.period, k * params.period_ns
    q, dq, none = vector(plant.q), vector(plant.dq), vector(np.zeros(n))
    seen = setup.sensor.at(t)
    return CycleInputs(
        tick=k,
        t_ns=t_ns,
        period_ns=params.period_ns,
        joint=JointState(t_ns, t_ns, k, q, dq, none, RobotFlag.READY | RobotFlag.SERVO_ON, 0, False),
        human=seen[0] if seen else None,
        human_age_ns=round(seen[1] * 1e9) if seen else 0,
        human_fault=False,
        goal=setup.task.goal(t, state, q),
        events=operator.events(state),
        missed_ticks=0,
        late=False,
    )


class _Operator:
    """Arms the robot whenever it has been at rest for REARM."""

    def __init__(self, period: float) -> None:
        self._wait = round(REARM / period)
        self._rested = self._wait - 2  # the first time at once
        self._id = 0

    def events(self, state: CoreState) -> tuple[OperatorEvent, ...]:
        self._rested = self._rested + 1 if state.mode in (Mode.HOLD, Mode.STOPPED) else 0
        if self._rested < self._wait:
            return ()
        self._rested = 0
        self._id += 1
        return (OperatorEvent(self._id, EventKind.ARM),)


class _Arm:
    """Commands on their way to the plant."""

    def __init__(self, plant: MujocoPlant, system: System) -> None:
        self._plant = plant
        self._takes_torque = system.params.control == "torque"
        periods = system.params.robot.command_latency_ns / system.params.period_ns
        self._late, self._share = int(periods), periods % 1.0  # whole periods, and part of one
        self._line = deque([plant.q] * (self._late + 2), maxlen=self._late + 2)

    def send(self, command: JointCommand) -> None:
        if self._takes_torque:
            self._plant.set_torque(command.tau)
            return
        self._line.append(command.q)
        self._plant.set_target((1.0 - self._share) * self._line[1] + self._share * self._line[0])
