"""The ladder row by row, at both sides of every edge; several sensors; what they see together."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asc_rt.core.fusion import SEVERAL, heard, union, unsure
from asc_rt.core.human_ladder import REFUSED, Verdict, judge
from asc_rt.core.params import HumanParams, SensorParams
from asc_rt.core.people import predict
from asc_rt.core.types import Goal, Health, MessageFault, Mode, StopReason, vector

R, F = StopReason, MessageFault
PARAMS = HumanParams(
    slow_age_ns=100, age_limit_ns=200, future_limit_ns=20, clock_limit_ns=30, slow_coverage=0.9, least_coverage=0.7
)
FINE: dict[str, Any] = {"age_ns": 50, "sigma_ns": 0}
ROWS: list[tuple[dict[str, Any], StopReason, StopReason]] = [
    ({}, R.NONE, R.NONE),
    ({"seq": 0}, R.NONE, R.HUMAN_MISSING),
    ({"age_ns": 100}, R.NONE, R.NONE),
    ({"age_ns": 101}, R.HUMAN_STALE, R.NONE),
    ({"age_ns": 90, "sigma_ns": 11}, R.HUMAN_STALE, R.NONE),
    ({"age_ns": 200}, R.HUMAN_STALE, R.NONE),
    ({"age_ns": 201}, R.HUMAN_STALE, R.HUMAN_STALE),
    ({"age_ns": 190, "sigma_ns": 11}, R.HUMAN_STALE, R.HUMAN_STALE),
    ({"age_ns": -20}, R.NONE, R.NONE),
    ({"age_ns": -21}, R.NONE, R.HUMAN_CLOCK),
    ({"age_ns": -30, "sigma_ns": 10}, R.NONE, R.NONE),
    ({"sigma_ns": 30}, R.NONE, R.NONE),
    ({"sigma_ns": 31}, R.NONE, R.HUMAN_UNSYNCED),
    ({"health": Health.DEGRADED}, R.HUMAN_UNHEALTHY, R.NONE),
    ({"health": Health.FAULT}, R.HUMAN_UNHEALTHY, R.HUMAN_UNHEALTHY),
    ({"says_nothing": True}, R.NONE, R.HUMAN_UNHEALTHY),
    ({"coverage": 0.9}, R.NONE, R.NONE),
    ({"coverage": 0.89}, R.HUMAN_COVERAGE, R.NONE),
    ({"coverage": 0.7}, R.HUMAN_COVERAGE, R.NONE),
    ({"coverage": 0.69}, R.HUMAN_COVERAGE, R.HUMAN_COVERAGE),
    ({"coverage": float("nan")}, R.HUMAN_COVERAGE, R.HUMAN_COVERAGE),
    ({"age_ns": 201, "coverage": 0.69}, R.HUMAN_COVERAGE, R.HUMAN_COVERAGE),  # the worst, wherever it stands
    ({"age_ns": 101, "health": Health.DEGRADED}, R.HUMAN_UNHEALTHY, R.NONE),
    ({"calibration_hash": 7}, R.NONE, R.HUMAN_CALIBRATION),
    *(({"fault": fault}, R.NONE, reason) for fault, reason in REFUSED.items()),
    ({"id": 2}, R.NONE, R.HUMAN_MISSING),
]


@pytest.mark.parametrize(("changes", "slow", "stop"), ROWS, ids=[str(row[0]) for row in ROWS])
def test_every_row(bench: Any, changes: dict[str, Any], slow: StopReason, stop: StopReason) -> None:
    x = bench.inputs(None, sensors=(bench.report(**FINE | changes),))
    assert judge(PARAMS, x) == Verdict(slow, stop)


def test_sensors_that_are_well_and_nothing_of_people_is_not_nobody(bench: Any) -> None:
    x = bench.inputs(None, sensors=(bench.report(**FINE),))
    assert judge(PARAMS, dataclasses.replace(x, human=None)) == Verdict(R.NONE, R.HUMAN_MISSING)


def test_every_fault_of_a_message_has_a_row() -> None:
    assert REFUSED.keys() == set(F) - {F.NONE}
    ends = {fault for fault, reason in REFUSED.items() if reason.is_fault}
    assert ends == {F.SCHEMA, F.CLOCK}


@pytest.mark.parametrize(("changes", "slow", "stop"), ROWS[:-1], ids=[str(row[0]) for row in ROWS[:-1]])
@pytest.mark.parametrize("bad", [1, 2])
def test_of_several_sensors_the_worst_counts(
    bench: Any, bad: int, changes: dict[str, Any], slow: StopReason, stop: StopReason
) -> None:
    two = dataclasses.replace(PARAMS, sensors=(SensorParams("a", 1), SensorParams("b", 2)))
    reports = [bench.report(id=i, **FINE | (changes if i == bad else {})) for i in (1, 2)]
    assert judge(two, bench.inputs(None, sensors=tuple(reports))) == Verdict(slow, stop)


def test_a_lost_sensor_is_not_silence(bench: Any) -> None:
    two = dataclasses.replace(PARAMS, sensors=(SensorParams("a", 1), SensorParams("b", 2)))
    x = bench.inputs(None, sensors=(bench.report(**FINE),))
    assert judge(two, x).stop is R.HUMAN_MISSING


def test_each_sensor_has_its_own_calibration(bench: Any) -> None:
    two = dataclasses.replace(PARAMS, sensors=(SensorParams("a", 1, 5), SensorParams("b", 2, 6)))

    def stop(first: int, second: int) -> StopReason:
        reports = (
            bench.report(id=1, calibration_hash=first, **FINE),
            bench.report(id=2, calibration_hash=second, **FINE),
        )
        return judge(two, bench.inputs(None, sensors=reports)).stop

    assert stop(5, 6) is R.NONE
    assert stop(6, 5) is R.HUMAN_CALIBRATION


def test_slow_is_the_slow_speed_of_the_task_and_no_stop(bench: Any) -> None:
    """The same way with a degraded sensor: at most the slow share of every joint's limit, once it has slowed down."""

    system = bench.system()
    slow = system.params.task.slow_speed * system.bounds.dq_max
    rig = bench.Rig(system, lambda t: bench.FAR)
    rig.cycle()
    rig.cycle((rig.arm(),), Goal(1, vector(bench.GOALS[0])))
    for _ in range(25):
        rig.cycle()
    assert np.any(np.abs(rig.state.dq_cmd) > 1.4 * slow)
    speeds = []
    for _ in range(80):
        rig.cycle(sensors=(bench.report(health=Health.DEGRADED),))
        speeds.append(np.abs(rig.state.dq_cmd))
    assert rig.state.mode is Mode.ACTIVE and rig.state.slow is R.HUMAN_UNHEALTHY
    slowed = next(i for i, speed in enumerate(speeds) if np.all(speed <= 1.01 * slow))
    assert np.all(np.array(speeds[slowed:]) <= 1.01 * slow) and np.any(speeds[-1] > 0.0)
    for _ in range(20):
        rig.cycle(late=True)
    assert rig.state.slow is R.LATE
    rig.cycle()
    assert rig.state.slow is R.NONE


# --- what several sensors see together -------------------------------------------------------------------------------


@given(
    waits=st.lists(st.integers(0, 150), min_size=2, max_size=3), horizon=st.floats(0.0, 0.3), seed=st.integers(0, 99)
)
def test_the_union_is_predicted_as_each_sensor_alone(bench: Any, waits: list[int], horizon: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    states = []
    for i, wait in enumerate(waits, start=1):
        m = int(rng.integers(0, 4))
        p0, v = rng.normal(size=(m, 3)), rng.normal(size=(m, 3))
        made = bench.human(p0, p0 + 0.1, 0.05, v, seq=i, sensor_id=i, t_capture_ns=1_000_000_000 - wait * 1_000_000)
        states.append(
            dataclasses.replace(made, position_bound=rng.uniform(0, 0.1, m), velocity_bound=rng.uniform(0, 0.5, m))
        )
    together = union(states)
    assert together is not None and together.sensor_id == SEVERAL
    now_ns = max(s.t_capture_ns for s in states) + round(horizon * 1e9)
    found = predict(together, (now_ns - together.t_capture_ns) * 1e-9)
    alone = [predict(s, (now_ns - s.t_capture_ns) * 1e-9) for s in states]
    for name in ("p0", "p1", "v0", "v1", "radius", "velocity_bound"):
        expected = np.concatenate([getattr(people, name) for people in alone])
        np.testing.assert_allclose(getattr(found, name), expected, atol=1e-9)


def test_the_union_keeps_the_worst_that_they_say_of_themselves(bench: Any) -> None:
    good, bad = bench.FAR, dataclasses.replace(bench.FAR, health=Health.DEGRADED, coverage=0.5, empty_certified=False)
    good = dataclasses.replace(good, seq=7, t_capture_ns=9_000_000)
    for states in ([good, bad], [bad, good]):
        found = union(states)
        assert found is not None
        assert (found.health, found.coverage, found.empty_certified) == (Health.DEGRADED, 0.5, False)
        assert (found.seq, found.t_capture_ns) == (7, 9_000_000)
    assert union([]) is None and union([good]) is good


def test_a_stamp_that_may_be_off_grows_the_people_only(bench: Any) -> None:
    human = bench.human([1.0, 0.0, 0.0], v=(0.0, 2.0, 0.0), velocity_bound=np.array([0.5]))
    assert unsure(human, 0.0).position_bound.tolist() == [0.0]
    grown = unsure(human, 0.1)
    assert grown.position_bound == pytest.approx([0.25])
    assert grown.p0 is human.p0 and grown.velocity_bound is human.velocity_bound


def test_the_faster_end_of_a_capsule_says_how_far_it_may_have_moved(bench: Any) -> None:
    fast, slow = vector([[0.0, 2.0, 0.0]]), vector([[0.0, 0.0, 1.0]])
    for v0, v1 in ((fast, slow), (slow, fast)):
        human = dataclasses.replace(bench.human([1.0, 0.0, 0.0]), v0=v0, v1=v1)
        assert unsure(human, 0.1).position_bound == pytest.approx([0.2])


@pytest.mark.parametrize("somebody", [False, True])
@pytest.mark.parametrize("certified", [False, True])
def test_nobody_and_no_word_that_nobody_is_there_says_nothing(bench: Any, somebody: bool, certified: bool) -> None:
    human = dataclasses.replace(bench.FAR if somebody else bench.NOBODY, empty_certified=certified)
    (told,) = heard(human, 30)
    assert told.says_nothing == (not somebody and not certified)
    assert (told.id, told.seq, told.age_ns) == (human.sensor_id, human.seq, 30)


def test_a_sensor_that_sent_nothing_was_not_heard() -> None:
    assert heard(None, 0) == ()
