"""Compile every kernel, or load it from numba's cache, before the robot is touched: seconds, and never inside a
cycle."""

from __future__ import annotations

import dataclasses

import numpy as np

from asc_rt.core import changer
from asc_rt.core.fusion import heard
from asc_rt.core.kinematics import forward
from asc_rt.core.rows import rows
from asc_rt.core.safe_control import project, solve
from asc_rt.core.step import step
from asc_rt.core.system import System, initial
from asc_rt.core.types import (
    CoreState,
    CycleInputs,
    EventKind,
    Goal,
    Health,
    HumanState,
    JointState,
    Matrix,
    OperatorEvent,
    RobotFlag,
    vector,
)

# m from the last joint along x, cycle by cycle, from both sides: whichever way the arm goes somebody comes towards it
PEOPLE = (2.0, 2.0, 0.6, -0.6, 0.4, -0.4, 0.3, -0.3, 0.2, -0.2, 0.1, -0.1)
APPROACH = 1.5  # m/s


def warm_up(system: System) -> None:
    """Run the real step on made-up inputs: numba compiles per argument type, so nothing less covers what will run.
    With every tool, and what a swap asks; with a person so near that the filter has to act and the stop to brake: else
    their kernels would be loaded in the cycle that first needs them, 30 ms late."""
    params = system.params
    for mount in range(max(1, len(params.changer.mounts))):
        held = system.holding(mount)
        state, x, joint = _run(held)
        going_on = dataclasses.replace(params, changer=dataclasses.replace(params.changer, goes_on=True))
        found = rows(held, state, x)
        changer.may_go_on(going_on, held, state, found, np.inf)
        _solve(held, found.box)
        changer.torque_misfit(held, joint, np.ones(system.n))


def _solve(system: System, box: Matrix) -> None:
    """Two rows that can be kept, and two of which only a share can: what PIQP is asked, which people seldom bring on,
    and the nearest control for a stop that asks for too much; with arrays of the kinds that rows and stops have."""
    lower, width = box[0], box[1] - box[0]
    C, base = np.eye(system.n)[:2], (lower + 0.2 * width)[:2]
    for share in (0.5, 2.0):
        solve(vector(lower), C, (lower + share * width)[:2], base, box, system.bounds.ddq_max)
    project(lower + 2.0 * width, box, system.bounds.ddq_max)


def _run(system: System) -> tuple[CoreState, CycleInputs, JointState]:
    period = system.params.period_ns
    q = vector(0.5 * (system.bounds.q_min + system.bounds.q_max))
    zero, wrist = vector(np.zeros(system.n)), forward(system.model.arm.chain, q, q).origin[-1:]
    joint = JointState(0, 0, 0, q, zero, zero, RobotFlag.READY | RobotFlag.SERVO_ON, 0, True)
    sensor = system.params.human.sensors[0]
    goal = Goal(1, vector(q + 0.1))
    state = initial(system)
    for tick, away in enumerate(PEOPLE):
        one, comes = vector(wrist + [away, 0.0, 0.0]), vector([[-np.sign(away) * APPROACH, 0.0, 0.0]])
        human = HumanState(
            *(0, 1, sensor.id, sensor.calibration_hash, Health.OK, 1.0, True),
            *(one, one, comes, comes),
            *(vector([0.01]), vector([0.0]), vector([0.1]), np.zeros(1, dtype=np.int64)),
        )
        events = (OperatorEvent(1, EventKind.ARM),) if tick == 1 else ()
        x = CycleInputs(tick, 0, period, joint, human, 0, heard(human, 0), goal, events, 0, False)
        state, _ = step(system, state, x)
    return state, x, joint
