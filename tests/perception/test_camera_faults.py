"""The fault table of the cameras in the cell that sees: every row is safe.

Rays, perception, ladder and a working arm in lockstep; a small picture, somebody who stands outside. What a camera or
perception itself does wrong begins at FAULT_AT; nobody but the operator of the simulation arms again.
"""

from __future__ import annotations

import math

import pytest

from asc_rt.core.types import Mode, StopReason
from sim_hil.camera_faults import Fault
from sim_hil.depth import Optics
from sim_hil.person import Capsules, Person
from sim_hil.seeing_cell import Cell, Story

R = StopReason
FAULT_AT, SECONDS = 1.7, 2.6
OPTICS = Optics(80, 60, 56.0, 56.0)


class Waiting:
    """Outside, and stays there."""

    def at(self, t: float) -> Capsules:
        return Person(1).at(-1.0)


def one(fault: str, value: float = 1.0) -> tuple[Fault, ...]:
    return (Fault(FAULT_AT, fault, "left", value),)


def both(fault: str, value: float = 1.0) -> tuple[Fault, ...]:
    return (Fault(FAULT_AT, fault, "", value),)


def play(script: tuple[Fault, ...], seconds: float = SECONDS) -> Story:
    return Cell(1, OPTICS, Waiting(), script).run(seconds)


SHORT: dict[str, tuple[Fault, ...]] = {
    "perception killed": both("killed"),
    "no joints are heard": both("no_joints"),
    "one frozen": one("freeze"),
    "all unplugged": both("silent"),
    "all covered": both("cover"),
    "one turned": one("turn_deg", 1.0),
    "one with its clock ahead": one("clock_ms", 300.0),
}
LONG: dict[str, tuple[Fault, ...]] = {
    "all frozen": both("freeze"),
    "one unplugged": one("silent"),
    "one covered": one("cover"),
    "one shifted": one("shift_mm", 50.0),
    "one tilted": one("tilt_deg", 1.0),
    "one turned far": one("turn_deg", 5.0),
    "one with its clock a little ahead": one("clock_ms", 15.0),
    "one with its clock behind": one("clock_ms", -60.0),
    "one with its clock far behind": one("clock_ms", -600.0),
    "all with their clock ahead": both("clock_ms", 300.0),
}
OF_PEOPLE = {R.HUMAN_STALE, R.HUMAN_UNHEALTHY, R.HUMAN_COVERAGE, R.SEPARATION, R.INFEASIBLE}


def check(script: tuple[Fault, ...]) -> None:
    story = play(script)
    assert story.mode is Mode.STOPPED and story.outcome.stops == 1, "it worked until then"
    assert story.reasons[-1] in OF_PEOPLE, "the arm stops for what is not known of people"
    assert 0.0 < story.rest_after < 0.75
    assert not story.outcome.robot_caused


@pytest.mark.parametrize("name", SHORT)
def test_every_row_is_safe(name: str) -> None:
    check(SHORT[name])


@pytest.mark.slow
@pytest.mark.parametrize("name", LONG)
def test_every_other_row_is_safe(name: str) -> None:
    check(LONG[name])


def test_without_a_fault_it_works_on_and_a_late_clock_is_only_old() -> None:
    for script in ((), both("clock_ms", -30.0)):
        story = play(script)
        assert story.mode is Mode.ACTIVE and not story.outcome.stops and math.isnan(story.rest_after)
