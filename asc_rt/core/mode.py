"""The life of a session: IDLE -> HOLD -(a person arms)-> ACTIVE -> STOPPING -> STOPPED -(a person arms)-> ACTIVE ...

Every finding that forbids motion is a StopReason. A finding while ACTIVE brakes the robot; in HOLD and STOPPED it
forbids arming. Reasons that are faults end the session; the others wait for a person. Nothing but an ARM event leads
to ACTIVE.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from asc_rt.core.brake import at_rest
from asc_rt.core.params import Params
from asc_rt.core.types import (
    CoreState,
    CycleInputs,
    EventKind,
    Goal,
    Health,
    HumanState,
    JointState,
    Mode,
    RobotFlag,
    StopReason,
)


def observe(params: Params, state: CoreState, x: CycleInputs) -> CoreState:
    """Take over what the inputs bring: the seed of the set-point, a new goal, how long the robot has been silent."""
    state = dataclasses.replace(state, silent_cycles=0 if x.joint else state.silent_cycles + 1)
    if state.mode is Mode.IDLE and x.joint is not None:
        # The only seed from the measured pose: later a re-seed would be a jump of the set-point.
        state = dataclasses.replace(state, mode=Mode.HOLD, q_cmd=x.joint.q, goal=Goal(0, x.joint.q))
    if x.goal is not None and x.goal.id > state.goal.id and _inside(params, x.goal):
        state = dataclasses.replace(state, goal=x.goal)
    return state


def next_mode(params: Params, state: CoreState, x: CycleInputs, d_measured: float) -> CoreState:
    """Mode and reason of this cycle, from what was found and what the operator asked for."""
    if state.mode.is_over:
        return state
    finding = _finding(params, state, x)
    state = _hear(params, state, x, finding, d_measured)
    if finding.is_fault or (state.mode is Mode.ACTIVE and finding is not StopReason.NONE):
        state = stopping(state, finding)
    if state.mode is Mode.STOPPING and at_rest(state):
        return dataclasses.replace(state, mode=_after_stop(state))
    return state


def stopping(state: CoreState, reason: StopReason) -> CoreState:
    """Brake because of `reason`; the worst reason so far stays."""
    worst = max(state.reason, reason) if state.mode is Mode.STOPPING else reason
    return dataclasses.replace(state, mode=Mode.STOPPING, reason=worst)


def cut_off(state: CoreState) -> bool:
    """True: there is no robot to brake with set-points (silent, faulted or not listening)."""
    return state.mode is Mode.STOPPING and state.reason >= StopReason.ROBOT_NOT_READY


def _after_stop(state: CoreState) -> Mode:
    if state.reason.is_fault:
        return Mode.FAULT
    return Mode.ENDED if state.ending else Mode.STOPPED


def _hear(
    params: Params,
    state: CoreState,
    x: CycleInputs,
    finding: StopReason,
    d_measured: float,
) -> CoreState:
    for event in x.events:
        if event.id <= state.event_id:
            continue  # heard before
        state = dataclasses.replace(state, event_id=event.id)
        if event.kind is EventKind.ARM and state.mode in (Mode.HOLD, Mode.STOPPED) and not state.ending:
            refused = finding
            if finding is StopReason.NONE and x.joint is None:
                refused = StopReason.LATE  # without a sample there is no distance to judge by
            elif finding is StopReason.NONE and not d_measured >= params.safety.rearm_distance:
                refused = StopReason.START_INSIDE
            armed = refused is StopReason.NONE
            state = dataclasses.replace(state, mode=Mode.ACTIVE if armed else state.mode, reason=refused)
        elif event.kind is EventKind.STOP and state.mode is Mode.ACTIVE:
            state = stopping(state, StopReason.OPERATOR_STOP)
        elif event.kind is EventKind.END:
            state = dataclasses.replace(state, ending=True)
            if state.mode is not Mode.STOPPING:
                state = stopping(state, max(state.reason, StopReason.SESSION_END))
    return state


def _finding(params: Params, state: CoreState, x: CycleInputs) -> StopReason:
    """The worst reason not to move that this cycle's inputs show."""
    if x.joint is None:
        silent = state.silent_cycles >= params.silence_cycles
        return StopReason.ROBOT_SILENT if silent else _human_finding(params, x)
    if x.joint.flags & (RobotFlag.EMERGENCY_STOP | RobotFlag.FAULTED):
        return StopReason.ROBOT_FAULTED
    if not x.joint.flags & RobotFlag.READY:
        return StopReason.ROBOT_NOT_READY
    if not _follows(params, state, x.joint):
        return StopReason.TRACKING
    if x.missed_ticks >= params.silence_cycles:
        return StopReason.LATE
    return _human_finding(params, x)


def _human_finding(params: Params, x: CycleInputs) -> StopReason:
    if x.human_fault:
        return StopReason.HUMAN_INVALID
    if x.human is None:
        return StopReason.HUMAN_MISSING
    if not _is_finite(x.human):
        return StopReason.HUMAN_INVALID
    if x.human_age_ns > params.human.age_limit_ns:
        return StopReason.HUMAN_STALE
    if x.human_age_ns < -params.human.future_limit_ns or x.human.calibration_hash != params.human.calibration_hash:
        return StopReason.HUMAN_INVALID
    nobody_means_nothing = len(x.human.radius) == 0 and not x.human.empty_certified
    if x.human.health is not Health.OK or nobody_means_nothing:
        return StopReason.HUMAN_UNHEALTHY
    return StopReason.NONE


def _is_finite(human: HumanState) -> bool:
    shape = (human.p0, human.p1, human.v0, human.v1, human.radius, human.position_bound, human.velocity_bound)
    return all(bool(np.isfinite(values).all()) for values in shape)


def _follows(params: Params, state: CoreState, joint: JointState) -> bool:
    """|q_cmd - q| within the tolerance plus twice the way that the command latency explains."""
    if not np.all(np.isfinite(joint.q)):
        return False
    explained = 2.0 * params.robot.command_latency_ns * 1e-9 * np.abs(state.dq_cmd)
    return bool(np.all(np.abs(state.q_cmd - joint.q) <= params.tracking_tolerance + explained))


def _inside(params: Params, goal: Goal) -> bool:
    r = params.robot
    return len(goal.q) == params.n and all(a <= v <= b for a, v, b in zip(r.q_min, goal.q, r.q_max, strict=True))
