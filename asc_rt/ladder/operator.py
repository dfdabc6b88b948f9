"""The operator of a step: goals, stops and what is taken away, by what the cell says of itself ten times a second."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from asc_rt import topics
from asc_rt.bus import Bus, Publisher
from asc_rt.config import Cell
from asc_rt.console import WAITING, Operator
from asc_rt.core.params import STAND_IN, Params
from asc_rt.core.types import EventKind, Mode
from asc_rt.ladder.steps import Action, Goals, Step
from logs.audit_finding import Finding

FAST = 0.7  # of the greatest speed seen on the way to the first goal: there the arm is stopped, or made blind
REMIND_S = 10.0  # a person who is to arm is told again after so long
AFTER_S = 1.0  # that a stopped arm is watched before the step is done

Tell = Callable[[str], None]


class MakeOperator:
    """The operator of a step for `run_cell`. `tell` says to the person at the keyboard what to do; in a simulated cell
    it is done without a word."""

    def __init__(self, step: Step, tell: Tell) -> None:
        self._step, self._tell = step, tell
        self._made: StepOperator | None = None

    def __call__(self, bus: Bus, cell: Cell) -> Operator:
        events, goals = bus.event_publisher(topics.OPERATOR.key), bus.event_publisher(topics.GOAL.key)
        faults = bus.event_publisher(topics.FAULT.key) if cell.simulated else None
        self._made = StepOperator(events, goals, faults, self._step, cell, self._tell)
        return self._made

    def finding(self) -> Finding:
        """Whether the step was done to its end. One that somebody ended, or that took too long, was not."""
        done = self._made is not None and self._made.is_done
        return Finding(
            "done", done, "to its end" if done else f"ended before, or not done in {self._step.task.seconds:g} s"
        )


class StepOperator(Operator):
    """`is_done` once the step has shown what it is to show. It arms a simulated cell only; a real one a person does."""

    def __init__(
        self,
        events: Publisher,
        goals: Publisher,
        simulated: Publisher | None,
        step: Step,
        cell: Cell,
        tell: Tell,
    ) -> None:
        """`simulated`: takes faults of the simulated robot; None: the robot is real."""
        self._task, self._params, self._tell, self._simulated = step.task, cell.params, tell, simulated
        self._sensor = "camera" if "camera" in cell.sim else "human"  # the simulated device that sees people
        super().__init__(
            events,
            goals,
            cell.goals if step.task.goals is Goals.CELL else (),
            arms_itself=simulated is not None and step.task.arm,
        )
        self._begun: float | None = None
        self._since: float | None = None  # the mode is what it is
        self._mode = ""
        self._active_s = 0.0
        self._asked = -math.inf  # when a person was told to arm
        self._last = 0.0
        self._peak = 0.0  # greatest speed so far, share of the joints' limits
        self._acted = 0  # times that `action` was done
        self._acting = False  # until the arm rests
        self._tools = [mount for mount in cell.params.changer.mounts if mount.number != STAND_IN]
        self._reached_with_tool = 0

    def hear(self, state: dict[str, Any], now: float) -> None:
        self._keep_time(state["mode"], now)
        if self._task.goals is Goals.JOINTS and not self._poses and state["mode"] != Mode.IDLE.name:
            self._poses = swings(state["q_cmd"], math.radians(self._task.swing_deg), self._params)
        self._act(state, now)
        self._ask_to_arm(state, now)
        self.is_done = self.is_done or self._has_shown_all(state, now)
        if not self.is_done:
            super().hear(state, now)

    def _keep_time(self, mode: str, now: float) -> None:
        if self._begun is None:
            self._begun = self._last = now
        if mode != self._mode:
            self._mode, self._since = mode, now
        elif mode == Mode.ACTIVE.name:
            self._active_s += now - self._last
        self._last = now

    def _ask_to_arm(self, state: dict[str, Any], now: float) -> None:
        """A person at a real cell, again and again while it waits for that."""
        waits = self._task.arm and state["mode"] in WAITING and not self._acting
        over = self._task.action in (Action.STOP, Action.BLIND) and self._acted >= self._times
        if self._simulated is None and waits and not over and now - self._asked >= REMIND_S:
            self._asked = now
            self._tell("type arm")

    def _act(self, state: dict[str, Any], now: float) -> None:
        """Once a goal was reached and the speed of the arm is known: what the step is about."""
        speed = max(abs(v) / limit for v, limit in zip(state["dq_cmd"], self._params.robot.dq_max, strict=True))
        resting = state["mode"] in WAITING
        if self._acting:
            self._acting = not resting
            if resting:
                self._asked = -math.inf
                self._rested(now)
        elif state["mode"] == Mode.ACTIVE.name and self._acted < self._times:
            fast = speed >= FAST * self._peak
            if self._task.action in (Action.STOP, Action.BLIND) and state["reached_id"] > 0 and fast:
                self._do()
            elif self._task.action is Action.TOOL and state["reached_id"] > self._reached_with_tool:
                self._reached_with_tool = state["reached_id"]
                self._do()
        self._peak = max(self._peak, speed)

    @property
    def _times(self) -> int:
        """How often `action` is done: a tool change leads to every tool but the one that is there."""
        return max(len(self._tools) - 1, 0) if self._task.action is Action.TOOL else self._task.count

    def _do(self) -> None:
        self._acted += 1
        self._acting = True
        if self._task.action is not Action.BLIND:
            self.say(EventKind.STOP)
        elif self._simulated is not None:
            self.takes_away.append(self._sensor)
        else:
            self._tell("now unplug or cover the sensor of people")

    def _rested(self, now: float) -> None:
        """The arm stands: mount the next tool, arm again, or, after the last stop, leave it so."""
        if self._task.action is Action.TOOL:
            self._asked = now  # once the tool is there
            self._mount(self._acted)
        elif self._task.action is Action.STOP and self._acted >= self._times:
            self._arms_itself = False

    def _mount(self, index: int) -> None:
        mount = self._tools[index]
        if self._simulated is None:
            self._tell(f"mount tool {mount.tool.name} (number {mount.number}), then type arm")
        elif self._params.changer.told_by_robot:
            self._simulated.put_json({"at_s": 0, "fault": "tool", "value": mount.number})
        if not self._params.changer.told_by_robot:
            self.say(EventKind.TOOL, mount.number)

    def _has_shown_all(self, state: dict[str, Any], now: float) -> bool:
        task = self._task
        if not task.arm:
            return now - (self._begun or now) >= task.hold_s
        if task.action in (Action.STOP, Action.BLIND):
            stopped = state["mode"] == Mode.STOPPED.name and now - (self._since or now) >= AFTER_S
            return self._acted >= task.count and not self._acting and stopped
        if task.action is Action.TOOL and self._acted < self._times:
            return False
        if task.goals is not Goals.NONE and not task.hold_s:
            wanted = len(self._poses) if task.goals is Goals.JOINTS else task.count + self._reached_with_tool
            return bool(self._poses) and state["reached_id"] >= wanted
        return self._active_s >= task.hold_s


def swings(q: Sequence[float], swing: float, params: Params) -> list[list[float]]:
    """Goals: each joint from `q` by `swing` (rad) towards the middle of its range, and back."""
    poses = []
    for j, (low, high) in enumerate(zip(params.robot.q_min, params.robot.q_max, strict=True)):
        away = list(q)
        away[j] += swing if q[j] <= (low + high) / 2 else -swing
        poses += [away, list(q)]
    return poses
