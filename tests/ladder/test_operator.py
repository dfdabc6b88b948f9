"""What the operator of a step does at a real cell: tells a person, and never arms."""

from __future__ import annotations

import json
from typing import Any

import pytest

from asc_rt.config import load_cell
from asc_rt.ladder.operator import REMIND_S, StepOperator, swings
from asc_rt.ladder.steps import load_steps
from tests.box import Box

STEPS = {step.name: step for step in load_steps()}


class Desk:
    """A step's operator and what it says; `hear` lets a tenth of a second pass."""

    def __init__(self, name: str, cell: str = "fanuc-sim-truth", real: bool = True) -> None:
        self.events, self.goals, self.faults, self.told = Box(), Box(), Box(), []
        self.now = 0.0
        faults = None if real else self.faults
        self.operator = StepOperator(self.events, self.goals, faults, STEPS[name], load_cell(cell), self.told.append)

    def hear(self, mode: str, reached: int = 0, speed: float = 0.0, seconds: float = 0.1) -> None:
        state = {"mode": mode, "reached_id": reached, "goal_id": 0, "q_cmd": [0.0] * 6, "dq_cmd": [speed] + [0.0] * 5}
        for _ in range(round(seconds * 10)):
            self.now += 0.1
            self.operator.hear(state, self.now)

    def said(self) -> list[str]:
        found = []
        while (data := self.events.take()) is not None:
            found.append(json.loads(data)["kind"])
        return found


def test_a_person_is_told_to_arm_again_and_again_and_nobody_else_does() -> None:
    desk = Desk("hold")
    desk.hear("HOLD", seconds=2 * REMIND_S + 1)
    assert desk.told == ["type arm"] * 3 and desk.said() == []
    desk.hear("ACTIVE", seconds=STEPS["hold"].task.hold_s + 0.2)
    assert desk.operator.is_done


@pytest.mark.parametrize("name", ["link", "listen"])
def test_where_nothing_moves_nobody_is_asked_to_arm(name: str) -> None:
    for real in (True, False):
        desk = Desk(name, real=real)
        desk.hear("HOLD", seconds=6)
        assert desk.told == [] and desk.said() == [] and desk.operator.is_done


def test_it_stops_the_arm_where_it_is_fast_and_asks_to_arm_again_but_after_the_last() -> None:
    desk = Desk("stop")
    desk.hear("HOLD")
    desk.hear("ACTIVE", 0, 1.0, 0.5)
    assert desk.said() == [], "how fast it can be is known once a goal was reached"
    for number in range(1, 4):
        desk.hear("ACTIVE", number, 0.2)
        assert desk.said() == [], "slow"
        desk.hear("ACTIVE", number, 0.9)
        assert desk.said() == ["STOP"]
        desk.hear("STOPPING", number)
        desk.hear("STOPPED", number, seconds=0.5)
    assert desk.told == ["type arm"] * 3
    desk.hear("STOPPED", 3, seconds=1.0)
    assert desk.operator.is_done and desk.told == ["type arm"] * 3


def test_a_person_unplugs_the_sensor_of_a_real_cell() -> None:
    desk = Desk("blind")
    desk.hear("ACTIVE", 0, 1.0)
    desk.hear("ACTIVE", 1, 0.9)
    assert desk.told == ["now unplug or cover the sensor of people"] and desk.operator.takes_away == []
    desk.hear("STOPPED", 1, seconds=REMIND_S + 2)
    assert desk.told[1:] == [] and desk.operator.is_done


def test_a_person_changes_the_tools_of_a_real_cell_one_after_the_other() -> None:
    desk = Desk("tool", "fanuc-tools")
    for number in (1, 2):
        desk.hear("ACTIVE", number, 1.0)
        desk.hear("STOPPED", number)
        desk.hear("ACTIVE", number, 1.0)
    assert desk.said() == ["STOP", "STOP"]
    assert [line.split(" (")[0] for line in desk.told if "mount" in line] == ["mount tool bat", "mount tool bare"]
    assert not desk.operator.is_done
    desk.hear("ACTIVE", 4, 1.0)
    assert desk.operator.is_done


def test_each_joint_swings_towards_the_middle_of_its_range_and_back() -> None:
    params: Any = load_cell("fanuc-sim-truth").params
    q = [*params.robot.q_max[:3], *params.robot.q_min[3:]]
    poses = swings(q, 0.1, params)
    assert len(poses) == 12 and poses[1::2] == [q] * 6
    assert [round(pose[j] - q[j], 6) for j, pose in enumerate(poses[::2])] == [-0.1] * 3 + [0.1] * 3
