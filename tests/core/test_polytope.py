"""The exact linear program of a cycle against scipy's, and its multipliers against duality and differences."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from asc_rt.core.polytope import Polytope, _worst_row, greatest, moved, support


def polytope(rng: Any, n: int, m: int) -> Polytope:
    """A box and m rows that hold in a random point of it, so that it is not empty."""
    lower, upper = -rng.uniform(0.1, 20.0, n), rng.uniform(0.1, 20.0, n)
    G = rng.normal(size=(m, n)) * rng.uniform(0.1, 10.0, (m, 1))
    inside = G @ rng.uniform(lower, upper)
    width = rng.uniform(0.1, 30.0, (2, m))
    return Polytope(lower, upper, G, inside - width[0], inside + width[1])


def by_scipy(c: Any, U: Polytope) -> Any:
    rows = np.vstack((U.G, -U.G)) if len(U.low) else None
    ends = np.concatenate((U.high, -U.low)) if len(U.low) else None
    return linprog(-c, A_ub=rows, b_ub=ends, bounds=list(zip(U.lower, U.upper, strict=True)))


@example(4643, 6, 4)  # ran in circles where c has zeros
@settings(max_examples=150, deadline=None)
@given(st.integers(0, 2**32), st.integers(1, 8), st.integers(0, 9))
def test_greatest_is_the_linear_program(seed: int, n: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    U, c = polytope(rng, n, m), rng.normal(size=n) * rng.integers(0, 2, n)
    oracle = by_scipy(c, U)
    assert oracle.status == 0
    assert greatest(c, U) == pytest.approx(-oracle.fun, abs=1e-6)


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 2**32), st.integers(2, 7), st.integers(0, 7))
def test_the_vertex_is_inside_and_the_multipliers_prove_it_the_best(seed: int, n: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    U, c = polytope(rng, n, m), rng.normal(size=n)
    value, u, y = support(c, U)
    assert np.all(u >= U.lower - 1e-7)
    assert np.all(u <= U.upper + 1e-7)
    assert np.all(U.G @ u >= U.low - 1e-6)
    assert np.all(U.G @ u <= U.high + 1e-6)
    np.testing.assert_allclose(y[:n] + U.G.T @ y[n:], c, atol=1e-8)
    low, high = np.concatenate((U.lower, U.low)), np.concatenate((U.upper, U.high))
    assert value == pytest.approx(c @ u)
    assert value == pytest.approx(np.where(y > 0, y * high, y * low).sum(), rel=1e-7, abs=1e-6)  # strong duality


def test_the_multipliers_tell_how_the_value_moves_with_the_direction_and_every_bound_and_row() -> None:
    rng = np.random.default_rng(5)
    step, active = 1e-6, np.zeros(2, int)
    for _ in range(40):
        U, c = polytope(rng, 5, 5), rng.normal(size=5)
        best = support(c, U)
        there = Polytope(*(part + step * rng.normal(size=part.shape) for part in U))
        c_there = c + step * rng.normal(size=5)
        expected = (greatest(c_there, there) - best.value) / step
        assert moved(best, c, U, c_there, there) / step == pytest.approx(expected, rel=1e-3, abs=1e-3)
        active += [np.count_nonzero(best.y[5:] > 0.0), np.count_nonzero(best.y[5:] < 0.0)]
    assert np.all(active > 10)


def test_a_multiplier_of_one_counts_like_any_other() -> None:
    """To the bit: the row is the direction itself."""
    c, one = np.array([1.0, 0.0]), np.ones(1)
    U = Polytope(np.full(2, -9.0), np.full(2, 9.0), c[None], -2.0 * one, 2.0 * one)
    best = support(c, U)
    assert best.value == 2.0 and best.y.tolist() == [0.0, 0.0, 1.0]
    assert moved(best, c, U, c, U._replace(high=2.5 * one)) == 0.5


@settings(max_examples=150, deadline=None)
@given(st.integers(0, 2**32), st.integers(1, 6), st.integers(0, 6))
def test_the_worst_row_is_the_one_that_is_violated_most_for_the_size_of_its_bounds(seed: int, n: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    U = polytope(rng, n, m)
    size = 10.0 ** rng.uniform(-2.0, 2.0)
    u = rng.uniform(U.lower - size, U.upper + size)
    for point in (u, np.clip(u, U.lower, U.upper)):  # of the box and the rows; of the rows alone
        reached = np.concatenate((point, U.G @ point))
        low, high = np.concatenate((U.lower, U.low)), np.concatenate((U.upper, U.high))
        over = np.maximum(reached - high, low - reached) / (1.0 + np.abs(low) + np.abs(high))
        r, to_upper = _worst_row(point, U)
        worst = int(np.argmax(over))
        assert r == (worst if over[worst] > 0.0 else -1)
        assert r < 0 or to_upper == (reached[r] > high[r])


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_row_is_violated_from_its_tolerance_on(side: float) -> None:
    """A billionth of 1 + |low| + |high|, which is 8 here."""
    U = Polytope(np.array([-3.0]), np.array([4.0]), np.zeros((0, 1)), np.zeros(0), np.zeros(0))
    end = U.upper if side > 0.0 else U.lower
    assert _worst_row(end + side * 7.9e-9, U)[0] == -1
    assert _worst_row(end + side * 8.1e-9, U) == (0, side > 0.0)


@pytest.mark.parametrize("m", [0, 2])
def test_one_joint_without_any_choice_left_makes_the_set_empty(m: int) -> None:
    U = polytope(np.random.default_rng(1), 4, m)
    for j in range(4):
        upper = np.where(np.arange(4) == j, U.lower - 0.1, U.upper)
        assert greatest(np.ones(4), U._replace(upper=upper)) == -np.inf


def test_an_empty_set_has_no_greatest() -> None:
    one = np.ones(1)
    U = Polytope(-one, one, np.ones((1, 1)), 2.0 * one, 3.0 * one)
    assert greatest(one, U) == -np.inf
    assert greatest(-one, U) == -np.inf


def test_degenerate_rows_do_not_cycle() -> None:
    """Parallel and duplicate rows through one vertex."""
    n = 4
    G = np.vstack((np.ones((3, n)), -np.ones((1, n)), np.eye(n)))
    U = Polytope(-np.ones(n), np.ones(n), G, np.full(8, -2.0), np.concatenate((np.full(4, 2.0), np.ones(n))))
    for c in (np.ones(n), -np.ones(n), np.array([1.0, 1.0, 0.0, 0.0]), np.zeros(n)):
        assert greatest(c, U) == pytest.approx(-by_scipy(c, U).fun, abs=1e-7)


def test_costs_with_zeros_never_run_in_circles() -> None:
    """A direction that needs one joint, or none: all other multipliers are 0."""
    for seed in range(4000):
        rng = np.random.default_rng(seed)
        U = polytope(rng, 6, 6)
        assert np.isfinite(greatest(rng.normal(size=6) * (rng.random(6) < 0.2), U))
