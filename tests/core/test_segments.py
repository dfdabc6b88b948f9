"""Two capsules of any length, from a point to a torso: distance, its bound, and how the distance changes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from asc_rt.core.abstraction import ROUNDING, People, _at_least, distance, pair, place
from asc_rt.core.kinematics import Chain, forward

Segment = tuple[Any, Any]
STILL = np.zeros((1, 3))


def person(ends: Segment, v: Segment = (STILL, STILL), radius: float = 0.0) -> People:
    p0, p1, v0, v1 = (np.reshape(x, (1, 3)) for x in (*ends, *v))
    return People(p0, p1, v0, v1, np.full(1, radius), np.zeros(1))


def world(ends: Segment) -> Segment:
    """As the kernels have a capsule's ends, so that none is compiled anew."""
    p0, p1 = (tuple(float(x) for x in end) for end in ends)
    return p0, p1


def crossing(rng: Any, lengths: Any, gap: float) -> tuple[Segment, Segment]:
    """Two segments at 20 degrees or more whose nearest points are inside both, `gap` apart."""
    angle, middle = rng.uniform(0.35, np.pi - 0.35), rng.uniform(-1.0, 1.0, 3)
    frame = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    ways = frame[0], np.cos(angle) * frame[0] + np.sin(angle) * frame[1]
    feet, shares = (middle, middle + gap * frame[2]), rng.uniform(0.2, 0.8, 2)
    first, second = (
        (foot - share * length * way, foot + (1.0 - share) * length * way)
        for foot, way, share, length in zip(feet, ways, shares, lengths, strict=True)
    )
    return first, second


def test_the_distance_of_segments_of_every_length(bench: Any) -> None:
    """A fingertip across the middle of a forearm is as near as its nearest point, not as the forearm's end."""
    rng = np.random.default_rng(0)
    for _ in range(300):
        lengths, gap = 10.0 ** rng.uniform(-5.0, 0.0, 2), rng.uniform(0.01, 0.5)
        robot, human = crossing(rng, lengths, gap)
        assert distance(*world(robot), 0.03, person(human, radius=0.02), 0) == pytest.approx(gap - 0.05, abs=1e-9)
        # and wherever the nearest points are
        moved = [end + rng.normal(size=3) * lengths[1] for end in human]
        expected = bench.segment_distance(*world(robot), *moved)
        assert distance(*world(robot), 0.0, person((moved[0], moved[1])), 0) == pytest.approx(expected, abs=1e-7)


def test_a_point_is_a_segment_too_and_nothing_is_divided_by_its_length(bench: Any) -> None:
    a, b = np.array([0.1, 0.2, 0.3]), np.array([0.5, 0.2, 0.3])
    with np.errstate(all="raise"):
        for x in (-0.3, 0.2, 0.9):  # before, beside and behind the other
            point = np.array([x, 0.5, 0.3])
            for robot, human in (((point, point), (a, b)), ((a, b), (point, point)), ((point, point), (a, a))):
                expected = bench.segment_distance(*world(robot), *human)
                assert distance(*world(robot), 0.0, person(human), 0) == pytest.approx(expected, abs=1e-12)


def test_spheres_around_both_are_never_farther_than_the_capsules() -> None:
    """And as far, but for rounding, where one capsule is in line with the other."""
    rng = np.random.default_rng(1)
    for _ in range(300):
        p0, p1, q0, q1 = rng.uniform(-1.0, 1.0, (4, 3))
        people, radius = person((q0, q1), radius=rng.uniform(0.0, 0.1)), rng.uniform(0.0, 0.1)
        assert _at_least(*world((p0, p1)), radius, people, 0) <= distance(*world((p0, p1)), radius, people, 0)
        in_line = person((p1 + 0.2 * (p1 - p0), p1 + rng.uniform(0.3, 3.0) * (p1 - p0)), radius=0.05)
        exact = 0.2 * np.linalg.norm(p1 - p0) - radius - 0.05
        for robot in ((p0, p1), (p1, p0)):
            assert exact - 2.0 * ROUNDING < _at_least(*world(robot), radius, in_line, 0) < exact


def test_what_the_base_carries_feels_only_how_the_person_moves_however_short_they_are(bench: Any) -> None:
    """Velocity and acceleration of the distance of a capsule at rest, by differences: the nearest points slip along
    both segments."""
    rng, h, checked = np.random.default_rng(2), 1e-4, 0
    chain = Chain(np.eye(3)[None], np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]))
    motion = forward(chain, np.ones(1), np.ones(1))
    for _ in range(100):
        lengths = 10.0 ** rng.uniform(-2.0, 0.0, 2)
        robot, human = crossing(rng, lengths, rng.uniform(0.1, 0.5))
        assert [place(motion, -1, end) for end in robot] == [tuple(end) for end in robot]
        v0 = rng.normal(0.0, 0.5, 3)
        v = v0, v0 + rng.normal(0.0, 1.0, 3) * lengths[1]

        def at(t: float, robot: Any = robot, human: Any = human, v: Any = v) -> float:
            ends = (end + t * speed for end, speed in zip(human, v, strict=True))
            return float(bench.segment_distance(*world(robot), *ends))

        behind, now, ahead, far_behind, far_ahead = (at(t) for t in (-h, 0.0, h, -2.0 * h, 2.0 * h))
        rate, bend = (ahead - behind) / (2.0 * h), (ahead - 2.0 * now + behind) / h**2
        if abs((far_ahead - 2.0 * now + far_behind) / (4.0 * h**2) - bend) > 1e-2:
            continue  # a nearest point reaches an end
        C = np.ones(1)
        d_dot, drift, own, own_drift = pair(motion, -1, *world(robot), person(human, v), 0, 3.0, C)
        assert (C[0], own, own_drift) == (0.0, 0.0, 0.0)
        assert d_dot == pytest.approx(rate, abs=1e-5)
        assert drift == pytest.approx(bend - 3.0, abs=1e-2)
        checked += 1
    assert checked > 60
