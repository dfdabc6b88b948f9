"""psi to the accuracy of its search, and at its edges: where the approach begins later, and with little M."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from asc_rt.core.safety_index import BRAKE_SHARE, PHI_B, PHI_STAR, Index, _psi_after, greatest_approach, phi, psi

T, D_MIN, M_FLOOR = 0.008, 0.1, 0.3
STAR = Index(PHI_STAR, D_MIN, 3.0, 1.0, 1.0, M_FLOOR, 2.0)
BY_DISTANCE = STAR._replace(kind=PHI_B, brake=2.0)


def largest(d: float, v: float, a: float, M: float, J: float, index: Index) -> float:
    """Largest phi on the hardest brake, M as it is: on a grid of its closed form, and a finer one about the best."""
    B = max(BRAKE_SHARE * M, -a)
    ramp, early = (a + B) / J, 0.0
    late = ramp + (abs(v) + a * a / J) / B + 0.1
    best = -np.inf
    for _ in range(2):
        t = np.linspace(early, late, 4001)
        turned, after = np.minimum(t, ramp), np.maximum(t - ramp, 0.0)
        v_turned = v + a * turned - J * turned**2 / 2.0
        speed = v_turned - B * after
        way = v * turned + a * turned**2 / 2.0 - J * turned**3 / 6.0 + v_turned * after - B * after**2 / 2.0
        left = d - way
        on_the_way = (speed >= 0.0) & (np.maximum.accumulate(speed) >= speed)
        along = np.maximum(D_MIN - left, D_MIN**2 - np.maximum(left, 0.0) ** 2 + index.k * speed / M)
        along = np.where(on_the_way, along, -np.inf)
        best = max(best, float(along.max()))
        top, width = t[int(along.argmax())], t[1] - t[0]
        early, late = max(0.0, top - width), top + width
    return max(best, phi(d, v, M, index))


def states(count: int, seed: int) -> Any:
    rng = np.random.default_rng(seed)
    for _ in range(count):
        yield rng.uniform([0.0, 0.0, -6.0, 0.4, 8.0, 0.3], [1.2, 2.0, 6.0, 3.0, 200.0, 8.0])
        yield rng.uniform([0.3, 0.0, 0.0, 1.0, 4.0, 0.3], [1.5, 2.0, 8.0, 12.0, 30.0, 8.0])  # a long ramp


def test_the_search_finds_the_largest_phi() -> None:
    """A hundred times nearer than it promises; the peak is on the ramp, after it or at its corner."""
    inner = 0
    for d, v, a, M, J, k in states(500, 0):
        index = STAR._replace(k=k)
        found, expected = psi(d, v, a, M, 0.0, J, index), largest(d, v, a, M, J, index)
        assert found == pytest.approx(expected, abs=1e-7)
        inner += found > phi(d, v, M, index) + 1e-3
    assert inner > 100


def test_an_approach_that_begins_later_counts_from_its_beginning_on() -> None:
    """A retreat that the acceleration turns round, however little is left of it then."""
    turned = 0
    for share in np.linspace(0.05, 1.3, 26):
        for a in (0.3, 0.9, 4.0):
            J, M, d = 8.0, 2.0, 0.4
            v = -share * a * a / (2.0 * J)
            expected = phi(d, v, M, STAR)
            if share < 1.0:
                t = float(np.roots([-J / 2.0, a, v]).real.min())  # the first moment without speed
                way = v * t + a * t**2 / 2.0 - J * t**3 / 6.0
                expected = max(expected, largest(d - way, 0.0, a - J * t, M, J, STAR))
                turned += expected > phi(d, v, M, STAR) + 1e-4
            assert psi(d, v, a, M, 0.0, J, STAR) == pytest.approx(expected, abs=1e-5)
    assert turned > 40


def test_the_index_by_stopping_distance_counts_on_the_weaker_of_its_brake_and_M() -> None:
    enough, J = BY_DISTANCE.brake / BRAKE_SHARE, 50.0
    for d, v, a in ((0.8, 0.5, 1.0), (0.8, 1.2, -1.0), (0.3, 0.2, 3.0)):
        by_brake = psi(d, v, a, enough, 0.0, J, BY_DISTANCE)
        assert psi(d, v, a, 3.0 * enough, 0.0, J, BY_DISTANCE) == by_brake
        weak = psi(d, v, a, 0.5 * enough, 0.0, J, BY_DISTANCE)
        assert weak == psi(d, v, a, 9.0, 0.0, J, BY_DISTANCE._replace(brake=0.5 * BY_DISTANCE.brake)) > by_brake + 1e-3


@pytest.mark.parametrize("at_once", [False, True])
def test_a_period_on_M_has_fallen_where_the_index_needs_it(at_once: bool) -> None:
    d, v, a, u, J = 0.5, 0.6, 1.0, 2.0, 30.0
    begin = u if at_once else a
    there = d - T * v - T * T * (2.0 * begin + u) / 6.0, v + T * (begin + u) / 2.0, u
    for M, M_dot, index, fallen in ((3.0, -40.0, STAR, 2.68), (3.0, 40.0, STAR, 3.0), (1.5, -40.0, BY_DISTANCE, 1.5)):
        after = _psi_after(u, d, v, a, T, M, M_dot, J, index._replace(at_once=at_once))
        assert after == psi(*there, fallen, M_dot, J, index)


def test_a_row_that_the_greatest_control_keeps_by_any_amount_has_no_bound() -> None:
    """And one that it breaks by any amount has: at the edge of what is found."""
    d, v, a, M, J = 0.5, 0.5, 0.0, 3.0, 30.0
    edge = greatest_approach(d, v, a, T, M, 0.0, J, STAR, 100.0)
    assert -10.0 < edge < 90.0
    assert greatest_approach(d, v, a, T, M, 0.0, J, STAR, edge - 1e-3) == np.inf
    assert greatest_approach(d, v, a, T, M, 0.0, J, STAR, edge + 1e-3) == pytest.approx(edge, abs=1e-5)
    unsafe = 0.2  # psi > 0 already: it has to fall
    edge = greatest_approach(unsafe, v, a, T, M, 0.0, J, STAR, 100.0)
    assert psi(unsafe, v, a, M, 0.0, J, STAR) > 0.0
    assert greatest_approach(unsafe, v, a, T, M, 0.0, J, STAR, edge - 1e-3) == np.inf
    assert greatest_approach(unsafe, v, a, T, M, 0.0, J, STAR, edge + 1e-3) == pytest.approx(edge, abs=1e-5)
