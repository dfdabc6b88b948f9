"""One cycle's decision, top to bottom: observe, mode, separation, reference, rows, limits, QP, smoothing, gate."""

from __future__ import annotations

import dataclasses

from asc_rt.core import gate, mode
from asc_rt.core.brake import at_rest
from asc_rt.core.levels import LEVELS, Level
from asc_rt.core.reference import reached
from asc_rt.core.rows import Rows, decision, nearest_measured, rows
from asc_rt.core.safe_control import Solution, solve
from asc_rt.core.smoothing import SetPoint, SmoothingError
from asc_rt.core.system import System
from asc_rt.core.types import (
    CoreState,
    CycleInputs,
    CycleOutputs,
    JointCommand,
    Mode,
    SafetyDecision,
    StopReason,
    StopRequest,
)


def step(system: System, state: CoreState, x: CycleInputs) -> tuple[CoreState, CycleOutputs]:
    """The whole decision of one cycle. Pure: equal arguments, equal bytes.

    A defect that raises brakes the robot on its stop profile and ends the session; `decide` on the recorded inputs
    raises it again.
    """
    try:
        return decide(system, state, x)
    except Exception:
        return _defect(system, state, x)


def decide(system: System, state: CoreState, x: CycleInputs) -> tuple[CoreState, CycleOutputs]:
    """The decision; raises what a defect raises."""
    d_measured = nearest_measured(system, x)
    level = LEVELS[system.params.control]
    state = level.track(system, mode.observe(system.params, state, x), x)
    state = mode.next_mode(system.params, state, x, d_measured)
    if mode.cut_off(state):  # the robot would hear no set-point: leave the session
        state = dataclasses.replace(state, mode=Mode.FAULT)
    found, solution, point = None, None, None
    if x.joint is not None and state.mode is not Mode.FAULT:
        found = rows(system, state, x)
        if state.mode is Mode.ACTIVE:
            state, solution, point = _control(system, level, state, found)
        if point is None:  # hold, braking, at rest, or no safe control
            state, point = _stop_profile(system, level, state, x)
    made = decision(system, state, found, solution, d_measured, point)
    return _finish(system, level, state, x, point, made)


def _control(
    system: System, level: Level, state: CoreState, found: Rows
) -> tuple[CoreState, Solution, SetPoint | None]:
    """The safe control and its set-point; no set-point means brake, and the state says why."""
    u_ref = level.reference(system, state)
    solution = solve(u_ref, found.C, found.floor, found.base, found.U, system.bounds.ddq_max)
    if not solution.feasible:
        return mode.stopping(state, StopReason.INFEASIBLE), solution, None
    floor = found.base + solution.share * (found.floor - found.base)
    try:
        point = level.set_point(system, state, solution.u)
    except SmoothingError:
        return mode.stopping(state, StopReason.GATE), solution, None
    if not (level.may_pass(system, state, point) and gate.keeps_rows(point, found.C, floor)):
        return mode.stopping(state, StopReason.GATE), solution, None
    return state, solution, point


def _stop_profile(system: System, level: Level, state: CoreState, x: CycleInputs) -> tuple[CoreState, SetPoint | None]:
    """The next set-point of the stop; without one nothing is sent any more and the robot's own rule stops it."""
    try:
        point = level.stop(system, state, x)
    except Exception:  # of whatever kind: this is the way out of a defect, too
        point = None
    if point is not None and level.may_pass(system, state, point):
        return state, point
    return dataclasses.replace(state, mode=Mode.FAULT, reason=StopReason.GATE), None


def _defect(system: System, state: CoreState, x: CycleInputs) -> tuple[CoreState, CycleOutputs]:
    """Brake with nothing but the commanded state; over once at rest, or if not even that can be computed."""
    level, point = LEVELS[system.params.control], None
    state = mode.stopping(state, StopReason.EXCEPTION)
    if at_rest(state):
        state = dataclasses.replace(state, mode=Mode.FAULT)
    if x.joint is not None:
        state, point = _stop_profile(system, level, state, x)
    return _finish(system, level, state, x, point, decision(system, state, None, None, float("inf"), point))


def _finish(
    system: System,
    level: Level,
    state: CoreState,
    x: CycleInputs,
    point: SetPoint | None,
    made: SafetyDecision,
) -> tuple[CoreState, CycleOutputs]:
    """The next state and what leaves the core."""
    command, stop = None, None
    if point is not None:
        command = JointCommand(x.tick, level.kind, point.q, point.dq, point.tau, state.mode.is_over)
        state = dataclasses.replace(state, q_cmd=point.q, dq_cmd=point.dq, ddq_cmd=point.ddq)
        if reached(system, state):
            state = dataclasses.replace(state, reached_id=state.goal.id)
    elif state.mode.is_over:
        stop = StopRequest(state.reason)
    return dataclasses.replace(state, tick=x.tick + 1), CycleOutputs(made, command, stop)
