"""The numbers of a session from its log alone."""

import dataclasses
import json
from typing import Any

import pytest

from asc_rt.core.types import CycleOutputs, Mode, Status, StopReason, StopRequest
from logs import schema
from logs.reader import LogError
from logs.summary import summarise

KEYS = {
    "cycles", "period_ms", "missed_deadlines", "cycle_us", "wake_us", "min_distance_m", "robot_caused_violations",
    "infeasible_cycles", "goals_reached", "stops", "dropped_records", "log", "exit_reason",
}  # fmt: skip


T0_NS = 5_000_000_000  # of the first cycle, as the fixture dates it


def truth(*rows: tuple[float | None, float]) -> list[Any]:
    """(distance, approach speed) of the simulated plant, one each period."""
    return [
        (schema.TRUTH, T0_NS + k, {"distance_m": distance, "approach_m_s": approach, "contact": distance == 0.0})
        for k, (distance, approach) in enumerate(rows)
    ]


def changed(recording: Any, cycles: list[Any], at: int, **fields: Any) -> None:
    """Other state (`mode`, `reason`), inputs (`late`, ...) or decision (`status`, `d_measured`) in one cycle."""
    state, x, out, receipt, timings = cycles[at]
    for name, value in fields.items():
        if name in ("mode", "reason"):
            state = dataclasses.replace(state, **{name: value})
        elif name in ("late", "missed_ticks", "joint"):
            x = dataclasses.replace(x, **{name: value})
        else:
            out = dataclasses.replace(out, decision=dataclasses.replace(out.decision, **{name: value}))
    cycles[at] = (state, x, out, receipt, timings)


def test_a_plain_session(recording: Any) -> None:
    found = summarise(path := recording.write(recording.packed(recording.cycles(100)), truth((0.5, 0.0), (0.3, 0.0))))
    assert set(found) >= KEYS
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert (found["cycles"], found["period_ms"], found["log"]) == (100, 8.0, str(path))
    assert found["cycle_us"] == {"p50": 610.0, "p99": 610.0, "max": 610.0}
    assert found["wake_us"] == {"p50": 10.0, "p99": 10.0, "max": 10.0}
    assert (found["missed_deadlines"], found["infeasible_cycles"], found["dropped_records"]) == (0, 0, 0)
    assert found["goals_reached"] == 2
    assert (found["stops"], found["exit_reason"]) == ([], "SESSION_END")
    assert (found["min_distance_m"], found["robot_caused_violations"]) == (0.3, 0)


def test_without_ground_truth_the_measured_distance_counts(recording: Any) -> None:
    cycles = recording.cycles(20)
    changed(recording, cycles, 12, d_measured=-0.25)
    found = summarise(recording.write(recording.packed(cycles)))
    assert found["min_distance_m"] == -0.25
    assert found["robot_caused_violations"] is None


def test_nobody_near_is_no_distance(recording: Any) -> None:
    found = summarise(recording.write(recording.packed(recording.cycles(5)), truth((None, 0.0))))
    assert found["min_distance_m"] is None


@pytest.mark.parametrize(
    ("rows", "violations"),
    [
        ([(0.05, 0.0)], 0),  # the person came to a robot at rest
        ([(0.05, 0.009)], 0),  # servo noise
        ([(0.05, 0.2)], 1),
        ([(0.2, 1.0)], 0),  # fast, but far enough away
        ([(0.05, 0.2), (0.04, 0.0), (0.05, 0.3)], 1),  # one episode
        ([(0.05, 0.2), (0.2, 0.0), (0.05, 0.0), (None, 0.0), (0.05, 0.5)], 2),
    ],
)
def test_only_what_the_robot_does_is_its_violation(recording: Any, rows: list[Any], violations: int) -> None:
    assert recording.params.safety.d_min == pytest.approx(0.1)
    found = summarise(recording.write(recording.packed(recording.cycles(5)), truth(*rows)))
    assert found["robot_caused_violations"] == violations


def test_what_happened_before_and_after_the_session_is_not_its_own(recording: Any) -> None:
    cycles = recording.cycles(5)
    near = {"distance_m": 0.01, "approach_m_s": 0.5, "contact": True}
    far = {"distance_m": 0.7, "approach_m_s": 0.0, "contact": False}
    truth = [(schema.TRUTH, T0_NS + offset, told) for offset, told in ((-(10**9), near), (1000, far), (10**9, near))]
    found = summarise(recording.write(recording.packed(cycles), truth))
    assert (found["min_distance_m"], found["robot_caused_violations"], found["contacts"]) == (0.7, 0, 0)


def test_contacts_are_counted(recording: Any) -> None:
    found = summarise(recording.write(recording.packed(recording.cycles(5)), truth((0.0, 0.0), (0.0, 0.0), (0.1, 0.0))))
    assert found["contacts"] == 1


def test_late_and_missed_periods_are_each_counted_once(recording: Any) -> None:
    cycles = recording.cycles(20)
    changed(recording, cycles, 5, late=True)
    changed(recording, cycles, 8, late=True, missed_ticks=3)
    assert summarise(recording.write(recording.packed(cycles)))["missed_deadlines"] == 4


def test_infeasible_cycles(recording: Any) -> None:
    cycles = recording.cycles(20)
    changed(recording, cycles, 5, status=Status.INFEASIBLE)
    assert summarise(recording.write(recording.packed(cycles)))["infeasible_cycles"] == 1


def test_stops_tell_when_why_and_how_long(recording: Any) -> None:
    cycles = recording.cycles(40)
    for k in range(10, 15):
        changed(recording, cycles, k, mode=Mode.STOPPING, reason=StopReason.HUMAN_STALE)
    for k in range(15, 20):
        changed(recording, cycles, k, mode=Mode.STOPPED, reason=StopReason.HUMAN_INVALID)
    stops = summarise(recording.write(recording.packed(cycles)))["stops"]
    assert stops == [
        {"cycle": 9, "t_s": 0.072, "reason": "HUMAN_STALE", "final_reason": "HUMAN_INVALID", "braking_s": 0.04}
    ]


def test_a_fault_ends_the_session_and_is_a_stop(recording: Any) -> None:
    cycles = recording.cycles(20, end=False)
    state, x, out, _, timings = cycles[-1]
    decision = dataclasses.replace(out.decision, reason=StopReason.ROBOT_SILENT)
    out = CycleOutputs(decision, None, StopRequest(StopReason.ROBOT_SILENT))
    cycles[-1] = (state, x, out, None, timings)
    found = summarise(recording.write(recording.packed(cycles)))
    assert found["exit_reason"] == "ROBOT_SILENT"
    assert [(stop["cycle"], stop["reason"]) for stop in found["stops"]] == [(19, "ROBOT_SILENT")]


def test_a_log_that_just_stops_is_unfinished(recording: Any) -> None:
    found = summarise(recording.write(recording.packed(recording.cycles(20, end=False)), close=False))
    assert (found["exit_reason"], found["truncated"]) == ("UNFINISHED", True)


def test_dropped_records_are_seen_in_the_ticks_and_in_the_count(recording: Any) -> None:
    packed = recording.packed(recording.cycles(20))
    assert summarise(recording.write(packed[:5] + packed[8:]))["dropped_records"] == 3
    told = [(schema.DROPOUT, 1, {"cycle": 2, "wire": 0}), (schema.DROPOUT, 2, {"cycle": 7, "wire": 0})]
    assert summarise(recording.write(packed, told))["dropped_records"] == 7


def test_an_empty_session_has_a_summary(recording: Any) -> None:
    found = summarise(recording.write([]))
    assert (found["cycles"], found["exit_reason"], found["stops"]) == (0, "UNFINISHED", [])
    assert found["cycle_us"] == {"p50": None, "p99": None, "max": None}


def test_truth_that_is_none_is_one_clear_line(recording: Any) -> None:
    path = recording.write(recording.packed(recording.cycles(5)), [(schema.TRUTH, T0_NS + 1, {"foreign": 1})])
    with pytest.raises(LogError, match="/sim/truth"):
        summarise(path)


def test_photon_to_command_is_from_the_oldest_capture_to_the_sending(recording: Any) -> None:
    """Data 30 ms old at freezing; sending follows as the fixture dates it. Two cycles with a second, older sensor."""
    cycles = recording.cycles(50)
    for at in (10, 11):
        state, x, out, receipt, timings = cycles[at]
        older = dataclasses.replace(x.sensors[0], id=2, age_ns=75_000_000)
        cycles[at] = (state, dataclasses.replace(x, sensors=(*x.sensors, older)), out, receipt, timings)
    found = summarise(recording.write(recording.packed(cycles)))["photon_to_command_ms"]
    assert 30.0 <= found["p50"] < 38.0 and found["max"] == pytest.approx(found["p50"] + 45.0)
    assert sum(count for _, count in found["histogram"]) == 48, "the first two cycles knew of nobody"
    assert found["histogram"][0] == [30.0, 46] and found["histogram"][-1] == [70.0, 2]
