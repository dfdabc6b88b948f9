"""The life of a session: IDLE -> HOLD -(a person arms)-> ACTIVE -> STOPPING -> STOPPED -(a person arms)-> ACTIVE ...

Every finding that forbids motion is a StopReason. A finding while ACTIVE brakes the robot; in HOLD and STOPPED it
forbids arming. Reasons that are faults end the session; the others wait for a person. Nothing but an ARM event leads
to ACTIVE.
"""

from __future__ import annotations

import dataclasses

from numba import njit

from asc_rt.core import changer
from asc_rt.core.brake import at_rest
from asc_rt.core.human_ladder import judge
from asc_rt.core.params import Params
from asc_rt.core.types import (
    CoreState,
    CycleInputs,
    EventKind,
    Goal,
    JointState,
    Mode,
    Monitor,
    RobotFlag,
    StopReason,
    Vector,
)


def observe(params: Params, state: CoreState, x: CycleInputs) -> CoreState:
    """Take over what the inputs bring: the seed of the set-point, a new goal, the tool, how long the robot has been
    silent."""
    silent = 0 if x.joint else state.silent_cycles + 1
    if silent != state.silent_cycles:
        state = dataclasses.replace(state, silent_cycles=silent)
    if state.mode is Mode.IDLE and x.joint is not None:
        # The only seed from the measured pose: later a re-seed would be a jump of the set-point.
        state = dataclasses.replace(state, mode=Mode.HOLD, q_cmd=x.joint.q, goal=Goal(0, x.joint.q))
    if (tool := changer.told(params, state, x)) != state.tool:
        state = dataclasses.replace(state, tool=tool)
    if x.goal is not None and x.goal.id > state.goal.id and _inside(params, x.goal):
        state = dataclasses.replace(state, goal=x.goal)
    return state


def next_mode(
    params: Params,
    state: CoreState,
    x: CycleInputs,
    d_measured: float,
    monitor: Monitor | None = None,
    weighs_other: bool = False,
) -> CoreState:
    """Mode, reason and caution of this cycle, from what was found and what the operator asked for."""
    if state.mode.is_over:
        return state
    people = judge(params.human, x)
    state = dataclasses.replace(state, slow=_caution(state, x, people.slow))
    finding = _finding(params, state, x, people.stop, d_measured, monitor)
    state = _hear(params, state, x, finding, d_measured, weighs_other)
    if finding.is_fault or (state.mode is Mode.ACTIVE and finding is not StopReason.NONE):
        state = stopping(state, finding)
    if state.mode is Mode.STOPPING and at_rest(state):
        return dataclasses.replace(state, mode=_after_stop(state))
    return state


def _caution(state: CoreState, x: CycleInputs, people: StopReason) -> StopReason:
    """The worst reason to go slowly. A cycle without a sample says nothing new of the robot."""
    late = StopReason.LATE if x.late else StopReason.NONE
    is_warm = state.slow is StopReason.ROBOT_WARM if x.joint is None else RobotFlag.WARM in x.joint.flags
    return max(people, late, StopReason.ROBOT_WARM if is_warm else StopReason.NONE)


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
    weighs_other: bool,
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
            elif finding is StopReason.NONE and weighs_other:
                refused = StopReason.TOOL_MISMATCH
            armed = refused is StopReason.NONE
            state = dataclasses.replace(state, mode=Mode.ACTIVE if armed else state.mode, reason=refused)
        elif event.kind is EventKind.STOP and state.mode is Mode.ACTIVE:
            state = stopping(state, StopReason.OPERATOR_STOP)
        elif event.kind is EventKind.TOOL and state.mode in (Mode.HOLD, Mode.STOPPED):
            unknown = not changer.knows(params, event.tool)
            state = dataclasses.replace(state, reason=StopReason.TOOL_MISMATCH if unknown else state.reason)
        elif event.kind is EventKind.END:
            state = dataclasses.replace(state, ending=True)
            if state.mode is not Mode.STOPPING:
                state = stopping(state, max(state.reason, StopReason.SESSION_END))
    return state


def _finding(
    params: Params, state: CoreState, x: CycleInputs, people: StopReason, d_measured: float, monitor: Monitor | None
) -> StopReason:
    """The worst reason not to move that this cycle's inputs show; `people`: what the ladder says of the sensors."""
    if x.joint is None:
        silent = state.silent_cycles >= params.silence_cycles
        return StopReason.ROBOT_SILENT if silent else people
    if x.joint.flags & (RobotFlag.EMERGENCY_STOP | RobotFlag.FAULTED):
        return StopReason.ROBOT_FAULTED
    if not x.joint.flags & RobotFlag.READY:
        return StopReason.ROBOT_NOT_READY
    if not _follows(params, state, x.joint):
        return StopReason.TRACKING
    if x.missed_ticks >= params.silence_cycles:
        return StopReason.LATE
    if (wrong := changer.finding(params, state, x.joint)) is not StopReason.NONE:
        return wrong
    if people is StopReason.NONE and params.monitor.is_enforced and not (monitor and monitor.is_kept):
        return StopReason.SEPARATION
    if people is StopReason.NONE and state.mode is Mode.ACTIVE and not d_measured >= 0.0:
        # The bounds of arm and person overlap: contact cannot be excluded, and which way leads away is not known.
        return StopReason.SEPARATION
    return people


def _follows(params: Params, state: CoreState, joint: JointState) -> bool:
    """|q_cmd - q| within the tolerance plus twice the way that the command latency explains."""
    latency = params.robot.command_latency_ns * 1e-9
    return bool(_near(state.q_cmd, joint.q, state.dq_cmd, params.tracking_tolerance, 2.0 * latency))


@njit(cache=True)
def _near(q_cmd: Vector, q: Vector, dq_cmd: Vector, tolerance: float, time: float) -> bool:
    """False also for what is not a number."""
    near = True
    for i in range(q.shape[0]):
        near = near and abs(q_cmd[i] - q[i]) <= tolerance + time * abs(dq_cmd[i])
    return near


def _inside(params: Params, goal: Goal) -> bool:
    r = params.robot
    return len(goal.q) == params.n and all(a <= v <= b for a, v, b in zip(r.q_min, goal.q, r.q_max, strict=True))
