"""Compile every kernel, or load it from numba's cache, before the robot is touched: seconds, and never inside a
cycle."""

from __future__ import annotations

import numpy as np

from asc_rt.core.step import step
from asc_rt.core.system import System, initial
from asc_rt.core.types import (
    CycleInputs,
    EventKind,
    Goal,
    Health,
    HumanState,
    JointState,
    OperatorEvent,
    RobotFlag,
    vector,
)


def warm_up(system: System) -> None:
    """Run the real step on made-up inputs: numba compiles per argument type, so nothing less covers what will run."""
    period = system.params.period_ns
    q = vector(0.5 * (system.bounds.q_min + system.bounds.q_max))
    zero, one = vector(np.zeros(system.n)), vector([[0.5, 0.5, 0.5]])
    joint = JointState(0, 0, 0, q, zero, zero, RobotFlag.READY | RobotFlag.SERVO_ON, 0, True)
    human = HumanState(
        *(0, 1, 0, system.params.human.calibration_hash, Health.OK, 1.0, True),
        *(one, one, vector(np.zeros((1, 3))), vector(np.zeros((1, 3)))),
        *(vector([0.01]), vector([0.0]), vector([0.1]), np.zeros(1, dtype=np.int64)),
    )
    goal = Goal(1, vector(q + 0.1))
    state = initial(system)
    for tick in range(4):
        events = (OperatorEvent(1, EventKind.ARM),) if tick == 1 else ()
        state, _ = step(
            system,
            state,
            CycleInputs(tick, 0, period, joint, human, 0, False, goal, events, 0, False),
        )
