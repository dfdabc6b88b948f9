"""One cycle's decision, top to bottom: observe, mode, separation, reference, rows, limits, QP, smoothing, gate."""

from __future__ import annotations

import dataclasses
import math

from asc_rt.core import changer, gate, mode
from asc_rt.core.brake import at_rest
from asc_rt.core.levels import LEVELS, Level
from asc_rt.core.reference import reached
from asc_rt.core.rows import Rows, decision, nearest_at_goal, nearest_measured, rows
from asc_rt.core.safe_control import Solution, solve
from asc_rt.core.separation_monitor import watch
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
        return _defect(system.holding(state.tool), state, x)


def decide(system: System, state: CoreState, x: CycleInputs) -> tuple[CoreState, CycleOutputs]:
    """The decision; raises what a defect raises."""
    params, tool_before = system.params, state.tool
    state = mode.observe(params, state, x)
    system = system.holding(state.tool)  # from here on everything is of the tool that is there now
    d_measured = nearest_measured(system, x)
    level = LEVELS[params.control]
    state = level.track(system, state, x)
    other_mass = bool(x.events) and changer.weighs_other(params, state, system, x)
    watched = watch(system, state, x)
    state = mode.next_mode(params, state, x, d_measured, watched, other_mass)
    if mode.cut_off(state):  # the robot would hear no set-point: leave the session
        state = dataclasses.replace(state, mode=Mode.FAULT)
    found, solution, point = None, None, None
    if x.joint is not None and state.mode is not Mode.FAULT:
        found = rows(system, state, x)
        swapped = state.tool != tool_before and state.mode is Mode.ACTIVE
        if swapped and not changer.may_go_on(params, system, state, found, d_measured):
            state = mode.stopping(state, StopReason.TOOL_CHANGED)
        if state.mode is Mode.ACTIVE:
            state, solution, point = _control(system, level, state, found)
        if point is None:  # hold, braking, at rest, or no safe control
            state, point = _stop_profile(system, level, state, x)
    d_goal = nearest_at_goal(system, state, x)
    made = decision(system, state, found, solution, d_measured, d_goal, watched, point)
    return _finish(system, level, state, x, point, made)


def _control(
    system: System, level: Level, state: CoreState, found: Rows
) -> tuple[CoreState, Solution, SetPoint | None]:
    """The safe control and its set-point; no set-point means brake, and the state says why."""
    u_ref = level.reference(system, state)
    solution = solve(u_ref, found.C, found.floor, found.base, found.box, system.bounds.ddq_max)
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
    return _finish(system, level, state, x, point, decision(system, state, None, None, math.inf, math.inf, None, point))


def _finish(
    system: System,
    level: Level,
    state: CoreState,
    x: CycleInputs,
    point: SetPoint | None,
    made: SafetyDecision,
) -> tuple[CoreState, CycleOutputs]:
    """The next state and what leaves the core."""
    tick = x.tick + 1
    if point is None:
        stop = StopRequest(state.reason) if state.mode.is_over else None
        return dataclasses.replace(state, tick=tick), CycleOutputs(made, None, stop)
    command = JointCommand(x.tick, level.kind, point.q, point.dq, point.tau, state.mode.is_over)
    state = dataclasses.replace(state, tick=tick, q_cmd=point.q, dq_cmd=point.dq, ddq_cmd=point.ddq)
    if state.reached_id != state.goal.id and reached(system, state):
        state = dataclasses.replace(state, reached_id=state.goal.id)
    return state, CycleOutputs(made, command, None)
