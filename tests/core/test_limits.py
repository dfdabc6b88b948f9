"""Stopping distance and joint bounds: against Ruckig's own plans, and in closed loop with an adversary at the
bounds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import ruckig

from asc_rt.core.limits import Bounds, acceleration_box, braking, command_box, reserve
from asc_rt.core.stopping import stopping_distance


def stop_plan(v: float, a: float, A: float, J: float, q: float = 0.0) -> Any:
    """Ruckig's fastest stop, and the extremes of the position on it."""
    request = ruckig.InputParameter(1)
    request.control_interface = ruckig.ControlInterface.Velocity
    request.current_position, request.current_velocity, request.current_acceleration = [q], [v], [a]
    request.target_velocity, request.target_acceleration = [0.0], [0.0]
    request.max_acceleration, request.max_jerk = [A * (1 + 1e-12)], [J]
    plan = ruckig.Trajectory(1)
    result = ruckig.Ruckig(1).calculate(request, plan)
    assert result in (ruckig.Result.Working, ruckig.Result.Finished)
    return plan


def test_stopping_distance_is_the_farthest_point_of_ruckigs_stop() -> None:
    rng = np.random.default_rng(0)
    seen = set()
    for _ in range(4000):
        A, J = 10.0 ** rng.uniform(-1, 2), 10.0 ** rng.uniform(0, 4)
        a = A * rng.choice([rng.uniform(-1, 1), -1.0, 0.0, 1.0])
        # around the speeds at which the branches change
        v = rng.choice([a * a / (2 * J), A * A / J, A * A / (2 * J), 1.0]) * rng.uniform(-2.0, 2.0)
        plan = stop_plan(v, a, A, J)
        farthest = max(0.0, plan.position_extrema[0].max)
        assert stopping_distance(v, a, A, J) == pytest.approx(farthest, rel=1e-6, abs=1e-9 * (1 + A**3 / J**2))
        v1 = v + a * a / (2 * J)
        seen.add(
            "turns" if a < 0 < v and v1 * J < a * a else "plateau" if v1 * J > A * A else "wedge" if v1 > 0 else "away"
        )
    assert seen == {"turns", "plateau", "wedge", "away"}


def test_stopping_distance_by_fine_steps() -> None:
    """Independent of Ruckig: bang-bang jerk, integrated."""
    dt = 1e-4
    for v, a, A, J in ((1.0, 0.0, 8.0, 70.0), (2.0, 5.0, 8.0, 70.0), (0.3, -2.0, 8.0, 70.0), (0.02, 1.0, 3.0, 500.0)):
        x = farthest = 0.0
        speed, acceleration = v, a
        while speed > 0.0:
            braking = speed > acceleration * acceleration / (2.0 * J) or acceleration > 0.0
            acceleration = max(-A, acceleration - J * dt) if braking else min(0.0, acceleration + J * dt)
            speed += acceleration * dt
            x += speed * dt
            farthest = max(farthest, x)
            if acceleration == 0.0 and speed < 1e-3:
                break
        assert stopping_distance(v, a, A, J) == pytest.approx(farthest, rel=0.02, abs=2e-4)


def test_stopping_distance_grows_with_speed_and_acceleration() -> None:
    rng = np.random.default_rng(1)
    for _ in range(3000):
        A, J = rng.uniform(1, 20), 10.0 ** rng.uniform(1, 4)
        v, a = rng.uniform(-3, 3), rng.uniform(-A, A)
        here = stopping_distance(v, a, A, J)
        assert here >= 0.0
        assert stopping_distance(v + 0.01, a, A, J) >= here - 1e-12
        assert stopping_distance(v, min(A, a + 0.01), A, J) >= here - 1e-12


def robots(bench: Any) -> dict[str, tuple[Bounds, float]]:
    """Many joints at once, and the period: the LR Mate, and joints from sluggish to nearly without jerk limit."""
    lrmate = bench.system().bounds
    n = 24

    def joints(A: float, J: float, v: float = 2.0, room: float = 0.6) -> Bounds:
        return Bounds(*(np.full(n, x) for x in (-room, room, v, A, J)))

    return {
        "lrmate": (Bounds(*(np.tile(x, 4) for x in lrmate)), 0.008),
        "lrmate 2 ms": (Bounds(*(np.tile(x, 4) for x in lrmate)), 0.002),
        "sluggish": (joints(3.0, 10.0), 0.008),
        "between": (joints(8.0, 300.0), 0.008),
        "sudden": (joints(15.0, 7500.0), 0.008),
    }


def adversary(policy: str, lower: Any, upper: Any, rng: Any, memory: dict[str, Any]) -> Any:
    """Controls inside the box, at its ends as far as possible."""
    if memory["left"] <= 0:
        memory["left"] = int(rng.integers(1, 150))
        memory["side"] = rng.random(len(lower)) < 0.5
    memory["left"] -= 1
    if policy == "push":
        share = np.ones(len(lower)) if memory["k"] % 4000 < 2000 else np.zeros(len(lower))
    elif policy == "bang":
        share = memory["side"].astype(float)
    else:
        share = np.where(memory["side"], 1.0 - rng.random(len(lower)) ** 4, rng.random(len(lower)) ** 4)
    memory["k"] += 1
    return lower + (upper - lower) * share


@pytest.mark.compiled
@pytest.mark.parametrize("policy", ["push", "bang", "random"])
@pytest.mark.parametrize(
    ("robot", "at_once"),
    [(name, False) for name in ("lrmate", "lrmate 2 ms", "sluggish", "between", "sudden")]
    + [("between", True), ("sudden", True)],
)
def test_no_control_in_the_box_ever_breaks_a_limit(bench: Any, robot: str, at_once: bool, policy: str) -> None:
    """Nor brings the joint where the planned stop would break one: that stop is what every fault falls back on."""
    b, T = robots(bench)[robot]
    n = len(b.q_min)
    rng = np.random.default_rng(7)
    q = rng.uniform(0.5 * b.q_min, 0.5 * b.q_max)
    dq, ddq = np.zeros(n), np.zeros(n)
    memory = {"left": 0, "k": 0}
    reached = 0.0
    for k in range(6000):
        lower, upper = command_box(b, q, dq, ddq, T, at_once)
        assert np.all(lower <= upper)
        u = adversary(policy, lower, upper, rng, memory)
        begin = u if at_once else ddq
        q, dq, ddq, before = q + T * dq + T * T * (2.0 * begin + u) / 6.0, dq + T * (begin + u) / 2.0, u, ddq
        assert np.all(q <= b.q_max + 1e-9) and np.all(q >= b.q_min - 1e-9)
        assert np.all(np.abs(dq) <= b.dq_max * (1 + 1e-9))
        assert np.all(np.abs(ddq) <= b.ddq_max * (1 + 1e-9))
        assert np.all(np.abs(ddq - before) <= T * b.dddq_max * (1 + 1e-9))
        reached = max(reached, float(np.max(q / b.q_max)))
        if k % 20 == 0:
            stop = np.array([stopping_distance(*x) for x in zip(dq, ddq, b.ddq_max, b.dddq_max, strict=True)])
            back = np.array(
                [stopping_distance(-v, -a, A, J) for v, a, A, J in zip(dq, ddq, b.ddq_max, b.dddq_max, strict=True)]
            )
            assert np.all(q + stop <= b.q_max + 1e-6) and np.all(q - back >= b.q_min - 1e-6)
    assert reached > 0.9  # the adversary did get to a limit


def test_the_last_acceleration_plays_no_part_where_the_next_acts_at_once() -> None:
    """On its way to the speed limit, and to the end of the range, in closed form."""
    A, J, v, room, T = 8.0, 300.0, 2.0, 0.6, 0.008
    b = Bounds(*(np.array([x]) for x in (-room, room, v, A, J)))
    for ddq in (-2.0, 0.0, 2.0):
        _, upper = command_box(b, np.zeros(1), np.array([1.96]), np.array([ddq]), T, True)
        u = np.sqrt((J * T) ** 2 + 2.0 * J * (v - 1.96)) - J * T  # dq + T u + u^2 / 2J = dq_max
        assert upper[0] == pytest.approx(min(u, ddq + J * T))
        for u in (-0.3, 0.3):
            speed = 1.2 + T * u
            q = room - reserve(v, A, J, T) - stopping_distance(speed, u, A, J) - T * 1.2 - T * T * u / 2.0
            _, upper = command_box(b, np.array([q]), np.array([1.2]), np.array([ddq]), T, True)
            assert upper[0] == pytest.approx(u, abs=1e-6)


def test_the_box_reaches_the_jerk_and_acceleration_limits_far_from_every_other(bench: Any) -> None:
    b, T = bench.system().bounds, 0.008
    for ddq in (np.zeros(6), 0.4 * b.ddq_max, -0.4 * b.ddq_max):
        lower, upper = command_box(b, np.zeros(6), np.zeros(6), ddq, T)
        np.testing.assert_allclose(upper, np.minimum(b.ddq_max, ddq + T * b.dddq_max))
        np.testing.assert_allclose(lower, np.maximum(-b.ddq_max, ddq - T * b.dddq_max))


def test_an_acceleration_beyond_its_limit_goes_back_as_fast_as_the_jerk_allows() -> None:
    """A smaller limit came, with another tool: far from every wall nothing but the jerk says how fast."""
    A, J, T = 8.0, 300.0, 0.008
    b = Bounds(*(np.array([x]) for x in (-9.0, 9.0, 2.0, A, J)))
    for ddq in (A + 2.0 * J * T, A + 1.5 * J * T):
        assert command_box(b, np.zeros(1), np.zeros(1), np.array([ddq]), T)[1] == pytest.approx(ddq - J * T)
        assert command_box(b, np.zeros(1), np.zeros(1), np.array([-ddq]), T)[0] == pytest.approx(J * T - ddq)


def test_braking_is_full_and_in_the_end_no_faster_than_the_jerk_can_follow() -> None:
    """-dq J / A inside the box: at 40 rad/s3 and 4 rad/s2 ten times the speed."""
    cases = [  # dq, lower, upper, brake
        (0.02, -4.0, 4.0, -0.2), (-0.02, -4.0, 4.0, 0.2), (3.0, -4.0, 4.0, -4.0), (-3.0, -4.0, 3.5, 3.5),
        (0.3, -2.5, 4.0, -2.5), (0.0, -4.0, 4.0, 0.0), (1.0, 0.5, 2.0, 0.5), (-1.0, -3.0, -0.5, -0.5),
    ]  # fmt: skip
    dq, lower, upper, brake = (np.array(column) for column in zip(*cases, strict=True))
    n = len(cases)
    b = Bounds(*(np.full(n, x) for x in (-1.0, 1.0, 5.0, 4.0, 40.0)))
    np.testing.assert_allclose(braking(b, dq, lower, upper), brake)


def test_out_of_the_limits_the_box_leads_back(bench: Any) -> None:
    b, T = bench.system().bounds, 0.008
    for side in (1.0, -1.0):
        q = np.where(side > 0, b.q_max + 0.01, b.q_min - 0.01)
        dq, ddq = np.zeros(6), np.zeros(6)
        for _ in range(100):
            lower, upper = command_box(b, q, dq, ddq, T)
            assert np.all(lower <= upper)
            u = upper if side > 0 else lower
            q, dq, ddq = q + T * dq + T * T * (2.0 * ddq + u) / 6.0, dq + T * (ddq + u) / 2.0, u
        assert np.all(q <= b.q_max) and np.all(q >= b.q_min)


def test_acceleration_box_is_the_full_range_in_the_open_and_shrinks_towards_a_limit(bench: Any) -> None:
    b = bench.system().bounds
    lower, upper = acceleration_box(b, np.zeros(6), np.zeros(6))
    np.testing.assert_allclose(upper, b.ddq_max)
    np.testing.assert_allclose(lower, -b.ddq_max)
    rng = np.random.default_rng(3)
    for _ in range(500):
        q = rng.uniform(b.q_min, b.q_max)
        dq = rng.uniform(-b.dq_max, b.dq_max)
        lower, upper = acceleration_box(b, q, dq)
        assert np.all((-b.ddq_max <= lower) & (lower <= b.ddq_max))
        assert np.all((-b.ddq_max <= upper) & (upper <= b.ddq_max))
        nearby = acceleration_box(b, q, dq + 1e-7)
        np.testing.assert_allclose(nearby, (lower, upper), atol=1e-4)  # continuous
    # full speed ahead leaves nothing to accelerate with; at the wall it has to brake
    assert np.all(acceleration_box(b, np.zeros(6), b.dq_max)[1] <= 1e-9)
    assert np.all(acceleration_box(b, b.q_max, 0.5 * b.dq_max)[1] < 0.0)


def still_stops(u: float, room: float, dq: float, ddq: float, b: Bounds, T: float) -> bool:
    """Whether joint 0 keeps its limits if its acceleration goes to u in T and it then stops as fast as it can: by
    small steps, then the closed form that has a test of its own."""
    A, J, most = b.ddq_max[0], b.dddq_max[0], b.dq_max[0]
    h, way, speed, a = T / 200, 0.0, dq, ddq
    for _ in range(200):
        a_next = a + (u - ddq) / 200
        way, speed, a = way + h * speed + h * h * (2 * a + a_next) / 6, speed + h * (a + a_next) / 2, a_next
    peak = speed + max(0.0, u) ** 2 / (2 * J)
    return bool(peak <= most and way + stopping_distance(speed, u, A, J) <= room)


def test_the_box_ends_where_a_stop_inside_the_limits_is_just_possible() -> None:
    rng = np.random.default_rng(11)
    ends = {"jerk": 0, "limit": 0, "too late": 0}
    for _ in range(150):
        A, J, v, T = rng.uniform(3, 15), 10.0 ** rng.uniform(1, 4), rng.uniform(1, 3), rng.choice([0.002, 0.008, 0.1])
        b = Bounds(*(np.array([x]) for x in (-9.0, 0.0, v, A, J)))
        dq, ddq = np.array([rng.uniform(-0.2, v)]), np.array([rng.uniform(-A, A)])
        free = T * min(A, J * T / 8.0) * (v / A + A / J)  # a stop that begins a little late
        needed = stopping_distance(dq[0], ddq[0], A, J) + T * dq[0]
        room = needed * rng.uniform(0.9, 1.3)
        q = np.array([-free - room])
        low, high = max(-A, ddq[0] - J * T), min(A, ddq[0] + J * T)
        lower, upper = command_box(b, q, dq, ddq, T)
        mirrored = Bounds(-b.q_max, -b.q_min, *b[2:])
        np.testing.assert_allclose(command_box(mirrored, -q, -dq, -ddq, T)[0], -upper)
        u = float(upper[0])
        if not still_stops(low, room, dq[0], ddq[0], b, T):
            assert u == low or dq[0] <= 0.0
            ends["too late"] += 1
            continue
        assert still_stops(u - 1e-7, room, dq[0], ddq[0], b, T)
        assert u == high or not still_stops(u + 1e-6, room, dq[0], ddq[0], b, T)
        ends["jerk" if u == high else "limit"] += 1
    assert min(ends.values()) > 10, ends


@pytest.mark.parametrize("speed", [0.5, -0.5])
def test_between_two_walls_the_one_that_is_approached_counts(speed: float) -> None:
    b, T = Bounds(*(np.array([x]) for x in (-0.01, 0.01, 2.0, 8.0, 300.0))), 0.008
    lower, upper = command_box(b, np.zeros(1), np.array([speed]), np.zeros(1), T)
    assert lower == upper == pytest.approx(-np.sign(speed) * 300.0 * T)


@pytest.mark.parametrize(("wall", "speed"), [(0.0005, 0.01), (0.0005, -0.01), (0.0007, 0.01), (0.0007, -0.01)])
def test_where_both_walls_call_for_braking_the_one_that_is_approached_counts(wall: float, speed: float) -> None:
    """Nearer to each other than what is kept free before each: the other wall asks for the opposite."""
    b, T = Bounds(*(np.array([x]) for x in (-wall, wall, 2.0, 8.0, 300.0))), 0.008
    lower, upper = command_box(b, np.zeros(1), np.array([speed]), np.zeros(1), T)
    assert lower == upper == pytest.approx(-np.sign(speed) * 300.0 * T)


def test_acceleration_box_knows_the_speed_from_which_full_braking_just_does() -> None:
    """At the speed sqrt(2 A room) nothing is left to accelerate with; over the speed of a jerk ramp it fades out."""
    A, J = 8.0, 300.0
    b = Bounds(*(np.array([x]) for x in (-0.3, 0.5, 3.0, A, J)))
    for q in (0.1, 0.4):
        for side, room in ((1.0, 0.5 - q), (-1.0, q + 0.3)):
            for missing in (0.0, 0.01, 0.1, 0.3):
                dq = side * (min(3.0, np.sqrt(2.0 * A * room)) - missing)
                lower, upper = acceleration_box(b, np.array([q]), np.array([dq]))
                ahead = upper[0] if side > 0 else -lower[0]
                assert ahead == pytest.approx(min(A, missing * J / A))
