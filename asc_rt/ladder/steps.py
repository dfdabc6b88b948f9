"""The steps of the ladder as data: `steps/NN-NAME.toml`, in order of what may go wrong.

A step says who may be near, what the operator confirms before and after, what the arm does, how a simulated cell is set
for it, which rules judge the recording, and their limits.
"""

from __future__ import annotations

import hashlib
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from enum import StrEnum
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent / "steps"


class StepError(Exception):
    """A file that is no step, as `FILE: what is wrong`."""


class People(StrEnum):
    """Who is in the cell, beside the arm."""

    NOBODY = "nobody"
    DUMMY = "dummy"
    PERSON = "person"


class Goals(StrEnum):
    NONE = "none"  # no goal: unarmed, or armed and held
    JOINTS = "joints"  # one joint after the other, there and back
    CELL = "cell"  # task.goals_deg of the cell


class Action(StrEnum):
    """What happens while the arm is armed, beside its goals."""

    NONE = "none"
    STOP = "stop"  # the operator's stop, each time the arm is fast
    BLIND = "blind"  # the sensor of people goes
    TOOL = "tool"  # another tool is mounted, at rest


@dataclass(frozen=True, slots=True)
class Task:
    """What the arm does, and when it is done."""

    seconds: float  # the session ends after so long, done or not
    arm: bool = False
    hold_s: float = 0.0  # time to be spent so, unarmed or armed, before the step is done
    goals: Goals = Goals.NONE
    count: int = 0  # goals to reach, or times to do `action`
    swing_deg: float = 0.0  # of a single joint
    speed: float = 1.0  # share of the velocity limits, if the cell's own is not less
    action: Action = Action.NONE


@dataclass(frozen=True, slots=True)
class Step:
    number: int
    name: str
    title: str
    people: People
    confirm: tuple[str, ...]  # what the operator says yes to before anything starts
    asks: tuple[str, ...]  # and after it has ended
    task: Task
    rules: tuple[str, ...]  # names in `rules.RULES`
    limits: Mapping[str, float]
    sim: tuple[str, ...] = field(default=())  # "key=value" for the simulated cell
    digest: str = ""  # SHA-256 of the file

    @property
    def label(self) -> str:
        return f"{self.number} {self.name}"


def load_steps(folder: Path = FOLDER) -> tuple[Step, ...]:
    """All steps, in order. StepError."""
    steps = tuple(load_step(path) for path in sorted(folder.glob("*.toml")))
    if [step.number for step in steps] != list(range(1, len(steps) + 1)):
        raise StepError(f"{folder}: steps are numbered from 1 without a gap, by the names of their files")
    return steps


def load_step(path: Path) -> Step:
    """StepError."""
    number, _, name = path.stem.partition("-")
    try:
        data = path.read_bytes()
        tree = tomllib.loads(data.decode())
        if not number.isdecimal() or not name:
            raise ValueError("its name is not NN-NAME.toml")
        return _step(int(number), name, tree, hashlib.sha256(data).hexdigest())
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise StepError(f"{path}: {error}") from error


def _step(number: int, name: str, tree: dict[str, Any], digest: str) -> Step:
    known = {f.name for f in fields(Step)} - {"number", "name", "digest"}
    if odd := sorted(set(tree) ^ known):
        raise ValueError(f"unknown or missing: {', '.join(odd)}")
    task = tree["task"]
    return Step(
        number=number,
        name=name,
        title=tree["title"],
        people=People(tree["people"]),
        confirm=tuple(tree["confirm"]),
        asks=tuple(tree["asks"]),
        task=Task(**{**task, "goals": Goals(task.get("goals", "none")), "action": Action(task.get("action", "none"))}),
        rules=tuple(tree["rules"]),
        limits={key: float(value) for key, value in tree["limits"].items()},
        sim=tuple(tree["sim"]),
        digest=digest,
    )
