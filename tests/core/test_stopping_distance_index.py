"""phi_b, the stopping-distance index: its value, its rate, persistence on the abstract system."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asc_rt.core.safety_index import (
    BRAKE_SHARE,
    JERK_SHARE,
    PHI_B,
    Index,
    greatest_approach,
    phi,
    phi_rate,
    psi,
)
from asc_rt.core.system import System
from asc_rt.core.types import Mode, Status

T, D_MIN = 0.008, 0.1


def index(brake: float) -> Index:
    return Index(PHI_B, D_MIN, 1e9, brake, 1.0, 0.3, 2.0)  # k plays no part: one that would stop everything


def numbers(low: float, high: float) -> Any:
    return st.floats(low, high, allow_nan=False)


def test_its_value_is_the_distance_that_a_stop_leaves() -> None:
    assert phi(0.6, 1.0, 5.0, index(2.0)) == pytest.approx(0.1 - 0.6 + 1.0 / 4.0)
    assert phi(0.6, -1.0, 5.0, index(2.0)) == pytest.approx(-0.5)  # retreating is never slowed
    assert phi(0.05, 0.0, 5.0, index(2.0)) == pytest.approx(0.05)


@settings(max_examples=200, deadline=None)
@given(d=numbers(0.05, 1.0), v=numbers(-1.0, 1.5), a=numbers(-6.0, 6.0), brake=numbers(0.5, 8.0))
def test_its_rate_is_its_derivative(d: float, v: float, a: float, brake: float) -> None:
    h = 1e-6
    ahead, behind = (phi(d - v * t - a * t * t / 2.0, v + a * t, 5.0, index(brake)) for t in (h, -h))
    assert phi_rate(d, -v, -a, 5.0, -99.0, index(brake)) == pytest.approx((ahead - behind) / (2.0 * h), abs=1e-4)


@settings(max_examples=200, deadline=None)
@given(d=numbers(0.1, 1.2), v=numbers(0.0, 1.5), a=numbers(-0.5, 6.0), J=numbers(8.0, 200.0), brake=numbers(0.5, 6.0))
def test_psi_is_its_largest_value_on_the_stop_and_needs_no_rate_of_M(
    d: float, v: float, a: float, J: float, brake: float
) -> None:
    M = brake / BRAKE_SHARE  # what certifies it, exactly
    t = np.linspace(0.0, (a + brake) / J + (v + 0.5 * a * a / J + a) / brake + 0.5, 20_000)
    acceleration = np.maximum(a - J * t, -brake)
    dt = t[1] - t[0]
    speed = v + np.concatenate(([0.0], np.cumsum(0.5 * (acceleration[1:] + acceleration[:-1]) * dt)))
    way = np.concatenate(([0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * dt)))
    over = len(t) if np.all(speed >= 0.0) else int(np.argmax(speed < 0.0))
    along = D_MIN - (d - way[:over]) + speed[:over] ** 2 / (2.0 * brake)
    found = psi(d, v, a, M, 0.0, J, index(brake))
    assert found == pytest.approx(float(along.max(initial=phi(d, v, M, index(brake)))), abs=2e-3)
    assert psi(d, v, a, M, -50.0, J, index(brake)) == found


@pytest.mark.parametrize("J", [10.0, 30.0, 100.0])
@pytest.mark.parametrize("brake", [0.8, 3.0, 8.0])
def test_it_is_persistently_feasible_with_M_that_changes_at_will(brake: float, J: float) -> None:
    """M jumps between its certified least value and ten times as much: d stays over d_min, the arm can always obey."""
    rng = np.random.default_rng(3)
    least = brake / BRAKE_SHARE
    counted = JERK_SHARE * J
    d, v, a = 0.9, 0.0, 0.0
    for _ in range(1200):
        M = least * rng.uniform(1.0, 10.0)
        assert psi(d, v, a, M, 0.0, counted, index(brake)) <= 1e-6
        allowed = greatest_approach(d, v, a, T, M, -100.0, counted, index(brake), M + 200.0)
        assert allowed >= max(a - J * T, -least)
        wanted = min(a + J * T, 8.0) if v + a * abs(a) / (2.0 * J) < 1.5 else max(a - J * T, -least)
        u = min(wanted, allowed)
        d -= T * v + T * T * (2.0 * a + u) / 6.0
        v, a = v + T * (a + u) / 2.0, u
        assert d >= D_MIN - 1e-6
    assert d < 0.5  # it did come near


def test_the_arm_keeps_its_distance_with_it(bench: Any) -> None:
    """The LR Mate works between two goals; a post stands in the way."""
    params = bench.params()
    system = System(replace(params, safety=replace(params.safety, index="phi-b", brake=1.0, k=1e9)))
    person = bench.human([0.55, 0.0, 0.0], [0.55, 0.0, 1.2], 0.13)
    cycles = bench.Rig(system, lambda t: person, bench.GOALS[0]).run(4.0, bench.GOALS[[0, 2]])
    least = min(bench.true_distance(system, c.q_true, person) for c in cycles[::4])
    assert params.safety.d_min - 1e-4 <= least < params.safety.d_min + 0.1
    assert any(c.out.decision.status is Status.FILTERED for c in cycles)
    assert all(c.state.mode is not Mode.FAULT for c in cycles)
