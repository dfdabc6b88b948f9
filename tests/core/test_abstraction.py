"""Separation, its two derivatives, M and M_dot, each against something that does not share a line with them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from asc_rt.core.abstraction import People, Separation, least_distance, separation
from asc_rt.core.kinematics import Chain
from asc_rt.core.limits import acceleration_box
from asc_rt.core.polytope import Polytope, greatest, support
from asc_rt.core.radius import radii
from asc_rt.core.robot_model import Capsules

H = 2e-4  # s, of the oracle's differences


def crowd(rng: Any, m: int, moving: bool = True, bound: float = 0.0) -> People:
    """Capsules around the arm, turning and moving; lengths from a point to a torso."""
    p0 = rng.uniform([-0.7, -0.7, -0.2], [0.9, 0.7, 0.9], (m, 3))
    p1 = p0 + rng.normal(0.0, 0.25, (m, 3)) * rng.integers(0, 3, (m, 1))
    v0, v1 = rng.normal(0.0, 1.0, (2, m, 3)) * moving
    v1 = np.where((p0 == p1).all(axis=1, keepdims=True), v0, v1)
    return People(p0, p1, v0, v1, rng.uniform(0.02, 0.15, m), np.full(m, bound))


def shifted(people: People, t: float) -> People:
    return people._replace(p0=people.p0 + t * people.v0, p1=people.p1 + t * people.v1)


def distances(bench: Any, system: Any, q: Any, people: People) -> Any:
    """(robot capsules, human capsules) m; nan for what no joint moves."""
    return np.array(
        [
            [
                np.nan
                if joint < 0
                else bench.segment_distance(p0, p1, people.p0[h], people.p1[h]) - radius - people.radius[h]
                for h in range(len(people.radius))
            ]
            for joint, p0, p1, radius in bench.robot_capsules(system, q)
        ]
    )


def grid(found: Separation, column: Any, shape: tuple[int, int]) -> Any:
    out = np.full(shape, np.nan)
    out[found.robot, found.human] = column
    return out


def motions(count: int, seed: int = 0) -> Any:
    """(q, dq, ddq, people) of an arm in full swing among moving people."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        yield rng.uniform(-1.8, 1.8, 6), rng.uniform(-2.0, 2.0, 6), rng.uniform(-10.0, 10.0, 6), crowd(rng, 4)


def jet(bench: Any, system: Any, q: Any, dq: Any, ddq: Any, people: People, h: float) -> tuple[Any, Any, Any]:
    """d, d_dot, d_ddot of the true nearest distance along the motion, by central differences."""
    before, now, after = (
        distances(bench, system, q + t * dq + t * t / 2.0 * ddq, shifted(people, t)) for t in (-h, 0.0, h)
    )
    return now, (after - before) / (2.0 * h), (after - 2.0 * now + before) / (h * h)


def smooth_jet(bench: Any, system: Any, q: Any, dq: Any, ddq: Any, people: People) -> tuple[Any, Any, Any, Any]:
    """The jet, and where it can be trusted: where two steps agree there is no kink nearby."""
    d, v, a = jet(bench, system, q, dq, ddq, people, H)
    *_, coarse = jet(bench, system, q, dq, ddq, people, 2.0 * H)
    return d, v, a, np.abs(coarse - a) < 1e-3 + 1e-3 * np.abs(a)


def test_the_oracle_itself_agrees_with_a_search_by_brute_force(bench: Any) -> None:
    rng = np.random.default_rng(3)
    s = np.linspace(0.0, 1.0, 201)
    for _ in range(40):
        p0, p1, q0, q1 = rng.uniform(-1.0, 1.0, (4, 3))
        points = (p0 + s[:, None] * (p1 - p0))[:, None] - (q0 + s[:, None] * (q1 - q0))[None]
        searched = np.linalg.norm(points, axis=2).min()
        assert searched - 5e-3 <= bench.segment_distance(p0, p1, q0, q1) <= searched + 1e-12


def test_distance_of_every_pair(bench: Any) -> None:
    system = bench.system()
    for q, dq, _, people in motions(60):
        found = separation(system.model.chain, system.model.capsules, people, q, dq, np.inf, 0.0)
        expected = distances(bench, system, q, people)
        np.testing.assert_allclose(grid(found, found.d, expected.shape), expected, atol=1e-9)


point = st.tuples(*[st.floats(-1.0, 1.0, width=32) for _ in range(3)])
coarse = st.tuples(*[st.integers(-2, 2).map(float) for _ in range(3)])  # makes points, parallels and crossings


@settings(max_examples=300, deadline=None)
@given(ends=st.one_of(st.tuples(point, point, point, point), st.tuples(coarse, coarse, coarse, coarse)))
def test_distance_of_any_two_capsules(bench: Any, ends: Any) -> None:
    """Through the public function: one joint that stands at zero, one capsule on it, one person."""
    p0, p1, q0, q1 = (np.array(end) for end in ends)
    chain = Chain(np.eye(3)[None], np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]))
    capsules = Capsules(np.array([0]), p0[None], p1[None], np.array([0.25]))
    still = np.zeros((1, 3))
    people = People(q0[None], q1[None], still, still, np.array([0.5]), np.zeros(1))
    found = separation(chain, capsules, people, np.zeros(1), np.ones(1), np.inf, 0.0)
    # nearly parallel (under 3e-5 rad) and nearly point-like (under 1 um) segments are treated as such
    assert found.d[0] == pytest.approx(bench.segment_distance(p0, p1, q0, q1) - 0.75, abs=1e-4)
    for column in found:
        assert np.all(np.isfinite(column))


def test_velocity_and_acceleration_of_the_true_nearest_distance(bench: Any) -> None:
    system = bench.system()
    checked = 0
    for q, dq, ddq, people in motions(60):
        d, v, a, smooth = smooth_jet(bench, system, q, dq, ddq, people)
        found = separation(system.model.chain, system.model.capsules, people, q, dq, np.inf, 0.0)
        ours_v = grid(found, found.d_dot, d.shape)
        ours_a = grid(found, found.C @ ddq + found.drift, d.shape)
        apart = smooth & (d > -0.05)
        np.testing.assert_allclose(ours_v[apart], v[apart], atol=1e-4)
        np.testing.assert_allclose(ours_a[apart], a[apart], rtol=1e-2, atol=1e-2)
        checked += apart.sum()
    assert checked > 1000


def test_without_the_witness_slip_the_acceleration_would_be_over_estimated(bench: Any) -> None:
    """Distance of the two material points that are nearest now: never falls behind the true one, often far ahead."""
    system = bench.system()
    excess = []
    for q, dq, ddq, people in motions(20, seed=5):
        d, _, _, smooth = smooth_jet(bench, system, q, dq, ddq, people)
        found = separation(system.model.chain, system.model.capsules, people, q, dq, np.inf, 0.0)
        ours = grid(found, found.C @ ddq + found.drift, d.shape)
        for i, h in np.argwhere(smooth & (d > -0.05)):
            fixed = material_point_acceleration(bench, system, q, dq, ddq, people, i, h)
            excess.append(fixed - ours[i, h])
    assert min(excess) > -0.05
    assert np.quantile(excess, 0.9) > 1.0


def material_point_acceleration(
    bench: Any, system: Any, q: Any, dq: Any, ddq: Any, people: People, i: int, h: int
) -> float:
    def ends(t: float) -> Any:
        _, p0, p1, _ = bench.robot_capsules(system, q + t * dq + t * t / 2.0 * ddq)[i]
        moved = shifted(people, t)
        return p0, p1, moved.p0[h], moved.p1[h]

    p0, p1, q0, q1 = ends(0.0)
    s = t = width = 0.5
    while width > 1e-6:  # search on ever finer grids
        across = np.linspace(-width, width, 21)
        a, b = np.clip(s + across, 0.0, 1.0), np.clip(t + across, 0.0, 1.0)
        gaps = np.linalg.norm((p0 + a[:, None] * (p1 - p0))[:, None] - (q0 + b[:, None] * (q1 - q0)), axis=2)
        i_best, j_best = np.unravel_index(gaps.argmin(), gaps.shape)
        s, t, width = a[i_best], b[j_best], width / 4.0

    def gap(time: float) -> float:
        a, b, c, e = ends(time)
        return float(np.linalg.norm(a + s * (b - a) - c - t * (e - c)))

    return (gap(H) - 2.0 * gap(0.0) + gap(-H)) / (H * H)


def test_the_robots_own_part_is_the_motion_among_people_who_stand_still(bench: Any) -> None:
    system = bench.system()
    for q, dq, ddq, people in motions(20, seed=9):
        still = people._replace(v0=0.0 * people.v0, v1=0.0 * people.v1)
        d, v, a, smooth = smooth_jet(bench, system, q, dq, ddq, still)
        found = separation(system.model.chain, system.model.capsules, people, q, dq, np.inf, 7.0)
        apart = smooth & (d > -0.05)
        np.testing.assert_allclose(grid(found, found.d_dot_robot, d.shape)[apart], v[apart], atol=1e-4)
        ours = grid(found, found.C @ ddq + found.drift_robot, d.shape)
        np.testing.assert_allclose(ours[apart], a[apart], rtol=1e-2, atol=1e-2)


def test_bounds_count_against_the_robot(bench: Any) -> None:
    system = bench.system()
    q, dq, _, people = next(motions(1))
    args = (system.model.chain, system.model.capsules)
    exact = separation(*args, people, q, dq, np.inf, 0.0)
    bounded = separation(*args, people._replace(velocity_bound=np.full(4, 0.3)), q, dq, np.inf, 2.0)
    np.testing.assert_allclose(bounded.d_dot, exact.d_dot - 0.3)
    np.testing.assert_allclose(bounded.drift, exact.drift - 2.0)


def test_reach_and_base_links(bench: Any) -> None:
    system = bench.system()
    q, dq, _, people = next(motions(1, seed=2))
    args = (system.model.chain, system.model.capsules, people, q, dq)
    everything, near = separation(*args, np.inf, 0.0), separation(*args, 0.4, 0.0)
    assert set(everything.robot) == {i for i, joint in enumerate(system.model.capsules.joint) if joint >= 0}
    assert 0 < len(near.d) < len(everything.d)
    np.testing.assert_array_equal(near.d, everything.d[everything.d < 0.4])


@pytest.mark.parametrize("broken", ["p0", "p1", "radius"])
def test_a_person_at_no_number_is_near_never_out_of_reach(bench: Any, broken: str) -> None:
    system = bench.system()
    q, dq, _, people = next(motions(1))
    nowhere = people._replace(**{broken: np.full_like(getattr(people, broken), np.nan)})
    found = separation(system.model.chain, system.model.capsules, nowhere, q, dq, 1.0, 0.0)
    assert len(found.d) == 8 * 4
    assert np.all(np.isnan(found.d))


def test_touching_crossing_and_degenerate_capsules_stay_finite(bench: Any) -> None:
    system = bench.system()
    q = bench.HOME
    for _, p0, p1, _ in bench.robot_capsules(system, q)[1:]:
        for q0, q1 in ((p0, p1), (p1, p0), (p0, p0), (0.5 * (p0 + p1),) * 2, (p0 - [0, 0, 1], p0 + [0, 0, 1])):
            for v in (0.0, 1.0):
                moving = np.full((1, 3), v)
                people = People(q0[None], q1[None], moving, -moving, np.array([0.05]), np.array([0.1]))
                args = (system.model.chain, system.model.capsules, people, q, np.full(6, 0.5))
                found = separation(*args, np.inf, 3.0)
                M, M_dot = radii(system.model.arm, *args[2:], np.full(6, 0.5), 3.0, found)
                for column in (*found, M, M_dot):
                    assert np.all(np.isfinite(column))


def test_M_is_the_linear_program_over_the_acceleration_box(bench: Any) -> None:
    system = bench.system()
    for q, dq, ddq, people in motions(15, seed=4):
        found = separation(system.model.chain, system.model.capsules, people, q, dq, np.inf, 3.0)
        M, _ = radii(system.model.arm, people, q, dq, ddq, 3.0, found)
        lower, upper = acceleration_box(system.bounds, q, dq)
        for C, drift, value in zip(found.C, found.drift, M, strict=True):
            best = linprog(-C, bounds=list(zip(lower, upper, strict=True)))
            assert best.status == 0
            assert value == pytest.approx(drift - best.fun, abs=1e-6)
            assert drift + greatest(
                C, Polytope(lower, upper, np.zeros((0, 6)), np.zeros(0), np.zeros(0))
            ) == pytest.approx(value, abs=1e-9)


def M_along(system: Any, q: Any, dq: Any, ddq: Any, people: People, found: Separation, t: float) -> Any:
    moved = shifted(people, t)
    there = separation(system.model.chain, system.model.capsules, moved, q + t * dq, dq + t * ddq, np.inf, 3.0)
    np.testing.assert_array_equal(there.robot, found.robot)
    lower, upper = acceleration_box(system.bounds, q + t * dq, dq + t * ddq)
    return there.drift + np.maximum(there.C * lower, there.C * upper).sum(axis=1)


def test_M_dot_follows_M_and_takes_the_worse_side_of_a_kink(bench: Any) -> None:
    system = bench.system()
    smooth = kinks = 0
    step = 1e-4
    for q, dq, ddq, people in motions(80, seed=6):
        found = separation(system.model.chain, system.model.capsules, people, q, dq, np.inf, 3.0)
        _, M_dot = radii(system.model.arm, people, q, dq, ddq, 3.0, found)
        behind, now, ahead = (M_along(system, q, dq, ddq, people, found, t) for t in (-step, 0.0, step))
        left, right = (now - behind) / step, (ahead - now) / step
        curved = np.abs(right - left) > 2.0 + 0.02 * (np.abs(left) + np.abs(right))
        fine = ~curved & (np.abs(left) < 1e3)
        centre = 0.5 * (left + right)
        np.testing.assert_allclose(M_dot[fine], centre[fine], rtol=0.03, atol=2.0)
        smooth, kinks = smooth + fine.sum(), kinks + curved.sum()
    assert smooth > 1500
    assert kinks > 0


def test_M_dot_at_a_kink_is_the_falling_side(bench: Any) -> None:
    """A joint that enters its braking zone right now: M hardly changed before, and falls from here on."""
    system = bench.system()
    A = system.bounds.ddq_max[0]
    q, dq = np.array([0.0, 0.4, 0.2, 0.0, -1.2, 0.0]), np.zeros(6)
    dq[0] = 1.0
    ratio = A / system.bounds.dddq_max[0]
    # upper_0 = A as long as sqrt(2 A room) - dq >= A^2 / J: put the arm exactly there
    q[0] = system.bounds.q_max[0] - (dq[0] + A * ratio) ** 2 / (2.0 * A)
    tool = bench.robot_capsules(system, q)[-2][1]
    person = tool + 0.4 * np.array([np.sin(q[0]), -np.cos(q[0]), 0.0])  # behind: fleeing means joint 0 up
    still = np.zeros((1, 3))
    people = People(person[None], person[None], still, still, np.array([0.05]), np.zeros(1))
    args = (system.model.chain, system.model.capsules, people, q, dq)
    found = separation(*args, np.inf, 3.0)
    _, M_dot = radii(system.model.arm, *args[2:], np.zeros(6), 3.0, found)
    i = int(np.argmax(found.robot == 7))
    step = 1e-4
    behind, now, ahead = (M_along(system, q, dq, np.zeros(6), people, found, t)[i] for t in (-step, 0.0, step))
    left, right = (now - behind) / step, (ahead - now) / step
    assert right < left - 5.0  # it is a kink
    assert M_dot[i] == pytest.approx(right, rel=0.05, abs=0.2)


def test_people_may_be_nobody(bench: Any) -> None:
    system = bench.system()
    none = np.zeros((0, 3))
    nobody = People(none, none, none, none, np.zeros(0), np.zeros(0))
    args = (system.model.chain, system.model.capsules, nobody, bench.HOME, np.zeros(6))
    found = separation(*args, np.inf, 3.0)
    assert len(found.d) == 0
    assert [len(v) for v in radii(system.model.arm, *args[2:], np.zeros(6), 3.0, found)] == [0, 0]


def test_inputs_are_left_alone(bench: Any) -> None:
    system = bench.system()
    q, dq, ddq, people = next(motions(1))
    copies = [np.copy(x) for x in (q, dq, *people)]
    found = separation(system.model.chain, system.model.capsules, people, q, dq, np.inf, 3.0)
    radii(system.model.arm, people, q, dq, ddq, 3.0, found)
    for before, after in zip(copies, (q, dq, *people), strict=True):
        np.testing.assert_array_equal(before, after)


def test_the_least_distance_is_the_least_of_all_pairs(bench: Any) -> None:
    system = bench.system()
    for q, dq, _, people in motions(20, seed=12):
        args = (system.model.chain, system.model.capsules, people, q)
        assert least_distance(*args) == separation(*args, dq, np.inf, 0.0).d.min()  # to the bit
    nowhere = people._replace(p0=np.full_like(people.p0, np.nan))
    assert np.isnan(least_distance(*args[:2], nowhere, q))
    none = np.zeros((0, 3))
    assert least_distance(*args[:2], People(none, none, none, none, np.zeros(0), np.zeros(0)), q) == np.inf


def test_the_closed_form_without_rows_is_the_program(bench: Any) -> None:
    rng = np.random.default_rng(3)
    for _ in range(200):
        lower, width, c = rng.normal(size=6), rng.uniform(0.0, 3.0, 6), rng.normal(size=6)
        U = Polytope(lower, lower + width, np.zeros((0, 6)), np.zeros(0), np.zeros(0))
        assert greatest(c, U) == support(c, U).value  # to the bit
    assert greatest(c, U._replace(upper=lower - 1.0)) == -np.inf
