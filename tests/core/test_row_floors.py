"""The row of one pair in numbers, away from any arm: what the control can do to it, and which of the floors it gets."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pytest

from asc_rt.core.abstraction import Separation
from asc_rt.core.safety_index import (
    NO_ROW,
    PHI_B,
    PHI_STAR,
    STANDSTILL_LEAST,
    STANDSTILL_SPEED,
    Effect,
    Index,
    _base,
    _effect,
    free_pairs,
    phi,
    phi_rate,
    phi_star,
    psi,
    row_floors,
)
from asc_rt.core.types import Basis, Outside

T, BRAKE_TIME, D_MIN, FLOOR, V_MAX = 0.008, 0.25, 0.1, 0.3, 2.0
STAR = Index(PHI_STAR, D_MIN, 3.0, 1.0, 1.0, FLOOR, V_MAX)
C, DDQ, DDDQ_MAX = np.array([0.5, -0.2]), np.array([1.0, 2.0]), np.array([40.0, 100.0])
LOWER, UPPER = np.array([-3.0, -4.0]), np.array([2.0, 5.0])
ALONG, LEAST, MOST, JERK = 0.1, -2.5, 1.8, 0.6 * 40.0
BRAKE = np.array([-2.0, 3.0])  # C of it: -1.6


class Row(NamedTuple):
    phi: float
    floor: float
    base: float
    basis: Basis
    outside: int  # of Outside


class Pair(NamedTuple):
    d: float = 0.6
    v: float = 0.5  # approach, of both
    v_robot: float = 0.3
    drift: float = -0.4
    drift_robot: float = 0.2
    M: float = 4.0
    M_dot: float = -5.0

    def alone(self, C: Any = C) -> Separation:
        one, which = np.ones(1), np.zeros(1, np.int64)
        mine = (-self.v, self.drift, -self.v_robot, self.drift_robot)
        d_dot, drift, d_dot_robot, drift_robot = (x * one for x in mine)
        return Separation(which, which, self.d * one, d_dot, C[None], drift, d_dot_robot, drift_robot)

    def row(self, C: Any = C, index: Index = STAR, free: bool = False, ddq: Any = DDQ) -> Row:
        M, M_dot, left_out = np.array([self.M]), np.array([self.M_dot]), np.array([free])
        bounds = DDDQ_MAX, LOWER, UPPER, BRAKE, T
        found = row_floors(self.alone(C), left_out, M, M_dot, ddq, *bounds, index, BRAKE_TIME)
        value, floor, base, basis, outside = (column[0] for column in found)
        return Row(value, floor, base, Basis(int(basis)), int(outside))

    def is_free(self, C: Any = C, index: Index = STAR) -> bool:
        return bool(free_pairs(self.alone(C), DDQ, DDDQ_MAX, LOWER, UPPER, T, index, BRAKE_TIME)[0])


def test_what_the_control_can_do_to_a_pair() -> None:
    np.testing.assert_allclose(_effect(C, DDQ, DDDQ_MAX, LOWER, UPPER), (ALONG, LEAST, MOST, JERK))


def test_what_is_left_of_a_floor_where_rows_conflict() -> None:
    e = Effect(0.1, -2.5, 1.8, 24.0)
    for basis, floor, base in (
        (Basis.INDEX, 1.0, 1.0),
        (Basis.STANDSTILL, 1.0, 0.55),  # half of what it asks beyond 0.1
        (Basis.STANDSTILL, -1.0, -1.0),
        (Basis.RAMP, 1.0, 0.1 - 0.26),  # a tenth of what a period can take
        (Basis.RAMP, -1.0, -1.0),
    ):
        assert _base(int(basis), floor, e) == pytest.approx(base)
    assert _base(int(Basis.RAMP), 1.0, e._replace(least=0.1)) == pytest.approx(0.1 - 1e-3)


def test_the_end_of_a_ramp_is_no_more_than_the_bounds_or_M_give() -> None:
    late, at_once = Pair(d=0.15, v=1.9, v_robot=1.9, M=9.0), STAR._replace(eta=100.0)  # nearly all, and this period
    within = ALONG + 0.6 * (MOST - ALONG) - 1e-3
    assert late.row(index=at_once)[1:] == (
        pytest.approx(within),
        pytest.approx(ALONG - 0.26),
        Basis.RAMP,
        Outside.NOTHING,
    )
    assert late._replace(M=0.5).row(index=at_once).floor == pytest.approx(0.8 * 0.5 + 0.4)  # BRAKE_SHARE M - drift
    beyond = np.array([5.0, 0.0])  # no control of this period gives as much as the last one gave
    assert late.row(index=at_once, ddq=beyond).floor == pytest.approx(MOST - 1e-3)


@pytest.mark.parametrize(
    ("d", "creep"), [(0.3, STANDSTILL_SPEED), (0.102, 0.001), (0.1, STANDSTILL_LEAST), (0.05, STANDSTILL_LEAST)]
)
@pytest.mark.parametrize("at_once", [False, True])
def test_at_a_standstill_the_robots_own_approach_is_over_when_its_ramp_is(
    d: float, creep: float, at_once: bool
) -> None:
    """A person faster than the arm: the robot keeps no more than a creep, of its own."""
    pair = Pair(d=d, v=1.9, v_robot=0.01)
    found = pair.row(index=STAR._replace(at_once=at_once))
    assert found.basis == Basis.STANDSTILL
    u, a = -(found.floor + pair.drift_robot), -(ALONG + pair.drift_robot)
    begin = u if at_once else a
    left = pair.v_robot + T * (begin + u) / 2.0 + u * abs(u) / (2.0 * JERK)
    assert left == pytest.approx(creep, abs=1e-7)
    assert found.base == pytest.approx(min(found.floor, ALONG + 0.5 * (found.floor - ALONG)))


def after(pair: Pair, u: float, index: Index) -> float:
    """psi a period on, with the approach acceleration gone to u."""
    a = -(ALONG + pair.drift)
    d = pair.d - T * pair.v - T * T * (2.0 * a + u) / 6.0
    return psi(d, pair.v + T * (a + u) / 2.0, u, pair.M + T * min(0.0, pair.M_dot), pair.M_dot, JERK, index)


def test_the_index_asks_for_what_keeps_it_and_no_more() -> None:
    seen = 0
    for d in np.linspace(0.3, 2.2, 96):
        pair = Pair(d=d, v=0.3, v_robot=0.8, M=2.0)
        found = pair.row()
        if found.basis != Basis.INDEX:
            continue
        assert found.floor == found.base
        now = psi(pair.d, pair.v, -(ALONG + pair.drift), pair.M, pair.M_dot, JERK, STAR)
        target = max(0.0, now * (1.0 - T))
        if found.floor == NO_ROW:
            assert after(pair, -(LEAST + pair.drift), STAR) <= target  # the hardest approach there is keeps it
        else:
            assert target - 1e-3 < after(pair, -(found.floor + pair.drift), STAR) <= target + 1e-9
            seen += 1
    assert seen > 10


def test_a_retreat_and_a_pair_far_away_have_no_row() -> None:
    assert Pair(d=0.9, v=-0.5, v_robot=-0.5).row()[1:4] == (NO_ROW, NO_ROW, Basis.INDEX)
    left_out = Pair(d=0.05, v=2.5).row(free=True)
    assert left_out[1:] == (NO_ROW, NO_ROW, Basis.FREE, Outside.DISTANCE | Outside.SPEED)


def test_inside_d_min_and_near_a_person_too_fast_no_less_than_a_standstill_is_asked() -> None:
    """Where the index itself has nothing against it: the person gives way as fast as the robot comes."""
    gives_way = Pair(d=0.5, v=-1.5, v_robot=0.01)
    assert gives_way.row().floor == NO_ROW
    assert gives_way._replace(d=0.099).row().basis == Basis.STANDSTILL
    fast, strong = Pair(d=0.55, v=1.9, v_robot=0.01, M=500.0, M_dot=0.0), 10.0 * C
    assert fast.row(strong).basis == Basis.INDEX
    too_fast = STAR._replace(v_max=1.8)
    row = fast.row(strong, too_fast)
    assert (row.basis, row.outside) == (Basis.STANDSTILL, Outside.SPEED)
    assert fast._replace(d=0.6).row(strong, too_fast).basis == Basis.INDEX  # not near any more


def test_a_pair_that_the_control_hardly_reaches_is_asked_for_no_more_than_the_brake_gives() -> None:
    slow = Pair(d=0.15, v=0.6, v_robot=0.6, M=0.3)
    found = slow.row()
    assert (found.basis, found.outside) == (Basis.M_FLOOR, Outside.RADIUS)
    assert found.floor == pytest.approx(-1.6 - 1e-3) and found.base == pytest.approx(-1.6 - 1e-3)
    assert slow._replace(d=0.26).row()[1:4] == (NO_ROW, NO_ROW, Basis.M_FLOOR)  # 0.1 + 0.6 m/s for 0.25 s
    assert slow._replace(d=0.24).row().floor > NO_ROW
    unmoved = slow._replace(M=5.0, drift_robot=0.0).row(C=np.zeros(2))
    assert (unmoved.basis, unmoved.outside, unmoved.floor) == (Basis.M_FLOOR, Outside.RADIUS, pytest.approx(-1e-3))


def test_the_value_is_that_of_an_M_no_smaller_than_its_floor() -> None:
    for M in (4.0, 0.1):
        pair = Pair(M=M)
        assert pair.row().phi == phi(pair.d, pair.v, max(M, FLOOR), STAR)


def test_which_pairs_are_left_out() -> None:
    """Those that keep psi <= 0 with the hardest approach there is, at the least M; not near, fast or out of reach."""
    far = Pair(d=3.0, v=0.3, v_robot=0.2)
    assert far.is_free()
    assert not far.is_free(C=np.zeros(2))
    assert far._replace(v=0.0).is_free()
    assert not far._replace(v=2.1).is_free()
    assert not far._replace(d=20.0, v=2.1).is_free() and far._replace(d=20.0, v=1.9).is_free()
    # Near by the robot's own speed, though the person gives way; by both on the other side.
    gives_way = Pair(d=0.2, v=-1.0, v_robot=0.5)
    assert not gives_way.is_free() and gives_way._replace(d=0.23).is_free()
    for d in np.linspace(0.3, 3.0, 28):
        for drift in (-1.0, 1.0):
            pair = Pair(d=d, drift=drift)
            hardest = -(LEAST + drift)
            least = pair._replace(M=FLOOR, M_dot=0.0)
            assert pair.is_free() == (after(least, hardest, STAR) <= 0.0)


def test_phi_rate_without_M_is_that_of_the_distance_alone() -> None:
    for M in (0.0, -2.0):
        assert phi_rate(0.5, -0.7, 1.0, M, 3.0, STAR) == 0.7
    assert phi_rate(0.5, 0.7, 1.0, 0.5, 3.0, STAR) == -0.7  # phi0 is the larger
    assert phi_rate(0.5, -0.7, 1.0, 0.5, 3.0, STAR) == pytest.approx(0.7 - 3.0 / 0.5 - 3.0 * 0.7 * 3.0 / 0.25)


def test_both_indices_by_hand() -> None:
    assert phi_star(-0.2, 0.5, 4.0, 0.1, 3.0) == pytest.approx(0.01 + 0.04 + 0.375)
    by_distance = STAR._replace(kind=PHI_B, brake=2.0)
    assert phi(0.6, 1.5, 9.0, by_distance) == pytest.approx(0.1 - 0.6 + 1.5**2 / 4.0)
    assert phi(0.6, 0.5, 9.0, by_distance) == pytest.approx(0.1 - 0.6 + 0.25 / 4.0)
    assert phi(0.6, -0.5, 9.0, by_distance) == pytest.approx(-0.5)
    assert phi_rate(0.6, -0.5, 3.0, 9.0, 0.0, by_distance) == pytest.approx(0.5 - 0.5 * 3.0 / 2.0)
    assert phi_rate(0.6, 0.5, 3.0, 9.0, 0.0, by_distance) == -0.5
