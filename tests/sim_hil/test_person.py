from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_hil.person import FLOOR_Z, LABELS, Capsules, Person

SEEDS = range(6)
HANDS = [LABELS.index("left_forearm"), LABELS.index("right_forearm")]


def record(seed: int, until: float, step: float = 0.02) -> tuple[np.ndarray, list[Capsules]]:
    person, times = Person(seed), np.arange(0.0, until, step)
    return times, [person.at(t) for t in times]


@given(seed=st.integers(0, 2**32), t=st.floats(0.0, 60.0))
@settings(max_examples=60, deadline=None)
def test_velocity_is_the_derivative_of_position(seed: int, t: float) -> None:
    person, h = Person(seed), 1e-4
    before, now, after = person.at(t - h), person.at(t), person.at(t + h)
    for ends, speeds in ((1, 4), (2, 5)):
        # the central difference is off by |p'''| h^2 / 6; a jump of the acceleration would make it first order in h
        assert (after[ends] - before[ends]) / (2 * h) == pytest.approx(now[speeds], abs=1e-4)


@pytest.mark.parametrize("seed", SEEDS)
def test_no_jump_in_position_or_velocity_at_the_seams(seed: int) -> None:
    person = Person(seed)
    person.at(40.0)
    seams = [person.phase(t).start for t in np.arange(0.0, 40.0, 0.1)]
    for seam in sorted(set(seams)):
        before, after = person.at(seam - 1e-7), person.at(seam + 1e-7)
        for i in (1, 2, 4, 5):
            assert after[i] == pytest.approx(before[i], abs=1e-5)


@pytest.mark.parametrize("seed", SEEDS)
def test_speeds_and_places_are_as_promised(seed: int) -> None:
    _, frames = record(seed, 60.0)
    p0, p1 = (np.array([frame[i] for frame in frames]) for i in (1, 2))
    v0, v1 = (np.array([frame[i] for frame in frames]) for i in (4, 5))
    assert np.linalg.norm(v0[:, 0], axis=1).max() <= 1.6, "walks"
    assert np.linalg.norm(v1[:, HANDS], axis=2).max() <= 2.0, "hands"
    assert min(np.hypot(p[:, 0, 0], p[:, 0, 1]).min() for p in (p0, p1)) >= 0.75, "torso stays off the robot"
    radius = frames[0].radius[None, :]
    assert min((p[:, :, 2] - radius).min() for p in (p0, p1)) >= FLOOR_Z - 1e-9, "nothing below the floor"


@pytest.mark.parametrize("seed", SEEDS)
def test_limbs_hang_together_and_keep_their_lengths(seed: int) -> None:
    _, frames = record(seed, 20.0, 0.1)
    lengths = np.array([np.linalg.norm(frame.p1 - frame.p0, axis=1) for frame in frames])
    assert np.ptp(lengths, axis=0) == pytest.approx(np.zeros(len(LABELS)), abs=1e-9)
    for frame in frames:
        for side in ("left", "right"):
            for upper, lower in (("upper_arm", "forearm"), ("thigh", "shank")):
                a, b = LABELS.index(f"{side}_{upper}"), LABELS.index(f"{side}_{lower}")
                assert frame.p1[a] == pytest.approx(frame.p0[b])


@pytest.mark.parametrize("seed", range(20))
def test_the_first_20_seconds_hold_a_whole_visit(seed: int) -> None:
    times, frames = record(seed, 20.0)
    person = Person(seed)
    names = [person.phase(t).name for t in times]
    assert names.index("walk in") < names.index("reach") < names.index("hold") < names.index("walk out")
    leave = person.phase(times[names.index("walk out")])
    assert leave.start + leave.duration < 20
    hands = np.array([frame.p1[HANDS] for frame in frames])
    rho, z = np.hypot(hands[..., 0], hands[..., 1]), hands[..., 2]
    held = np.array([name == "hold" for name in names])
    inside = (rho > 0.34) & (rho < 0.61) & (z > 0.09) & (z < 0.51)
    assert inside[held].any(axis=1).all(), "a held hand is at table height within the workspace"
    assert rho.min() > 0.3
    for t in (0.0, leave.start + leave.duration):
        assert np.hypot(*person.at(t).p0[0, :2]) == pytest.approx(2.7), "comes from outside and leaves"


def test_a_pure_function_of_seed_and_time() -> None:
    there, back = Person(7), Person(7)
    times = np.linspace(0, 50, 40)
    forward = [there.at(t) for t in times]
    backward = [back.at(t) for t in times[::-1]][::-1]
    for a, b in zip(forward, backward, strict=True):
        assert all(np.array_equal(x, y) for x, y in zip(a[1:], b[1:], strict=True))
    assert not np.array_equal(Person(8).at(5.0).p0, there.at(5.0).p0)


def test_before_time_zero_the_person_stands_still() -> None:
    early, start = Person(3).at(-5.0), Person(3).at(0.0)
    assert np.array_equal(early.p1, start.p1)
    assert not early.v0.any() and not early.v1.any()
