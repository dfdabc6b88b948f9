"""The exact linear program of a cycle against scipy's, and its multipliers against duality and differences."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from asc_rt.core.polytope import Polytope, greatest, support


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


def test_the_multipliers_tell_how_the_value_moves_with_every_bound_and_row() -> None:
    rng = np.random.default_rng(5)
    step, active = 1e-6, 0
    for _ in range(40):
        U, c = polytope(rng, 5, 5), rng.normal(size=5)
        value, u, y = support(c, U)
        change = Polytope(*(rng.normal(size=part.shape) for part in U))
        moved = Polytope(*(part + step * d for part, d in zip(U, change, strict=True)))
        ends_box = np.where(y[:5] > 0, change.upper, change.lower)
        ends_rows = np.where(y[5:] > 0, change.high, change.low)
        expected = y[:5] @ ends_box + y[5:] @ (ends_rows - change.G @ u)
        assert (greatest(c, moved) - value) / step == pytest.approx(expected, rel=1e-3, abs=1e-3)
        active += np.count_nonzero(y[5:])
    assert active > 20


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
