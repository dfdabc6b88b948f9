"""One cycle's decision, top to bottom: observe, mode, separation, reference, rows, limits, QP, smoothing, gate."""

from __future__ import annotations

import dataclasses

import numpy as np

from asc_rt.core import gate, mode
from asc_rt.core.brake import brake
from asc_rt.core.reference import reached, reference
from asc_rt.core.rows import Rows, decision, nearest_measured, rows
from asc_rt.core.safe_control import Solution, solve
from asc_rt.core.smoothing import SetPoint, smooth
from asc_rt.core.system import System
from asc_rt.core.types import (
    CommandKind,
    CoreState,
    CycleInputs,
    CycleOutputs,
    JointCommand,
    Mode,
    SafetyDecision,
    StopReason,
    StopRequest,
    vector,
)


def step(system: System, state: CoreState, x: CycleInputs) -> tuple[CoreState, CycleOutputs]:
    """The whole decision of one cycle. Pure: equal arguments, equal bytes."""
    d_measured = nearest_measured(system, x)
    state = mode.observe(system.params, state, x)
    state = mode.next_mode(system.params, state, x, d_measured)
    if mode.cut_off(state):  # the robot would hear no set-point: leave the session
        state = dataclasses.replace(state, mode=Mode.FAULT)
    found, solution, point = None, None, None
    if x.joint is not None and state.mode is not Mode.FAULT:
        found = rows(system, state, x)
        if state.mode is Mode.ACTIVE:
            state, solution, point = _control(system, state, found)
        if point is None:  # hold, braking, at rest, or no safe control
            state, point = _stop_profile(system, state)
    made = decision(system, state, found, solution, d_measured, point)
    return _finish(system, state, x, point, made)


def _control(system: System, state: CoreState, found: Rows) -> tuple[CoreState, Solution, SetPoint | None]:
    """The safe control and its set-point; no set-point means brake, and the state says why."""
    solution = solve(reference(system, state), found.C, found.floor, found.base, found.U, system.bounds.ddq_max)
    if not solution.feasible:
        return mode.stopping(state, StopReason.INFEASIBLE), solution, None
    point = smooth(system, state, solution.u)
    if not (
        gate.may_pass(system, state, point)
        and gate.keeps_rows(point, found.C, found.base + solution.share * (found.floor - found.base))
    ):
        return mode.stopping(state, StopReason.GATE), solution, None
    return state, solution, point


def _stop_profile(system: System, state: CoreState) -> tuple[CoreState, SetPoint | None]:
    point = brake(system, state)
    if gate.may_pass(system, state, point):
        return state, point
    return dataclasses.replace(state, mode=Mode.FAULT, reason=StopReason.GATE), None


def _finish(
    system: System,
    state: CoreState,
    x: CycleInputs,
    point: SetPoint | None,
    made: SafetyDecision,
) -> tuple[CoreState, CycleOutputs]:
    """The next state and what leaves the core."""
    command, stop = None, None
    if point is not None:
        zero = vector(np.zeros(len(point.q)))
        command = JointCommand(x.tick, CommandKind.POSITION, point.q, point.dq, zero, state.mode.is_over)
        state = dataclasses.replace(state, q_cmd=point.q, dq_cmd=point.dq, ddq_cmd=point.ddq)
        if reached(system, state):
            state = dataclasses.replace(state, reached_id=state.goal.id)
    elif state.mode.is_over:
        stop = StopRequest(state.reason)
    return dataclasses.replace(state, tick=x.tick + 1), CycleOutputs(made, command, stop)
