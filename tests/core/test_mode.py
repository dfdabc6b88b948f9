"""The fail-closed table: what stops the robot from which mode, what ends the session, and that only ARM starts
motion."""

from __future__ import annotations

from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np
import pytest

from asc_rt.core.mode import cut_off, next_mode, observe, stopping
from asc_rt.core.params import MonitorParams
from asc_rt.core.system import initial
from asc_rt.core.types import (
    EventKind,
    Goal,
    Health,
    MessageFault,
    Mode,
    Monitor,
    OperatorEvent,
    RobotFlag,
    SensorReport,
    StopReason,
    vector,
)

R, M, F = StopReason, Mode, MessageFault
FAR_AWAY = float("inf")
_ids = count(1)


def event(kind: EventKind) -> tuple[OperatorEvent, ...]:
    return (OperatorEvent(next(_ids), kind),)


def in_mode(bench: Any, mode: Mode, reason: StopReason = R.NONE, moving: bool | None = None) -> Any:
    moving = mode in (M.ACTIVE, M.STOPPING) if moving is None else moving
    speed = vector(np.full(6, 0.1 * moving))
    return replace(initial(bench.system()), mode=mode, reason=reason, q_cmd=vector(bench.HOME), dq_cmd=speed)


def decide(bench: Any, state: Any, d: float = FAR_AWAY, **changes: Any) -> Any:
    params = bench.system().params
    x = bench.inputs(**{"joint": bench.joint(bench.HOME)} | changes)
    return next_mode(params, observe(params, state, x), x, d)


def causes(bench: Any) -> dict[StopReason, list[dict[str, Any]]]:
    """Inputs that show each reason, one at a time."""
    params, joint = bench.system().params, bench.joint(bench.HOME)
    nan = vector([[np.nan, 0.0, 0.0]])
    bad = [{"p0": nan}, {"p1": nan}, {"v0": nan}, {"v1": nan}]
    bad += [{name: vector([np.nan])} for name in ("radius", "position_bound", "velocity_bound")]
    far = bench.FAR

    def says(**changes: Any) -> tuple[SensorReport, ...]:
        return (bench.report(**changes),)

    return {
        R.HUMAN_MISSING: [{"human": None, "human_age_ns": 0}],
        R.HUMAN_STALE: [{"human_age_ns": params.human.age_limit_ns + 1}, {"sensors": says(age_ns=200_000_001)}],
        R.HUMAN_UNHEALTHY: [
            {"human": replace(far, health=Health.FAULT)},
            {"human": replace(bench.NOBODY, empty_certified=False)},
        ],
        R.HUMAN_COVERAGE: [{"human": replace(far, coverage=0.69)}, {"sensors": says(coverage=np.nan)}],
        R.HUMAN_UNSYNCED: [{"sensors": says(sigma_ns=20_000_001)}],
        R.HUMAN_INVALID: [
            *({"human": replace(far, **broken)} for broken in bad),
            *({"sensors": says(fault=fault)} for fault in (F.UNREADABLE, F.ORDER, F.SENDER)),
        ],
        R.HUMAN_SCHEMA: [{"sensors": says(fault=F.SCHEMA)}],
        R.HUMAN_CLOCK: [{"sensors": says(fault=F.CLOCK)}, {"human_age_ns": -params.human.future_limit_ns - 1}],
        R.HUMAN_CALIBRATION: [{"human": replace(far, calibration_hash=7)}],
        R.TOOL_UNKNOWN: [{"joint": replace(joint, tool_id=-1)}],
        R.TOOL_MISMATCH: [{"joint": replace(joint, tool_id=number)} for number in (1, 7, 15)],
        R.LATE: [{"missed_ticks": params.silence_cycles}],
        R.TRACKING: [
            {"joint": bench.joint(bench.HOME + 0.3)},
            {"joint": bench.joint(bench.HOME - 0.3)},
            {"joint": bench.joint(np.where(np.arange(6) == 5, np.nan, bench.HOME))},
        ],
        R.ROBOT_NOT_READY: [{"joint": replace(joint, flags=RobotFlag.SERVO_ON)}],
        R.ROBOT_FAULTED: [
            {"joint": replace(joint, flags=bench.FINE | RobotFlag.FAULTED)},
            {"joint": replace(joint, flags=bench.FINE | RobotFlag.EMERGENCY_STOP)},
        ],
    }


WAITING = [*(r for r in R if R.HUMAN_MISSING <= r <= R.HUMAN_INVALID), R.TOOL_UNKNOWN, R.TOOL_MISMATCH, R.LATE]
FAULTS = [R.HUMAN_SCHEMA, R.HUMAN_CLOCK, R.HUMAN_CALIBRATION, R.TRACKING, R.ROBOT_NOT_READY, R.ROBOT_FAULTED]


def test_all_is_well_changes_nothing(bench: Any) -> None:
    for mode in (M.HOLD, M.ACTIVE, M.STOPPED):
        assert decide(bench, in_mode(bench, mode)).mode is mode
    # at the edge of each limit it is still well
    params = bench.system().params
    for changes in (
        {"human_age_ns": params.human.age_limit_ns},
        {"human_age_ns": -params.human.future_limit_ns},
        {"human": bench.NOBODY},
        {"missed_ticks": params.silence_cycles - 1},
        {"joint": bench.joint(bench.HOME + 0.99 * params.tracking_tolerance)},
    ):
        state = decide(bench, in_mode(bench, M.ACTIVE), **changes)
        assert (state.mode, state.reason) == (M.ACTIVE, R.NONE)


@pytest.mark.parametrize("reason", WAITING + FAULTS)
def test_every_finding_stops_a_robot_in_motion(bench: Any, reason: StopReason) -> None:
    for changes in causes(bench)[reason]:
        state = decide(bench, in_mode(bench, M.ACTIVE), **changes)
        assert (state.mode, state.reason) == (M.STOPPING, reason)
        at_rest = decide(bench, in_mode(bench, M.ACTIVE, moving=False), **changes)
        assert (at_rest.mode, at_rest.reason) == (M.FAULT if reason.is_fault else M.STOPPED, reason)


@pytest.mark.parametrize("reason", WAITING)
@pytest.mark.parametrize("mode", [M.HOLD, M.STOPPED])
def test_a_finding_refuses_arming_and_says_why(bench: Any, mode: Mode, reason: StopReason) -> None:
    for changes in causes(bench)[reason]:
        unasked = decide(bench, in_mode(bench, mode), **changes)
        assert unasked.mode is mode
        state = decide(bench, in_mode(bench, mode), events=event(EventKind.ARM), **changes)
        assert (state.mode, state.reason) == (mode, reason)


@pytest.mark.parametrize("reason", FAULTS)
@pytest.mark.parametrize("mode", [M.HOLD, M.STOPPED])
@pytest.mark.parametrize("armed", [False, True])
def test_a_fault_ends_the_session_at_rest_too(bench: Any, mode: Mode, reason: StopReason, armed: bool) -> None:
    events = event(EventKind.ARM) if armed else ()
    for changes in causes(bench)[reason]:
        state = decide(bench, in_mode(bench, mode), events=events, **changes)
        assert (state.mode, state.reason) == (M.FAULT, reason)


@pytest.mark.parametrize("reason", WAITING + FAULTS)
def test_braking_keeps_the_worse_reason_and_is_never_called_off(bench: Any, reason: StopReason) -> None:
    for before in (R.SESSION_END, R.HUMAN_STALE, R.INFEASIBLE, R.LATE, R.GATE, R.ROBOT_FAULTED):
        for changes in (*causes(bench)[reason], {}):
            for events in ((), event(EventKind.ARM)):
                state = decide(bench, in_mode(bench, M.STOPPING, before), events=events, **changes)
                assert state.mode is M.STOPPING
                assert state.reason >= before
                if reason.is_fault and changes:
                    assert state.reason is max(before, reason)


def test_silence_counts_up_and_any_sample_counts_it_back(bench: Any) -> None:
    limit = bench.system().params.silence_cycles
    for mode in (M.IDLE, M.HOLD, M.ACTIVE, M.STOPPED):
        state = in_mode(bench, mode)
        for _ in range(limit - 1):
            state = decide(bench, state, joint=None)
            assert state.mode is mode
        silent = decide(bench, state, joint=None)
        assert silent.reason is R.ROBOT_SILENT
        assert silent.mode is M.FAULT or cut_off(silent)
        heard = decide(bench, state)
        assert heard.silent_cycles == 0


@pytest.mark.parametrize("reason", list(R))
def test_cut_off_when_nobody_would_hear_a_set_point(bench: Any, reason: StopReason) -> None:
    deaf = {R.ROBOT_NOT_READY, R.ROBOT_SILENT, R.ROBOT_FAULTED}
    assert cut_off(in_mode(bench, M.STOPPING, reason)) == (reason in deaf)
    assert not cut_off(in_mode(bench, M.ACTIVE, reason))


def test_a_robot_that_asks_for_rest_goes_slowly_and_stops_for_nothing_of_it(bench: Any) -> None:
    warm = replace(bench.joint(bench.HOME), flags=bench.FINE | RobotFlag.WARM)
    state = decide(bench, in_mode(bench, M.ACTIVE), joint=warm)
    assert (state.mode, state.reason, state.slow) == (M.ACTIVE, R.NONE, R.ROBOT_WARM)
    unheard = decide(bench, state, joint=None)
    assert unheard.slow is R.ROBOT_WARM, "silence says nothing of its temperature"
    degraded = replace(bench.FAR, health=Health.DEGRADED)
    assert decide(bench, state, joint=warm, human=degraded).slow is R.ROBOT_WARM
    assert decide(bench, state, human=degraded).slow is R.HUMAN_UNHEALTHY
    assert decide(bench, state).slow is R.NONE
    assert decide(bench, in_mode(bench, M.ACTIVE), joint=None).slow is R.NONE


def test_only_arm_leads_to_active(bench: Any) -> None:
    rng = np.random.default_rng(0)
    table = [changes for reason in causes(bench).values() for changes in reason] + [{}] * 20 + [{"joint": None}]
    for _ in range(3000):
        mode = M(int(rng.integers(0, 7)))
        state = in_mode(bench, mode, R(int(rng.integers(0, len(R)))), moving=bool(rng.integers(0, 2)))
        kinds = [EventKind(int(k)) for k in rng.integers(1, 4, rng.integers(0, 3))]
        events = tuple(OperatorEvent(next(_ids), kind) for kind in kinds)
        changes = table[rng.integers(len(table))]
        after = decide(bench, state, events=events, **changes)
        if after.mode is M.ACTIVE and mode is not M.ACTIVE:
            assert EventKind.ARM in kinds
            assert mode in (M.IDLE, M.HOLD, M.STOPPED)
            assert not changes or mode is M.IDLE and "joint" in changes  # the first sample is where the arm is
            assert after.reason is R.NONE
        if mode.is_over:
            assert after.mode is mode


def test_arming_needs_the_rearm_distance(bench: Any) -> None:
    limit = bench.system().params.safety.rearm_distance
    for mode in (M.HOLD, M.STOPPED):
        for d in (limit - 1e-6, 0.0, -1.0, -np.inf, np.nan):
            state = decide(bench, in_mode(bench, mode), d, events=event(EventKind.ARM))
            assert (state.mode, state.reason) == (mode, R.START_INSIDE)
        for d in (limit, 1.0, np.inf):
            state = decide(bench, in_mode(bench, mode, R.INFEASIBLE), d, events=event(EventKind.ARM))
            assert (state.mode, state.reason) == (M.ACTIVE, R.NONE)


def test_arming_needs_a_sample_of_the_robot(bench: Any) -> None:
    """Or the distance to the people would be one to nothing: infinite."""
    state = decide(bench, in_mode(bench, M.HOLD), events=event(EventKind.ARM), joint=None)
    assert (state.mode, state.reason) == (M.HOLD, R.LATE)


def test_a_person_who_comes_near_later_is_the_filters_business(bench: Any) -> None:
    assert decide(bench, in_mode(bench, M.ACTIVE), 0.01).mode is M.ACTIVE


def test_stop_brakes_and_a_stop_after_an_arm_wins(bench: Any) -> None:
    state = decide(bench, in_mode(bench, M.ACTIVE), events=event(EventKind.STOP))
    assert (state.mode, state.reason) == (M.STOPPING, R.OPERATOR_STOP)
    both = event(EventKind.ARM) + event(EventKind.STOP)
    assert decide(bench, in_mode(bench, M.HOLD), events=both).mode is M.STOPPED


@pytest.mark.parametrize("mode", [M.IDLE, M.HOLD, M.ACTIVE, M.STOPPING, M.STOPPED])
@pytest.mark.parametrize("moving", [False, True])
def test_end_ends_from_every_mode_and_nothing_arms_after_it(bench: Any, mode: Mode, moving: bool) -> None:
    state = decide(bench, in_mode(bench, mode, moving=moving), events=event(EventKind.END))
    assert state.ending
    assert state.mode is (M.STOPPING if moving else M.ENDED)
    if moving:
        state = decide(bench, replace(state, dq_cmd=vector(np.zeros(6))), events=event(EventKind.ARM))
        assert state.mode is M.ENDED


def test_a_fault_on_the_way_to_the_end_is_a_fault(bench: Any) -> None:
    state = decide(bench, in_mode(bench, M.ACTIVE), events=event(EventKind.END))
    state = decide(bench, state, joint=bench.joint(bench.HOME + 0.5))
    state = decide(bench, replace(state, dq_cmd=vector(np.zeros(6))))
    assert (state.mode, state.reason) == (M.FAULT, R.TRACKING)


def test_an_event_counts_once(bench: Any) -> None:
    arm = event(EventKind.ARM)
    armed = decide(bench, in_mode(bench, M.HOLD), events=arm)
    assert armed.mode is M.ACTIVE
    stopped = replace(armed, mode=M.STOPPED)
    assert decide(bench, stopped, events=arm).mode is M.STOPPED
    # an ARM that came at the wrong time is used up, not kept for later
    late = event(EventKind.ARM)
    used = decide(bench, in_mode(bench, M.STOPPING), events=late)
    assert decide(bench, replace(used, mode=M.STOPPED), events=late).mode is M.STOPPED


def test_goals(bench: Any) -> None:
    params, state = bench.system().params, in_mode(bench, M.HOLD)
    q = vector(bench.GOALS[0])
    x = bench.inputs(bench.joint(bench.HOME))

    def goal_after(goal: Goal, before: Any = state) -> Any:
        return observe(params, before, replace(x, goal=goal)).goal

    assert goal_after(Goal(4, q)) == Goal(4, q)
    beyond = np.array(params.robot.q_max)
    for wrong in (q + beyond, q * np.nan, np.full(6, -np.inf), q[:5], np.append(q, 0.0)):
        assert goal_after(Goal(4, vector(wrong))).id == 0
    had = replace(state, goal=Goal(4, q))
    assert goal_after(Goal(4, vector(q + 0.1)), had) is had.goal  # the same id changes nothing
    assert goal_after(Goal(3, vector(q + 0.1)), had) is had.goal


def test_the_set_point_is_seeded_once_from_the_measured_pose(bench: Any) -> None:
    params = bench.system().params
    first = observe(params, initial(bench.system()), bench.inputs(bench.joint(bench.HOME)))
    assert first.mode is M.HOLD
    np.testing.assert_array_equal(first.q_cmd, bench.HOME)
    np.testing.assert_array_equal(first.goal.q, bench.HOME)
    second = observe(params, first, bench.inputs(bench.joint(bench.HOME + 0.05)))
    np.testing.assert_array_equal(second.q_cmd, bench.HOME)


def test_tracking_allows_for_the_way_of_the_latency_and_no_more(bench: Any) -> None:
    params = bench.system().params
    allowed = params.tracking_tolerance + 2.0 * params.robot.command_latency_ns * 1e-9 * 2.0
    for speed in (2.0, -2.0):
        state = replace(in_mode(bench, M.ACTIVE), dq_cmd=vector(speed * np.eye(6)[0]))
        for share, reason in ((0.99, R.NONE), (1.01, R.TRACKING)):
            behind = bench.HOME - np.sign(speed) * share * allowed * np.eye(6)[0]
            assert decide(bench, state, joint=bench.joint(behind)).reason is reason


def test_stopping_keeps_the_worst_reason_of_one_stop_and_forgets_older_stops(bench: Any) -> None:
    assert stopping(in_mode(bench, M.STOPPING, R.LATE), R.HUMAN_STALE).reason is R.LATE
    assert stopping(in_mode(bench, M.ACTIVE, R.NONE), R.HUMAN_STALE).reason is R.HUMAN_STALE
    assert stopping(in_mode(bench, M.STOPPING, R.HUMAN_STALE), R.LATE).reason is R.LATE


@pytest.mark.parametrize(("d", "rests"), [(0.001, False), (0.0, False), (-0.001, True), (np.nan, True)])
def test_where_contact_cannot_be_excluded_no_way_is_known_to_lead_away(bench: Any, d: float, rests: bool) -> None:
    """MEASURED, 1 of 711 trials of the campaign: a bat that worked on 8 mm beside a forearm came closer at 17 mm/s."""
    at_work = decide(bench, in_mode(bench, M.ACTIVE), d=d)
    assert (at_work.mode, at_work.reason) == ((M.STOPPING, R.SEPARATION) if rests else (M.ACTIVE, R.NONE))
    armed = decide(bench, in_mode(bench, M.HOLD), d=d, events=event(EventKind.ARM))
    assert (armed.mode, armed.reason) == (M.HOLD, R.START_INSIDE)


def figures(distance: float, needed: float) -> Monitor:
    return Monitor(distance, needed, 0.1, 0.03, 0.07, 0.1)


@pytest.mark.parametrize(
    ("monitor", "kept"),
    [
        (figures(0.8, 0.8), True),
        (figures(0.79, 0.8), False),
        (figures(np.inf, np.inf), True),
        (figures(3.0, np.inf), False),
        (None, False),
    ],
)
@pytest.mark.parametrize("is_enforced", [False, True])
def test_a_cell_that_enforces_the_protective_distance_rests_within_it(
    bench: Any, monitor: Monitor | None, kept: bool, is_enforced: bool
) -> None:
    params = replace(bench.system().params, monitor=MonitorParams(is_enforced=is_enforced))
    x = bench.inputs(bench.joint(bench.HOME))
    moving = next_mode(params, in_mode(bench, M.ACTIVE), x, FAR_AWAY, monitor)
    armed = next_mode(params, in_mode(bench, M.HOLD), replace(x, events=event(EventKind.ARM)), FAR_AWAY, monitor)
    if kept or not is_enforced:
        assert (moving.mode, moving.reason, armed.mode, armed.reason) == (M.ACTIVE, R.NONE, M.ACTIVE, R.NONE)
    else:
        assert (moving.mode, moving.reason, armed.mode, armed.reason) == (
            M.STOPPING,
            R.SEPARATION,
            M.HOLD,
            R.SEPARATION,
        )
    blind = next_mode(params, in_mode(bench, M.ACTIVE), replace(x, human=None, sensors=()), FAR_AWAY, monitor)
    assert blind.reason is R.HUMAN_MISSING  # why there is no distance says more than that there is none


def test_a_late_cycle_goes_on_slowly(bench: Any) -> None:
    state = decide(bench, in_mode(bench, M.ACTIVE), late=True)
    assert (state.mode, state.slow) == (M.ACTIVE, R.LATE)
    assert decide(bench, state).slow is R.NONE


def test_a_tool_of_another_weight_is_not_armed(bench: Any) -> None:
    params, x = bench.system().params, bench.inputs(bench.joint(bench.HOME), events=event(EventKind.ARM))
    state = next_mode(params, in_mode(bench, M.HOLD), x, FAR_AWAY, None, weighs_other=True)
    assert (state.mode, state.reason) == (M.HOLD, R.TOOL_MISMATCH)


@pytest.mark.parametrize(("before", "after"), [(R.NONE, R.SESSION_END), (R.HUMAN_STALE, R.HUMAN_STALE)])
def test_the_end_keeps_why_the_robot_rested(bench: Any, before: StopReason, after: StopReason) -> None:
    state = decide(bench, in_mode(bench, M.STOPPED, before), events=event(EventKind.END))
    assert (state.mode, state.reason) == (M.ENDED, after)
