"""phi, psi and the rows: against integration by small steps, in closed loop on the abstract system, and on the arm."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from asc_rt.core.abstraction import nearest_first, separation
from asc_rt.core.limits import braking, command_box
from asc_rt.core.people import predict
from asc_rt.core.radius import radii
from asc_rt.core.rows import rows
from asc_rt.core.safety_index import (
    BRAKE_SHARE,
    JERK_SHARE,
    PHI_STAR,
    Index,
    approach_ending,
    greatest_approach,
    phi,
    phi_rate,
    phi_star,
    psi,
    row_floors,
)
from asc_rt.core.system import System, initial
from asc_rt.core.types import Basis, Mode, Outside, vector

T = 0.008
D_MIN, ETA, M_FLOOR, V_MAX = 0.1, 1.0, 0.3, 2.0


def index(k: float) -> Index:
    return Index(PHI_STAR, D_MIN, k, 1.0, ETA, M_FLOOR, V_MAX)


def numbers(low: float, high: float) -> Any:
    return st.floats(low, high, allow_nan=False)


states = st.tuples(numbers(0.0, 1.2), numbers(-1.0, 2.0), numbers(-8.0, 8.0))
systems = st.tuples(numbers(0.5, 12.0), numbers(-20.0, 20.0), numbers(5.0, 300.0), numbers(0.3, 8.0))


def brake_by_steps(d: float, v: float, a: float, M: float, M_dot: float, J: float, k: float) -> float:
    """Largest phi on the hardest brake, by integration; M as of the end of the ramp."""
    dt = 2e-5
    start = max(D_MIN - d, D_MIN**2 - d * abs(d) + k * v / M)
    crossing = v < 0.0 < a and a * a + 2.0 * J * v > 0.0  # it turns round before the ramp is over
    a_ramp = math.sqrt(a * a + 2.0 * J * v) if crossing else a
    M = max(M_FLOOR, M + min(0.0, M_dot) * max(0.0, a_ramp + BRAKE_SHARE * M) / J)
    if v < 0.0 and not crossing:
        return start
    B = max(BRAKE_SHARE * M, -a)
    t = np.arange(0.0, 2.0 * (abs(v) + abs(a) + 5.0) / min(B, 1.0) + (a + B) / J + 1.0, dt)
    acceleration = np.maximum(a - J * t, -B)
    speed = v + np.concatenate(([0.0], np.cumsum(0.5 * (acceleration[1:] + acceleration[:-1]) * dt)))
    way = np.concatenate(([0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * dt)))
    begun = np.argmax(speed >= 0.0)
    over = begun + np.argmax(speed[begun:] < 0.0)
    distance = d - way[begun:over]
    # behind the surface the distance alone counts
    along = np.maximum(D_MIN - distance, D_MIN**2 - np.maximum(distance, 0.0) ** 2 + k * speed[begun:over] / M)
    return max(start, float(along.max(initial=start)))


def test_psi_is_the_largest_phi_of_the_hardest_brake() -> None:
    rng = np.random.default_rng(0)
    for _ in range(300):
        d, v, a = rng.uniform([0.0, -0.8, -6.0], [1.2, 2.0, 6.0])
        M, M_dot, J, k = (
            rng.uniform(1.0, 12.0),
            rng.uniform(-20.0, 20.0),
            rng.uniform(8.0, 200.0),
            rng.uniform(0.3, 8.0),
        )
        expected = brake_by_steps(d, v, a, M, M_dot, J, k)
        assert psi(d, v, a, M, M_dot, J, index(k)) == pytest.approx(expected, rel=1e-3, abs=1e-3)


@settings(max_examples=500, deadline=None)
@given(state=states, system=systems, more=numbers(1e-3, 2.0))
def test_psi_rises_with_acceleration_speed_and_nearness(state: Any, system: Any, more: float) -> None:
    d, v, a = state
    M, M_dot, J, k = system
    rest = (M, M_dot, J, index(k))
    here = psi(d, v, a, *rest)
    slack = 1e-4 * (1.0 + abs(here))
    assert psi(d, v, a + more, *rest) >= here - slack
    assert psi(d - 0.1 * more, v, a, *rest) >= here - slack
    if M_dot >= 0.0:
        assert psi(d, v + 0.1 * more, a, *rest) >= here - slack


def test_psi_at_rest_and_in_retreat_is_phi() -> None:
    for v, a in ((0.0, 0.0), (-0.5, -1.0), (-0.5, 0.0)):
        assert psi(0.3, v, a, 5.0, 0.0, 50.0, index(3.0)) == phi(0.3, v, 5.0, index(3.0))


def test_phi_by_hand() -> None:
    assert phi_star(0.3, 0.5, 4.0, 0.1, 3.0) == pytest.approx(0.01 - 0.09 + 3.0 * 0.5 / 4.0)
    assert phi(0.05, -1.0, 4.0, index(3.0)) == pytest.approx(0.05)  # phi0: too near, however fast it retreats
    assert phi(-0.2, 0.0, 4.0, index(3.0)) == pytest.approx(0.3)
    assert phi_star(-0.2, 0.0, 4.0, 0.1, 3.0) == pytest.approx(0.05)  # overlap is worse than contact


@settings(max_examples=300, deadline=None)
@given(v=numbers(-2.0, 2.0), a=numbers(-10.0, 10.0), J=numbers(1.0, 300.0))
def test_approach_ending_in_closed_form(v: float, a: float, J: float) -> None:
    """After the period at u, ramping u away at J leaves exactly no approach; a little more leaves one."""
    u = approach_ending(v, a, T, J)
    left = v + T * (a + u) / 2.0 + u * abs(u) / (2.0 * J)
    assert left == pytest.approx(0.0, abs=1e-9 * (1.0 + abs(v) + a * a / J))
    more = u + 1e-3
    assert v + T * (a + more) / 2.0 + more * abs(more) / (2.0 * J) > left


@settings(max_examples=300, deadline=None)
@given(v=numbers(-2.0, 2.0), a=numbers(-10.0, 10.0), J=numbers(1.0, 300.0))
def test_of_what_acts_at_once_the_last_control_plays_no_part(v: float, a: float, J: float) -> None:
    u = approach_ending(v, a, T, J, True)
    assert v + T * u + u * abs(u) / (2.0 * J) == pytest.approx(0.0, abs=1e-9 * (1.0 + abs(v)))


@settings(max_examples=300, deadline=None)
@given(state=states, system=systems, at_once=st.booleans())
def test_greatest_approach_is_the_edge_of_what_keeps_the_row(state: Any, system: Any, at_once: bool) -> None:
    d, v, a = state
    M, M_dot, J, k = system
    most = M + abs(a) + 100.0
    u = min(most, greatest_approach(d, v, a, T, M, M_dot, J, index(k)._replace(at_once=at_once), most))

    def after(control: float) -> float:
        begin = control if at_once else a
        d_after = d - T * v - T * T * (2.0 * begin + control) / 6.0
        return psi(d_after, v + T * (begin + control) / 2.0, control, M + T * min(0.0, M_dot), M_dot, J, index(k))

    target = max(0.0, psi(d, v, a, M, M_dot, J, index(k)) * (1.0 - ETA * T))
    slack = 1e-4 * (1.0 + target)
    if u <= -4.0 * M - abs(a) - 10.0 + 1e-6:
        assert after(u) > target - slack  # nothing keeps the row: it asks for all there is
    else:
        assert after(u) <= target + slack
        if u < most - 1e-6:
            assert after(u + 1.0) > target - slack


SYSTEMS = [
    (M, J, k) for M in (1.0, 4.0, 10.0) for J in (10.0, 30.0, 100.0) for k in (0.5, 3.0)
]  # also with M of a second's worth of jerk, and k far under what phi* alone would need


@pytest.mark.parametrize(("M", "J", "k"), SYSTEMS)
@pytest.mark.parametrize("person", ["still", "moving"])
def test_the_row_is_persistently_feasible_on_the_abstract_system(M: float, J: float, k: float, person: str) -> None:
    """d' = -v, v' = a, a' within J: an adversary wants into the person at 1.5 m/s, gives way only to the row.

    The row never asks for more than the index counts on: JERK_SHARE of the jerk, BRAKE_SHARE of M. So d stays over
    d_min.
    """
    rng = np.random.default_rng(1)
    bound = 0.3 * M if person == "moving" else 0.0  # on the person's acceleration; M has it taken off already
    counted = JERK_SHARE * J
    d, v_r, v_h, a = 0.9, 0.0, 0.0, 0.0
    for _ in range(1200):
        v = v_r + v_h
        assert psi(d, v, a + bound, M, 0.0, counted, index(k)) <= 1e-6
        allowed = greatest_approach(d, v, a + bound, T, M, 0.0, counted, index(k), M + 200.0) - bound
        assert allowed >= max(a - J * T, -M - bound)  # the arm can do it
        wanted = min(a + J * T, 8.0) if v_r + a * abs(a) / (2.0 * J) < 1.5 else max(a - J * T, -M)
        u = min(wanted, allowed)
        push = bound * rng.choice([-1.0, 1.0, 1.0]) * (abs(v_h) < 0.5)
        d -= T * v + T * T * ((2.0 * a + u) / 6.0 + push / 2.0)
        v_r, v_h, a = v_r + T * (a + u) / 2.0, v_h + T * push, u
        assert d >= D_MIN - 1e-6
    assert d < 0.5 or M >= J  # it did come near


def test_phi_rate_is_the_derivative_of_phi() -> None:
    rng = np.random.default_rng(2)
    seen = set()
    for _ in range(300):
        d, v, a, M, M_dot = rng.uniform([-0.1, -1.0, -5.0, 1.0, -10.0], [0.6, 1.0, 5.0, 10.0, 10.0])
        rate = phi_rate(d, -v, -a, M, M_dot, index(3.0))
        h = 1e-6
        now, ahead, behind = (
            phi(d - v * t - a * t * t / 2.0, v + a * t, M + M_dot * t, index(3.0)) for t in (0.0, h, -h)
        )
        if abs((ahead - now) - (now - behind)) > 1e-8:
            continue  # phi0 and phi* cross here
        assert rate == pytest.approx((ahead - behind) / (2.0 * h), rel=1e-4, abs=1e-4)
        seen.add(bool(D_MIN - d > phi_star(d, v, M, D_MIN, 3.0)))
    assert seen == {True, False}


# --- the rows of the arm ---------------------------------------------------------------------------------------------


def arm_state(system: Any, q: Any, dq: Any, ddq: Any) -> Any:
    state = replace(initial(system), mode=Mode.ACTIVE)
    return replace(state, q_cmd=vector(q), dq_cmd=vector(dq), ddq_cmd=vector(ddq))


def scenes(bench: Any, count: int, seed: int, speed: float = 1.0) -> Any:
    """(state, inputs) of a moving arm and people about it."""
    system = bench.system()
    b = system.bounds
    rng = np.random.default_rng(seed)
    for _ in range(count):
        q = rng.uniform(0.8 * b.q_min, 0.8 * b.q_max)
        dq = speed * rng.uniform(-0.3, 0.3, 6) * b.dq_max
        ddq = speed * rng.uniform(-0.5, 0.5, 6) * b.ddq_max
        p0 = rng.uniform([-0.8, -0.8, 0.0], [0.8, 0.8, 0.9], (3, 3))
        v = rng.normal(0.0, 0.7, (3, 3))
        human = bench.human(p0, p0 + rng.normal(0.0, 0.2, (3, 3)), 0.08, v, velocity_bound=vector([0.2] * 3))
        yield arm_state(system, q, dq, ddq), bench.inputs(bench.joint(q), human)


def test_no_single_row_asks_for_more_than_the_joint_bounds_give(bench: Any) -> None:
    system = bench.system()
    seen = set()
    for state, x in scenes(bench, 150, 3):
        found = rows(system, state, x)
        most = np.maximum(found.C * found.box[0], found.C * found.box[1]).sum(axis=1)
        assert np.all(np.isfinite(found.floor))
        assert np.all(found.floor < most)
        assert np.all(found.base <= found.floor)
        seen |= set(found.basis.tolist())
    assert seen == set(Basis)


def evaluated(system: Any, state: Any, x: Any) -> tuple[Any, tuple[Any, ...]]:
    """(pairs, row_floors) of a scene with M of every pair, those that `rows` leaves out as well."""
    s, b = system.params.safety, system.bounds
    people = predict(x.human, (x.human_age_ns + system.params.robot.command_latency_ns) * 1e-9)
    q, dq, ddq = state.q_cmd, state.dq_cmd, state.ddq_cmd
    a_h = s.human_acceleration
    chain, capsules = system.model.chain, system.model.capsules
    pairs = nearest_first(separation(chain, capsules, people, q, dq, s.activation_distance, a_h))
    M, M_dot = radii(system.model.arm, people, q, dq, ddq, a_h, pairs)
    box = command_box(b, q, dq, ddq, T)
    brake_time = float(np.max(np.abs(dq) / b.ddq_max + b.ddq_max / b.dddq_max))
    none = np.zeros(len(M), np.bool_)
    return pairs, row_floors(
        pairs, none, M, M_dot, ddq, b.dddq_max, *box, braking(b, dq, *box), T, system.index, brake_time
    )


@pytest.mark.parametrize("speed", [1.0, 0.15])
def test_a_row_that_is_left_out_is_one_that_no_control_can_break(bench: Any, speed: float) -> None:
    """With its real M and M_dot it asks for no more than the least that the joint bounds leave; the others are as they
    are with all pairs evaluated."""
    system, free = bench.system(), 0
    for state, x in scenes(bench, 100, 8, speed):
        found = rows(system, state, x)
        left_out = found.basis == Basis.FREE
        pairs, (value, floor, base, basis, outside) = evaluated(system, state, x)
        np.testing.assert_array_equal(pairs.d, found.pairs.d)
        least = np.minimum(found.C * found.box[0], found.C * found.box[1]).sum(axis=1)
        assert np.all(floor[left_out] <= least[left_out] + 1e-6)
        assert np.all(found.M[left_out] == 0.0)
        assert np.all((found.phi >= value) | (found.pairs.d_dot > 0.0))
        quick = found.floor, found.base, found.basis, found.which[3]
        for mine, full in zip(quick, (floor, base, basis, outside), strict=True):
            np.testing.assert_array_equal(mine[~left_out], full[~left_out])
        free += left_out.sum()
    assert free > 50


def test_outside_its_ranges_a_pair_is_flagged_and_near_the_approach_has_to_end(bench: Any) -> None:
    """The same scenes with a certificate for hardly any speed: rows only ask for more, and near they are those of a
    robot that does not approach, or all that the arm can do."""
    system = bench.system()
    slow = System(replace(system.params, safety=replace(system.params.safety, v_max=0.2)))
    seen, stricter = Outside.NOTHING, 0
    for state, x in scenes(bench, 100, 9):
        found, strict = rows(system, state, x), rows(slow, state, x)
        d, v = strict.pairs.d, -strict.pairs.d_dot
        for i, flags in enumerate(strict.which[3]):
            assert bool(flags & Outside.SPEED) == (v[i] > 0.2)
            assert bool(flags & Outside.DISTANCE) == (d[i] < system.params.safety.d_min)
            assert bool(flags & Outside.RADIUS) == (strict.basis[i] == Basis.M_FLOOR)
            seen |= Outside(int(flags))
        assert np.all(strict.floor >= found.floor)
        changed = strict.floor > found.floor
        assert np.all(np.isin(strict.basis[changed], (Basis.STANDSTILL, Basis.RAMP)))
        stricter += changed.sum()
    assert seen == Outside.DISTANCE | Outside.SPEED | Outside.RADIUS
    assert stricter > 5


def test_the_joint_space_brake_keeps_the_rows_of_what_the_control_hardly_reaches(bench: Any) -> None:
    """Whatever carries such a link to and fro: its row never asks to be driven on."""
    system, seen = bench.system(), 0
    for state, x in scenes(bench, 150, 10, speed=3.0):
        found = rows(system, state, x)
        brake = braking(system.bounds, state.dq_cmd, *found.box)
        slow = found.basis == Basis.M_FLOOR
        assert np.all(found.C[slow] @ brake >= found.floor[slow])
        seen += np.sum(found.floor[slow] > -1e5)
    assert seen > 50


def test_at_rest_standing_still_keeps_every_row_strictly(bench: Any) -> None:
    """Whatever the people do: the robot may always stay where it is, with room for the solver's tolerance."""
    system = bench.system()
    for state, x in scenes(bench, 150, 4, speed=0.0):
        found = rows(system, state, x)
        assert np.all(found.floor < -1e-5)


def test_inside_d_min_no_row_lets_the_robot_approach(bench: Any) -> None:
    """At rest, too near, and the person does not give way: what the row allows is a few micrometres per second."""
    system = bench.system()
    checked = 0
    for state, x in scenes(bench, 200, 5, speed=0.0):
        found = rows(system, state, x)
        near = (found.pairs.d < system.params.safety.d_min) & (found.basis == Basis.STANDSTILL)
        speed_after = -0.5 * T * found.floor[near]  # towards the person, from rest, after one period
        assert np.all(speed_after <= 2e-6)
        checked += near.sum()
    assert checked > 20


def test_a_direction_that_no_joint_moves_is_no_division_by_zero(bench: Any) -> None:
    """A person exactly in the plane of the first link who walks across it: C = 0 to the bit, M = drift, over its
    floor."""
    system = bench.system()
    q = np.array([0.0, 0.0, 0.0, 0.0, -1.5, 0.0])
    human = bench.human([[0.5, 0.0, 0.3]], [[0.5, 0.0, 0.0]], 0.05, v=(0.0, 3.0, 0.0))
    x = bench.inputs(bench.joint(q), human, human_age_ns=-60_000_000)
    found = rows(system, arm_state(system, q, np.zeros(6), np.zeros(6)), x)
    blocked = np.all(found.C == 0.0, axis=1)
    assert np.any(blocked & (system.params.safety.M_floor < found.M))
    assert np.all(np.isfinite(found.floor)) and np.all(found.floor[blocked] <= 0.0)


def test_rows_look_at_the_people_of_one_latency_ahead(bench: Any) -> None:
    """Age plus command latency, at the measured velocity, grown by the bounds."""
    system = bench.system()
    state = arm_state(system, bench.HOME, np.zeros(6), np.zeros(6))
    bounds = {"velocity_bound": vector([0.25]), "position_bound": vector([0.03])}
    horizon = 0.04 + 0.06
    near, far = [[0.9, 0.0, 0.3]], [[1.9, 0.0, 0.3]]
    for ends in ((near, far), (far, near)):
        human = bench.human(*ends, v=(-1.0, 0.5, 0.0))
        x = bench.inputs(bench.joint(bench.HOME), replace(human, **bounds), human_age_ns=40_000_000)
        found = rows(system, state, x)
        moved = replace(human, p0=vector(human.p0 + horizon * human.v0), p1=vector(human.p1 + horizon * human.v1))
        expected = bench.true_distance(system, bench.HOME, moved) - 0.03 - 0.25 * horizon
        assert found.pairs.d.min() == pytest.approx(expected, abs=1e-9)
    assert np.all(np.diff(found.pairs.d) >= 0.0)  # nearest first


def test_retreat_is_not_slowed(bench: Any) -> None:
    """A person stands behind: full acceleration away keeps every row of theirs."""
    system = bench.system()
    found = rows(
        system,
        arm_state(system, bench.HOME, np.zeros(6), np.zeros(6)),
        bench.inputs(bench.joint(bench.HOME), bench.human([[0.6, 0.35, 0.3]])),
    )
    away = np.where(found.C[0] > 0.0, found.box[1], found.box[0])
    kept = found.C @ away >= found.floor
    assert kept[0]


@settings(max_examples=50, deadline=None)
@given(data=st.data())
def test_floors_are_finite_for_any_scene(bench: Any, data: Any) -> None:
    system = bench.system()
    coordinate = st.floats(-1.5, 1.5, width=32)
    q = np.array(data.draw(st.lists(st.sampled_from([0.0, 0.5, -1.0, 1.5]), min_size=6, max_size=6)))
    p0, p1, v = (np.array([data.draw(st.tuples(coordinate, coordinate, coordinate))]) for _ in range(3))
    assume(np.all(q >= system.bounds.q_min) and np.all(q <= system.bounds.q_max))
    dq = np.array(data.draw(st.lists(st.sampled_from([0.0, 1.0, -2.0]), min_size=6, max_size=6)))
    x = bench.inputs(bench.joint(q), bench.human(p0, p1, 0.1, v))
    found = rows(system, arm_state(system, q, dq, np.zeros(6)), x)
    assert np.all(np.isfinite(found.floor)) and np.all(np.isfinite(found.M)) and np.all(np.isfinite(found.phi))
