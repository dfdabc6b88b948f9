"""Each step passes where nothing goes wrong, and fails for every fault, for the reason that names it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from asc_rt.core.types import Mode, RobotFlag, StopReason
from asc_rt.ladder.rules import RULES, Run, judge
from asc_rt.ladder.steps import load_steps
from logs.audit_rules import RULES as AUDIT
from tests.ladder.conftest import Climb
from tests.ladder.rig import Rig

STEPS = load_steps()
Passed = Callable[[int], Run]
Spoil = Callable[[dict[str, np.ndarray]], None]


def broken(run: Run) -> set[str]:
    return {finding.name for finding in judge(run) if not finding.holds}


@pytest.mark.parametrize("step", STEPS, ids=lambda step: step.name)
def test_a_step_in_which_nothing_goes_wrong_passes_its_judges_and_the_audit(step, passed: Passed) -> None:
    run = passed(step.number)
    assert broken(run) == set(), judge(run)
    assert [found.name for found in (rule(run.e) for rule in AUDIT) if not found.holds] == []


# --- faults of robot, person and sensor, in the simulation -----------------------------------------------------------


def at(cycle: int, fault: str, count: int = 1, value: int = 1) -> Callable[[Rig], None]:
    def strike(rig: Rig) -> None:
        if rig.cycles == cycle:
            rig.robot.inject(fault, count, value)

    return strike


def sensor_stays(rig: Rig) -> None:
    rig.sensor_works = True


NOBODY = ["sim.human.start_s=1e6", "sim.human.still_at_s=0.0"]
FAULTS = [
    (1, [], at(20, "emergency_stop"), {"heard", "stops as asked"}),
    (2, ["sim.fanuc.start_deg=[0, 0, 0, 0, -124, 0]"], None, {"plausible pose"}),
    (3, [], at(100, "lose_status", 30), {"heard"}),
    (4, ["sim.fanuc.lag_ms=150"], None, {"follows"}),
    (5, ["sim.fanuc.lag_ms=150"], None, {"follows"}),
    (6, ["sim.fanuc.lag_ms=250"], None, {"stopping distance"}),
    (7, [], sensor_stays, {"stops as asked", "stopping distance", "stays stopped"}),
    (8, NOBODY, None, {"separation kept"}),
    (9, [], at(60, "emergency_stop"), {"goals", "stops as asked"}),
    (10, ["sim.human.latency_ms=250"], None, {"separation kept", "goals"}),
]


def test_there_is_a_fault_for_every_step() -> None:
    assert {number for number, *_ in FAULTS} == {step.number for step in STEPS}


@pytest.mark.parametrize(
    ("number", "settings", "mischief", "names"), FAULTS, ids=[STEPS[f[0] - 1].name for f in FAULTS]
)
def test_a_fault_in_the_simulation_makes_the_step_fail(number, settings, mischief, names, climb: Climb) -> None:
    assert broken(climb(number, settings, mischief)) >= names


# --- made recordings -------------------------------------------------------------------------------------------------


def spoilt(run: Run, spoil: Spoil) -> Run:
    columns = {name: column.copy() for name, column in run.c.items()}
    spoil(columns)
    e = dataclasses.replace(run.e, c={name: columns[name] for name in run.e.c})
    return dataclasses.replace(run, c=columns, e=e)


def shift(path: str, cycles: slice, by: float, joint: int = 2) -> Spoil:
    def spoil(c: dict[str, np.ndarray]) -> None:
        c[path][cycles, joint] += by

    return spoil


def put(path: str, cycles: slice | int, value: float) -> Spoil:
    def spoil(c: dict[str, np.ndarray]) -> None:
        c[path][cycles] = value

    return spoil


def late(c: dict[str, np.ndarray]) -> None:
    """The arm does all it does 25 cycles later."""
    c["inputs.joint.q"][25:] = c["inputs.joint.q"][:-25].copy()


FLAGS = int(RobotFlag.READY | RobotFlag.SERVO_ON)
SOME = slice(40, 60)
MADE = [
    ("heard", 1, put("inputs.joint.present", SOME, 0)),
    ("heard", 1, put("inputs.missed_ticks", 30, 9)),
    ("heard", 1, put("inputs.joint.flags", 30, FLAGS | int(RobotFlag.FAULTED))),
    ("heard", 1, put("inputs.joint.flags", 30, FLAGS | int(RobotFlag.EMERGENCY_STOP))),
    ("heard", 1, put("inputs.joint.flags", 30, int(RobotFlag.READY))),
    ("heard", 1, put("inputs.joint.present", slice(None), 0)),
    ("still", 1, put("inputs.joint.present", slice(None), 0)),
    ("plausible pose", 2, put("inputs.joint.present", slice(None), 0)),
    ("unarmed", 2, put("state.mode", 30, Mode.ACTIVE)),
    ("still", 1, shift("inputs.joint.q", SOME, 0.002)),
    ("still", 3, shift("inputs.joint.q", SOME, 0.002)),
    ("plausible pose", 2, shift("inputs.joint.q", slice(None), 0.02)),
    ("plausible pose", 2, shift("inputs.joint.q", slice(0, 1), 4.0)),
    ("armed and held", 3, put("state.mode", slice(100, None), Mode.HOLD)),
    ("armed and held", 3, shift("state.q_cmd", slice(100, 102), 1e-3)),
    ("goals", 4, put("state.reached_id", slice(None), 11)),
    ("one joint at a time", 4, put("state.goal.id", slice(None), 1)),
    ("one joint at a time", 4, shift("inputs.joint.q", slice(100, 102), 0.02)),
    ("one joint at a time", 4, lambda c: c["inputs.joint.q"].__imul__(0.5)),
    ("follows", 5, late),
    ("follows", 5, shift("inputs.joint.q", slice(150, 152), 0.02)),
    ("speed", 5, shift("state.dq_cmd", slice(150, 151), 3.0)),
    ("speed", 5, put("outputs.decision.monitor.robot_speed", 150, 0.3)),
    ("speed", 5, put("state.dq_cmd", slice(None), 0.0)),
    ("speed", 5, put("outputs.decision.monitor.present", slice(None), 0)),
    ("stops as asked", 6, put("state.reason", slice(None), StopReason.TRACKING)),
    ("stopping distance", 6, late),
    ("stopping distance", 6, put("state.dq_cmd", slice(None), 0.01)),
    ("stopping distance", 6, shift("inputs.joint.q", slice(-20, -15), 0.01)),  # the way is as it was, the time is not
    ("stays stopped", 7, put("state.mode", slice(-3, None), Mode.ACTIVE)),
    ("separation kept", 8, put("outputs.decision.d_measured", slice(None), 0.5)),
    ("tool", 9, put("inputs.joint.tool_id", 100, 4)),
    ("goals", 10, put("state.reached_id", slice(None), 0)),
]


@pytest.mark.parametrize(("name", "number", "spoil"), MADE, ids=[f"{m[0]}-{i}" for i, m in enumerate(MADE)])
def test_a_recording_in_which_something_is_wrong_fails(name: str, number: int, spoil: Spoil, passed: Passed) -> None:
    assert name in broken(spoilt(passed(number), spoil))


def with_limit(run: Run, key: str, value: float) -> Run:
    return dataclasses.replace(run, step=dataclasses.replace(run.step, limits={**run.step.limits, key: value}))


def test_stops_that_begin_slowly_show_nothing(passed: Passed) -> None:
    assert broken(with_limit(passed(6), "least_speed_share", 0.9)) == {"stopping distance"}


def test_a_stop_for_another_reason_is_one_too_many_however_many_were_as_asked(passed: Passed) -> None:
    run = with_limit(passed(6), "stops", 2)
    assert broken(run) == set()
    last = int(np.flatnonzero(run.c["state.mode"] == Mode.ACTIVE)[-1])
    assert "stops as asked" in broken(spoilt(run, put("state.reason", slice(last, None), StopReason.TRACKING)))


def test_every_rule_has_a_recording_that_breaks_it() -> None:
    assert {name for name, *_ in MADE} == set(RULES)


def test_what_the_plant_says_counts_against_what_the_controller_knows(passed: Passed) -> None:
    run = passed(8)
    run.truth.distance, run.truth.approach = np.array([0.2, 0.09, 0.2]), np.array([0.0, 0.2, 0.0])
    try:
        assert broken(run) == {"separation kept"}
        run.truth.approach = np.array([0.0, 0.0, 0.0])
        assert broken(run) == set()
    finally:
        run.truth.distance = run.truth.approach = np.array([])


def test_every_step_names_rules_that_exist_and_the_limits_that_they_need() -> None:
    for step in STEPS:
        assert set(step.rules) <= RULES.keys(), step.name
        needed = {limit for name in step.rules for limit in RULES[name][1]}
        assert needed == step.limits.keys(), step.name
