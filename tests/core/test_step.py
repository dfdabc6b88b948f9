"""The whole decision in lockstep: what the robot does when things go wrong, and that the same cycle has the same
bytes."""

from __future__ import annotations

import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import asc_rt.core.step as module
from asc_rt.core.params import Params
from asc_rt.core.step import step
from asc_rt.core.system import System, initial
from asc_rt.core.types import EventKind, Goal, Health, Mode, OperatorEvent, RobotFlag, Status, StopReason, vector

T = 0.008
POST = [[0.45, 0.35, -0.2]], [[0.45, 0.35, 0.6]]  # a person who stands on the way to the left
LEFT = np.radians([80.0, 20.0, 10.0, 0.0, -75.0, 0.0])


def walker(bench: Any, seconds: float = 2.2, radius: float = 0.12) -> Any:
    """Comes in from the front to where the tool works, stays, goes back: 1.6 m in `seconds`, up to 3 m/s2."""

    def people(t: float) -> Any:
        phase = t % 8.0
        s = np.clip((phase - np.array([1.0, 5.0])) / seconds, 0.0, 1.0)  # of the way in, of the way out
        share = -np.diff(s**3 * (10.0 - 15.0 * s + 6.0 * s * s))[0]
        slope = -np.diff(30.0 * s * s * (1.0 - s) ** 2)[0]
        x, side = 2.15 - 1.6 * share, 0.25 * np.sin(0.7 * t)
        made = bench.human([[x, side, -0.3]], [[x, side, 0.6]], radius)
        along = np.array([[-1.6 * slope / seconds, 0.175 * np.cos(0.7 * t), 0.0]])
        return replace(made, v0=vector(along), v1=vector(along))

    return people


def speeds(cycles: Any) -> Any:
    return np.array([np.abs(c.state.dq_cmd).max() for c in cycles])


def violations(bench: Any, system: Any, rig: Any) -> Any:
    """(d, robot's own approach speed) of the true arm and the true people, by the tests' own distance, where d <
    d_min."""
    found = []
    for a, b in zip(rig.cycles, rig.cycles[1:], strict=False):
        human = rig.people(a.x.tick * T)
        d = bench.true_distance(system, a.q_true, human)
        if d < system.params.safety.d_min:
            found.append((d, (d - bench.true_distance(system, b.q_true, human)) / T))
    return np.array(found).reshape(-1, 2)


def check_set_points(bench: Any, system: Any, cycles: Any) -> None:
    """Every command follows from the one before within every limit, whatever the mode did."""
    b = system.bounds
    for before, after in zip(cycles, cycles[1:], strict=False):
        p, s = before.state, after.state
        assert np.all(np.abs(s.q_cmd - p.q_cmd) <= T * b.dq_max * (1 + 1e-5))
        assert np.all(np.abs(s.dq_cmd - p.dq_cmd) <= T * b.ddq_max * (1 + 1e-5))
        assert np.all(np.abs(s.ddq_cmd - p.ddq_cmd) <= T * b.dddq_max * (1 + 1e-5) + 1e-6)
        assert np.all((b.q_min <= s.q_cmd) & (s.q_cmd <= b.q_max))
        if after.out.command is not None:
            np.testing.assert_array_equal(after.out.command.q, s.q_cmd)


def test_it_works_when_nobody_is_there(bench: Any) -> None:
    rig = bench.Rig(bench.system(), lambda t: bench.NOBODY)
    cycles = rig.run(6.0)
    assert rig.state.reached_id >= 3
    assert {c.out.decision.status for c in cycles if c.state.mode is Mode.ACTIVE} == {Status.PASS}
    check_set_points(bench, bench.system(), cycles)


def test_without_human_data_it_never_moves(bench: Any) -> None:
    rig = bench.Rig(bench.system(), lambda t: bench.NOBODY)
    for k in range(200):
        rig.cycle((rig.arm(),) if k % 7 == 0 else (), Goal(1, vector(LEFT)), human=None, human_age_ns=0)
        np.testing.assert_array_equal(rig.state.q_cmd, bench.HOME)
        assert rig.state.mode is Mode.HOLD
    assert rig.state.reason is StopReason.HUMAN_MISSING


def test_without_arming_it_never_moves(bench: Any) -> None:
    rig = bench.Rig(bench.system(), lambda t: bench.FAR)
    for _ in range(100):
        cycle = rig.cycle(goal=Goal(1, vector(LEFT)))
        np.testing.assert_array_equal(cycle.out.command.q, bench.HOME)


def moving_rig(bench: Any, people: Any = None, cycles: int = 60) -> Any:
    rig = bench.Rig(bench.system(), people or (lambda t: bench.FAR))
    rig.cycle()
    rig.cycle((rig.arm(),), Goal(1, vector(LEFT)))
    while rig.tick < cycles:
        rig.cycle()
    assert rig.state.mode is Mode.ACTIVE and np.abs(rig.state.dq_cmd).max() > 0.5
    return rig


FAILURES = {
    "human gone": ({"human": None, "human_age_ns": 0}, StopReason.HUMAN_MISSING, Mode.STOPPED),
    "human stale": ({"human_age_ns": 201_000_000}, StopReason.HUMAN_STALE, Mode.STOPPED),
    "sensor gone": ({"sensors": ()}, StopReason.HUMAN_MISSING, Mode.STOPPED),
    "samples lost": ({"missed_ticks": 12}, StopReason.LATE, Mode.STOPPED),
    "operator": ({"events": (OperatorEvent(99, EventKind.STOP),)}, StopReason.OPERATOR_STOP, Mode.STOPPED),
    "end": ({"events": (OperatorEvent(99, EventKind.END),)}, StopReason.SESSION_END, Mode.ENDED),
}


@pytest.mark.parametrize("name", list(FAILURES))
def test_a_failure_in_motion_brakes_on_the_planned_profile_to_rest(bench: Any, name: str) -> None:
    changes, reason, end = FAILURES[name]
    rig = moving_rig(bench)
    b, start = bench.system().bounds, rig.state
    peak = np.abs(start.dq_cmd) + start.ddq_cmd**2 / (2.0 * b.dddq_max)
    bound = np.max(np.abs(start.ddq_cmd) / b.dddq_max + peak / b.ddq_max + b.ddq_max / b.dddq_max)
    for _ in range(int(bound / T) + 3):
        rig.cycle(**changes)
        assert rig.state.reason is reason
        if not speeds(rig.cycles[-1:])[0]:
            break
    rig.cycle(**changes)
    assert rig.state.mode is end
    assert not np.any(rig.state.dq_cmd) and not np.any(rig.state.ddq_cmd)
    check_set_points(bench, bench.system(), rig.cycles)
    rest = rig.state.q_cmd
    for _ in range(30):  # and stays there when all is well again, until a person arms
        rig.cycle()
        np.testing.assert_array_equal(rig.state.q_cmd, rest)
    if end is Mode.STOPPED:
        rig.cycle((OperatorEvent(100, EventKind.ARM),))
        assert rig.state.mode is Mode.ACTIVE
    else:
        assert rig.cycles[-1].out.command.is_last


def test_stale_data_stop_the_robot_within_the_age_limit_plus_its_stopping_time(bench: Any) -> None:
    """The publisher dies: the same message, older each cycle."""
    rig = moving_rig(bench)
    last, age = rig.cycles[-1].x.human, rig.cycles[-1].x.human_age_ns
    for k in range(1, 200):
        rig.cycle(human=last, human_age_ns=age + k * 8_000_000)
        if rig.state.mode is Mode.STOPPED:
            break
        fresh = age + k * 8_000_000 <= 200_000_000
        assert rig.state.mode is (Mode.ACTIVE if fresh else Mode.STOPPING)
    assert rig.state.mode is Mode.STOPPED
    assert k * T <= 0.2 + 1.0


def test_an_enforced_protective_distance_stops_a_robot_that_the_rows_let_go_on(bench: Any) -> None:
    """A person who stands still, out of the way: no row asks for a stop, S_p of a fast arm is longer."""
    person = bench.human([[1.15, 0.0, 0.3]])
    for is_enforced in (False, True):
        params = bench.system().params
        monitor = replace(params.monitor, is_enforced=is_enforced)
        system = System(replace(params, monitor=monitor))
        rig = bench.Rig(system, lambda t: person)
        rig.run(0.5)
        assert rig.state.mode is Mode.ACTIVE and rig.state.reason is StopReason.NONE
        fast = replace(rig.cycles[-1].x.joint, dq=vector([2.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
        assert rig.cycle(joint=fast).out.decision.reason is (StopReason.SEPARATION if is_enforced else StopReason.NONE)
        assert rig.state.mode is (Mode.STOPPING if is_enforced else Mode.ACTIVE)


@pytest.mark.parametrize(
    ("flags", "reason"),
    [
        (RobotFlag.SERVO_ON, StopReason.ROBOT_NOT_READY),
        (RobotFlag.READY | RobotFlag.FAULTED, StopReason.ROBOT_FAULTED),
        (RobotFlag.READY | RobotFlag.EMERGENCY_STOP, StopReason.ROBOT_FAULTED),
    ],
)
def test_a_robot_that_listens_no_more_is_left_at_once(bench: Any, flags: RobotFlag, reason: StopReason) -> None:
    rig = moving_rig(bench)
    cycle = rig.cycle(joint=replace(rig.cycles[-1].x.joint, flags=flags))
    assert cycle.out.command is None
    assert cycle.out.stop is not None and cycle.out.stop.reason is reason
    assert cycle.state.mode is Mode.FAULT


def test_a_silent_robot_is_left_after_the_silence_limit(bench: Any) -> None:
    rig = moving_rig(bench)
    for k in range(12):
        cycle = rig.cycle(joint=None)
        assert cycle.out.command is None
        assert (cycle.out.stop is not None) == (k == 11)
    assert cycle.out.stop.reason is StopReason.ROBOT_SILENT
    assert rig.state.mode is Mode.FAULT


def test_a_robot_that_does_not_follow_is_braked_and_the_session_is_over(bench: Any) -> None:
    rig = moving_rig(bench)
    stuck = bench.joint(bench.HOME - 0.5)
    for _ in range(150):
        cycle = rig.cycle(joint=stuck)
        if cycle.state.mode is Mode.FAULT:
            break
        assert cycle.out.command is not None and cycle.state.mode is Mode.STOPPING
    assert cycle.out.stop is not None and cycle.out.stop.reason is StopReason.TRACKING
    assert np.abs(cycle.state.dq_cmd).max() < 1e-9


def test_a_first_pose_that_is_no_pose_moves_nothing(bench: Any) -> None:
    system = bench.system()
    for q in (bench.HOME * np.nan, system.bounds.q_max + 0.1):
        state, out = step(
            system, initial(system), bench.inputs(bench.joint(q), events=(OperatorEvent(1, EventKind.ARM),))
        )
        assert state.mode is Mode.FAULT
        assert out.command is None and out.stop is not None


def test_rows_in_conflict_brake_the_robot(bench: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever makes the QP infeasible: here floors that nothing reaches."""
    rig = moving_rig(bench)
    real = module.rows

    def impossible(*args: Any) -> Any:
        found = real(*args)
        values = found.values.copy()
        values[3:5] = 1e3  # floor and base
        return found._replace(values=values)

    rig.people = lambda t: bench.human([[0.9, 0.0, 0.3]])
    monkeypatch.setattr(module, "rows", impossible)
    cycle = rig.cycle()
    assert cycle.out.decision.status is Status.INFEASIBLE
    assert (cycle.state.mode, cycle.state.reason) == (Mode.STOPPING, StopReason.INFEASIBLE)
    monkeypatch.setattr(module, "rows", real)
    while rig.state.mode is Mode.STOPPING:
        cycle = rig.cycle()
        assert cycle.out.command is not None
    assert rig.state.mode is Mode.STOPPED
    check_set_points(bench, bench.system(), rig.cycles)


@pytest.mark.compiled
def test_the_robot_stops_before_a_person_who_stands_there_and_stays_out_of_d_min(bench: Any) -> None:
    system = bench.system()
    person = bench.human(*POST, 0.13)
    rig = bench.Rig(system, lambda t: person)
    rig.run(40.0, goals=[LEFT])
    d = np.array([bench.true_distance(system, c.q_true, person) for c in rig.cycles[::5]])
    assert d.min() >= system.params.safety.d_min - 1e-4
    assert d.min() <= system.params.safety.d_min + 0.02  # the filter gives way as far as it may
    assert rig.state.mode is Mode.ACTIVE and rig.state.reached_id == 0
    check_set_points(bench, system, rig.cycles)


@pytest.mark.compiled
@pytest.mark.parametrize("seconds", [3.5, 1.8])
def test_a_person_who_walks_in_is_never_approached_inside_d_min(bench: Any, seconds: float) -> None:
    system = bench.system()
    rig = bench.Rig(system, walker(bench, seconds))
    rig.run(16.0)
    found = violations(bench, system, rig)
    assert np.all(found[:, 1] < 0.01)
    assert rig.state.reached_id >= 2  # it did work
    assert any(c.out.decision.status is Status.FILTERED for c in rig.cycles)
    check_set_points(bench, system, rig.cycles)


def test_without_the_rows_the_same_scenes_would_end_in_violations(bench: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The two tests above are worth something: their scenes are dangerous."""
    real = module.rows

    def none(*args: Any) -> Any:
        found = real(*args)
        values = found.values.copy()
        values[3:5] = -1e6  # floor and base
        return found._replace(values=values)

    monkeypatch.setattr(module, "rows", none)
    system = bench.system()
    person = bench.human(*POST, 0.13)
    for people, goals in ((lambda t: person, [LEFT]), (walker(bench, 1.8), bench.GOALS)):
        rig = bench.Rig(system, people)
        rig.run(6.0, goals=goals)
        found = violations(bench, system, rig)
        assert np.any(found[:, 1] > 0.1)


def test_the_same_arguments_give_the_same_bytes_in_any_order(bench: Any) -> None:
    system = bench.system()
    rig = bench.Rig(system, walker(bench))
    rig.run(3.0)
    assert {c.state.mode for c in rig.cycles} >= {Mode.HOLD, Mode.ACTIVE}
    order = np.random.default_rng(0).permutation(len(rig.cycles))
    for i in order[:200]:
        cycle = rig.cycles[i]
        before = pickle.dumps((cycle.before, cycle.x))
        again = step(system, cycle.before, cycle.x)
        assert pickle.dumps(again) == pickle.dumps((cycle.state, cycle.out))
        assert pickle.dumps((cycle.before, cycle.x)) == before  # the arguments are left alone


def test_a_fresh_system_from_the_recorded_parameters_decides_the_same(bench: Any) -> None:
    rig = bench.Rig(bench.system(), walker(bench))
    rig.run(2.0)
    again = System(Params.from_canonical(bench.params().canonical()))
    for cycle in rig.cycles[100::25]:
        assert pickle.dumps(step(again, cycle.before, cycle.x)) == pickle.dumps((cycle.state, cycle.out))


def test_outputs_are_read_only(bench: Any) -> None:
    rig = moving_rig(bench)
    cycle = rig.cycles[-1]
    for values in (cycle.state.q_cmd, cycle.out.command.q, cycle.out.decision.u_safe, cycle.out.decision.u_ref):
        with pytest.raises(ValueError, match="read-only"):
            values[0] = 1.0


def test_the_record_says_what_was_done(bench: Any) -> None:
    """achieved = C u of what is sent; it keeps the floor, apart from the share of rows that give way."""
    rig = bench.Rig(bench.system(), walker(bench))
    rig.run(5.0)
    filtered = [c for c in rig.cycles if c.out.decision.status is Status.FILTERED]
    assert len(filtered) > 50
    for cycle in filtered:
        made = cycle.out.decision
        if made.share == 1.0:
            assert np.all(made.pairs.achieved >= made.pairs.floor - 1e-5)
        np.testing.assert_allclose(made.u_safe, cycle.state.ddq_cmd, atol=1e-9)


def random_inputs(bench: Any, rng: Any, rig: Any, tick: int) -> dict[str, Any]:
    """Valid, often unpleasant."""
    m = int(rng.integers(0, 5))
    p0 = rng.uniform([-1.0, -1.0, -0.3], [1.0, 1.0, 1.2], (m, 3))
    p1 = p0 + rng.normal(0.0, 0.4, (m, 3)) * rng.integers(0, 2, (m, 1))
    human = bench.human(p0, p1, rng.uniform(0.01, 0.4, m), rng.normal(0.0, 1.5, (m, 3)))
    human = replace(
        human,
        position_bound=vector(rng.uniform(0.0, 0.2, m)),
        velocity_bound=vector(rng.uniform(0.0, 1.0, m)),
        health=Health.OK if rng.random() < 0.98 else Health.DEGRADED,
    )
    kind = EventKind.ARM if rng.random() < 0.9 else EventKind.STOP
    rig.event += 1
    changes: dict[str, Any] = {
        "human": human if rng.random() < 0.98 else None,
        "human_age_ns": int(rng.integers(-10, 190)) * 1_000_000,
        "events": (OperatorEvent(rig.event, kind),) if rng.random() < 0.3 else (),
        "missed_ticks": int(rng.integers(0, 3)),
        "late": bool(rng.integers(0, 2)),
        "goal": Goal(tick, vector(rng.uniform(bench.system().bounds.q_min, bench.system().bounds.q_max))),
    }
    return changes


@pytest.mark.compiled
def test_no_valid_input_raises_or_breaks_a_limit(bench: Any) -> None:
    system = bench.system()
    rng = np.random.default_rng(11)
    rig = bench.Rig(system, lambda t: bench.FAR)
    modes, statuses = set(), set()
    calm: dict[str, Any] = {}
    for k in range(2500):
        if k % 40 == 0:  # a scene lasts a third of a second; quick changes would only ever stop the robot
            calm = random_inputs(bench, rng, rig, k)
        shown = calm if rng.random() < 0.9 else random_inputs(bench, rng, rig, k)
        rig.event += 1
        armed = {"events": (OperatorEvent(rig.event, EventKind.ARM),)} if rig.state.mode is Mode.STOPPED else {}
        lost = {"joint": None} if rng.random() < 0.02 else {}
        cycle = rig.cycle(**{**shown, **armed, **lost})
        modes.add(cycle.state.mode)
        statuses.add(cycle.out.decision.status)
        if cycle.state.mode.is_over:
            break
    assert {Mode.ACTIVE, Mode.STOPPING, Mode.STOPPED} <= modes
    assert not modes & {Mode.FAULT, Mode.ENDED}
    assert Status.FILTERED in statuses
    check_set_points(bench, system, rig.cycles)


@pytest.mark.parametrize("goal", ["high", "low"])
def test_goals_at_the_joint_limits_and_a_stop_on_the_way_stay_inside_them(bench: Any, goal: str) -> None:
    system = bench.system()
    b = system.bounds
    q = np.array(b.q_max if goal == "high" else b.q_min)
    q[[1, 2, 4]] = bench.HOME[[1, 2, 4]]
    for stop_at in (60, 120, 180, 400):
        rig = bench.Rig(system, lambda t: bench.NOBODY)
        rig.cycle()
        rig.cycle((rig.arm(),), Goal(1, vector(q)))
        for k in range(600):
            rig.cycle((OperatorEvent(50, EventKind.STOP),) if k == stop_at else ())
        assert rig.state.mode is Mode.STOPPED
        assert rig.state.reason is StopReason.OPERATOR_STOP
        check_set_points(bench, system, rig.cycles)


def test_a_defect_brakes_on_the_stop_profile_and_ends_the_session(bench: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """An exception anywhere in the decision is no exception outside: the set-points come to rest, then it is over."""
    system = bench.system()
    start = replace(initial(system), mode=Mode.ACTIVE, dq_cmd=vector(np.full(6, 0.5)))

    def broken(*_: Any) -> Any:
        raise ZeroDivisionError

    monkeypatch.setattr(module, "rows", broken)
    state, out = start, None
    for tick in range(400):
        x = bench.inputs(bench.joint(state.q_cmd), tick=tick)
        if tick == 0:
            with pytest.raises(ZeroDivisionError):
                module.decide(system, state, x)
        state, out = module.step(system, state, x)
        assert state.reason is StopReason.EXCEPTION
        if state.mode.is_over:
            break
        assert out.command is not None and out.stop is None
    assert state.mode is Mode.FAULT and out is not None and out.stop is not None
    assert tick > 5 and np.all(np.abs(state.dq_cmd) < 1e-9) and np.all(np.abs(state.q_cmd) < 0.2)


def test_a_goal_inside_a_person_is_told_with_the_distance_and_never_reached(bench: Any) -> None:
    """The arm stands as near as it may; `d_goal` says what is missing, and the goal is reached when the person goes."""
    system = bench.system()
    goal = bench.GOALS[1]
    way = [place for _, *ends, _ in bench.robot_capsules(system, goal)[-1:] for place in ends]
    there = bench.human(way[0], way[1], 0.05)
    rig = bench.Rig(system, lambda t: there if t < 4.0 else bench.FAR, bench.GOALS[0])
    cycles = rig.run(4.0, [goal])
    missing = cycles[-1].out.decision.d_goal
    assert missing == pytest.approx(bench.true_distance(system, goal, there), abs=2e-6)  # less is touching
    assert missing < system.params.safety.d_min
    assert cycles[-1].state.reached_id == 0 and cycles[-1].state.mode is Mode.ACTIVE
    assert min(bench.true_distance(system, c.q_true, there) for c in cycles) >= system.params.safety.d_min - 1e-4
    assert rig.run(4.0, [goal])[-1].state.reached_id > 0
    assert rig.cycles[-1].out.decision.d_goal > system.params.safety.d_min
