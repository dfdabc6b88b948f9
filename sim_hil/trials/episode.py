"""One trial: controller, arm and world in lockstep, each cycle of the controller one period of the physics.

A torque acts for the period after the sample that it was computed from. A set-point arrives late: the arm is at the
set-point of cycle k one command latency after the beginning of cycle k + 1, which is how the core counts (its own
state is the set-point sent last, reached one latency from now).
"""

from __future__ import annotations

import dataclasses
from collections import deque
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from asc_rt.core.fusion import heard
from asc_rt.core.params import ToolParams
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
from sim_hil.trials.recorder import Recorder
from sim_hil.trials.sensing import Sensor, World
from sim_hil.trials.tasks import Task

REARM = 0.5  # s after the arm has come to rest, the operator arms it


class Changer(Protocol):
    """Who puts other tools on the arm."""

    def number(self, t: float, plant: MujocoPlant) -> int:
        """What the changer tells now; may make the plant carry another tool."""


class Operator(Protocol):
    def events(self, state: CoreState, x: CycleInputs) -> tuple[OperatorEvent, ...]:
        """What is said in this cycle, from the other inputs of it."""


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
    carried: ToolParams | None = None  # by the arm at first; None: what the controller thinks it carries
    changer: Changer | None = None
    operator: Operator | None = None  # None: arms the robot whenever it has been at rest for REARM


def run(setup: Setup, recorder: Recorder | None = None) -> Outcome:
    """The episode from the arm at rest at q0 until the task is over, the time is up or the session has failed."""
    system, T = setup.system, setup.system.params.period
    plant = MujocoPlant(system.params.holding(0), setup.q0)
    if setup.carried is not None:
        plant.carry(setup.carried)
    plant.set_person(setup.world.at(0.0))
    judge, arm = Judge(system, plant), Arm(plant, system)
    operator = setup.operator or Armer(T)
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
        if recorder is not None:
            recorder.cycle(plant, before, x, out)
        if out.command is None or setup.task.is_over:
            break
        arm.send(out.command)
        plant.step()
    return judge.outcome(k * T, k, state, setup.task.reached(state), reachable=True)


def _inputs(setup: Setup, plant: MujocoPlant, operator: Operator, state: CoreState, k: int) -> CycleInputs:
    params, n = setup.system.params, setup.system.n
    t, t_ns = k * params.period, k * params.period_ns
    q, dq = vector(plant.q), vector(plant.dq)
    current = vector(plant.torque / np.array(params.changer.nm_per_ampere or np.full(n, np.inf)))
    seen = setup.sensor.at(t)
    number = setup.changer.number(t, plant) if setup.changer is not None else 0
    tool_id = number if params.changer.told_by_robot else 0
    x = CycleInputs(
        tick=k,
        t_ns=t_ns,
        period_ns=params.period_ns,
        joint=JointState(t_ns, t_ns, k, q, dq, current, RobotFlag.READY | RobotFlag.SERVO_ON, tool_id, False),
        human=seen[0] if seen else None,
        human_age_ns=round(seen[1] * 1e9) if seen else 0,
        sensors=heard(seen[0], round(seen[1] * 1e9)) if seen else (),
        goal=setup.task.goal(t, state, q),
        events=(),
        missed_ticks=0,
        late=False,
    )
    return dataclasses.replace(x, events=operator.events(state, x))


class Armer:
    """Arms the robot whenever it has been at rest for REARM."""

    def __init__(self, period: float) -> None:
        self._wait = round(REARM / period)
        self._rested = self._wait - 2  # the first time at once
        self._id = 0

    def events(self, state: CoreState, x: CycleInputs) -> tuple[OperatorEvent, ...]:
        self._rested = self._rested + 1 if state.mode in (Mode.HOLD, Mode.STOPPED) else 0
        if self._rested < self._wait:
            return ()
        self._rested = 0
        self._id += 1
        return (OperatorEvent(self._id, EventKind.ARM),)


class Arm:
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
