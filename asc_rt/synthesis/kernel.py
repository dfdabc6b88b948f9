"""One sampled state: M, the extremes of its rate over the control set, and the state pulled onto phi = 0; compiled.

    M      = drift - a_h + max over U of C u                          one-sided radius, what the index uses
    ball   = min(M, -drift - a_h + max over U of -C u)                zero-centred radius, the paper's
    M_dot(u) = dM/dq . dq + dM/dp_h . v_h + g . u -+ |dM/dv_h| a_h    g = dM/d dq in closed form (`core.gradient`)

dM/dq . dq needs no second linear program: by the envelope theorem the value moves with the data at the vertex and
multipliers that are optimal here, so that one difference of the data along the motion gives it. The extremes over u in
U are two linear programs with the costs g and -g.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from asc_rt.core.abstraction import People, distance, pair, place
from asc_rt.core.dynamics import inertia_and_bias, inverse
from asc_rt.core.gradient import drift_gradient, support_gradient
from asc_rt.core.kinematics import Motion, cross, forward
from asc_rt.core.limits import acceleration_box
from asc_rt.core.polytope import Polytope, Support, moved, support
from asc_rt.core.radius import JUMP
from asc_rt.core.robot_model import Arm
from asc_rt.core.types import Vector

STEP = 1e-6  # s, of the one difference; its error is STEP / 2 times the second derivative, 1e-4 of M_dot
NO_LIMITS = np.inf

# Columns of the result.
# (.._LOW, .._HIGH: least and greatest rate over U; of the one-sided radius only the fall matters)
D, D_DOT, D_DOT_ROBOT, RADIUS, RADIUS_LOW, BALL, BALL_LOW, BALL_HIGH = range(8)
COLUMNS = 8


class Conditions(NamedTuple):
    human_acceleration: float  # m/s2
    limited: bool  # joint limits belong to U; else the torque box alone, as in the paper


class Situation(NamedTuple):
    """The data of one pair in one state, of which M is made."""

    motion: Motion
    r0: np.ndarray  # (3,) m, end points of the robot capsule
    r1: np.ndarray
    d: float  # m
    d_dot: float  # m/s
    d_dot_robot: float  # m/s, of the robot's own motion
    C: np.ndarray  # (n,)
    drift: float  # m/s2, of a person who keeps their velocity
    U: Polytope
    unlimited: np.ndarray  # H^-1 if the torque alone limits the arm (the paper's U), else (0, 0)


@njit(cache=True, nogil=True)
def situation(arm: Arm, limited: bool, people: People, q: Vector, dq: Vector, capsule: int) -> Situation:
    motion = forward(arm.chain, q, dq)
    n, joint = q.shape[0], arm.capsules.joint[capsule]
    C = np.empty(n)
    r0 = np.array(place(motion, joint, arm.capsules.p0[capsule]))
    r1 = np.array(place(motion, joint, arm.capsules.p1[capsule]))
    d = distance(r0, r1, arm.capsules.radius[capsule], people, 0)
    d_dot, drift, own, _ = pair(motion, joint, r0, r1, people, 0, 0.0, C)
    G, low, high, unlimited = np.zeros((0, n)), np.zeros(0), np.zeros(0), np.zeros((0, 0))
    if arm.effort.shape[0] > 0:
        H, h = inertia_and_bias(motion, arm.bodies)
        G, low, high = H, -arm.effort - h, arm.effort - h
        if not limited:
            unlimited = inverse(H)
    if limited:
        lower, upper = acceleration_box(arm.bounds, q, dq)
    else:
        lower, upper = np.full(n, -NO_LIMITS), np.full(n, NO_LIMITS)
    return Situation(motion, r0, r1, d, d_dot, own, C, drift, Polytope(lower, upper, G, low, high), unlimited)


@njit(cache=True, nogil=True)
def best(c: Vector, s: Situation) -> Support:
    """max c . u over U. Without joint limits U is a box of torques: y = H^-1 c, u = H^-1 (active bound)."""
    n = c.shape[0]
    if s.unlimited.shape[0] == 0:
        return support(c, s.U)
    y, u, value = np.zeros(2 * n), np.zeros(n), 0.0
    for i in range(n):
        for k in range(n):
            y[n + i] += s.unlimited[i, k] * c[k]
    for i in range(n):
        bound = s.U.high[i] if y[n + i] > 0.0 else s.U.low[i]
        value += y[n + i] * bound
        for k in range(n):
            u[k] += s.unlimited[k, i] * bound
    return Support(value, u, y)


@njit(cache=True, nogil=True)
def change(here: Situation, there: Situation, sign: float, at: Support) -> float:
    """Change of sign (drift + C u) at its best vertex and multipliers, from one situation to another nearby."""
    return sign * (there.drift - here.drift) + moved(at, sign * here.C, here.U, sign * there.C, there.U)


@njit(cache=True, nogil=True)
def shifted(arm: Arm, limited: bool, people: People, q: Vector, dq: Vector, capsule: int, t: float) -> Situation:
    moved = People(
        people.p0 + t * people.v0, people.p1 + t * people.v1, people.v0, people.v1, people.radius, people.velocity_bound
    )
    return situation(arm, limited, moved, q + t * dq, dq, capsule)


@njit(cache=True, nogil=True)
def foot(s: Situation, point: Vector) -> float:
    """Where on the robot capsule's axis the nearest point to `point` is, 0..1."""
    rr = t = 0.0
    for k in range(3):
        e = s.r1[k] - s.r0[k]
        rr += e * e
        t += (point[k] - s.r0[k]) * e
    return min(1.0, max(0.0, t / rr)) if rr > 1e-12 else 0.0


@njit(cache=True, nogil=True)
def velocity_sensitivity(s: Situation, people: People, joint: int) -> float:
    """|d drift / d v_h| of a point-shaped person, 1/s: 2 |w_dot - d_dot n - slip along the axis| / D."""
    e, t = s.r1 - s.r0, foot(s, people.p0[0])
    omega, origin = s.motion.omega[joint], s.motion.origin[joint]
    point = s.r0 + t * e
    w = point - people.p0[0]
    spin, turn = cross(omega, point - origin), cross(omega, e)
    D = rr = along = slip = 0.0
    rate = np.empty(3)
    for k in range(3):
        rate[k] = s.motion.velocity[joint, k] + spin[k] - people.v0[0, k]
        D += w[k] * w[k]
        rr += e[k] * e[k]
        along += w[k] * rate[k]
        slip += e[k] * rate[k] + w[k] * turn[k]
    share = slip / rr if 0.0 < t < 1.0 else 0.0
    square = 0.0
    for k in range(3):
        part = rate[k] - along * w[k] / D - share * e[k]
        square += part * part
    return 2.0 * math.sqrt(square / D)


class Radius(NamedTuple):
    """A radius and its rate: rate + g . u, less (more) than that by up to `spread`."""

    value: float  # m/s2
    rate: float  # m/s3
    g: np.ndarray  # (n,) 1/s
    spread: float  # m/s3


@njit(cache=True, nogil=True)
def radius(
    arm: Arm,
    given: Conditions,
    people: People,
    q: Vector,
    dq: Vector,
    capsule: int,
    here: Situation,
    there: Situation,
    sign: float,
    at: Support,
) -> Radius:
    """sign (drift + C u) at its maximum `at`: M for sign = 1, the lower side of the ball for -1.

    there: the situation STEP later.
    """
    joint = arm.capsules.joint[capsule]
    rate = change(here, there, sign, at) / STEP
    if abs(rate) > JUMP:  # steep, or a nearest point just left a segment's end: then the way here tells the slope
        before = shifted(arm, given.limited, people, q, dq, capsule, -STEP)
        behind = -change(here, before, sign, at) / STEP
        rate = behind if abs(behind) < abs(rate) else rate
    g = drift_gradient(here.motion, joint, here.r0, here.r1, people, 0)
    slopes = support_gradient(arm, here.motion, here.U.lower, here.U.upper, at.y)
    for i in range(g.shape[0]):
        g[i] = sign * g[i] + slopes[i]
    spread = 0.0
    if given.human_acceleration > 0.0:
        spread = given.human_acceleration * velocity_sensitivity(here, people, joint)
    return Radius(sign * here.drift + at.value - given.human_acceleration, rate, g, spread)


@njit(cache=True, nogil=True)
def evaluate(
    arm: Arm, given: Conditions, people: People, q: Vector, dq: Vector, capsule: int, ball: bool, out: Vector
) -> None:
    """The columns of one state; without `ball` those of the ball are left as they are."""
    here = situation(arm, given.limited, people, q, dq, capsule)
    there = shifted(arm, given.limited, people, q, dq, capsule, STEP)
    upper = best(here.C, here)
    one = radius(arm, given, people, q, dq, capsule, here, there, 1.0, upper)
    out[D], out[D_DOT], out[D_DOT_ROBOT] = here.d, here.d_dot, here.d_dot_robot
    out[RADIUS], out[RADIUS_LOW] = one.value, one.rate - best(-one.g, here).value - one.spread
    if not ball:
        return
    lower = best(-here.C, here)
    if lower.value - here.drift < upper.value + here.drift:
        two = radius(arm, given, people, q, dq, capsule, here, there, -1.0, lower)
        out[BALL], out[BALL_LOW] = two.value, two.rate - best(-two.g, here).value - two.spread
        out[BALL_HIGH] = two.rate + best(two.g, here).value + two.spread
    else:
        out[BALL], out[BALL_LOW] = out[RADIUS], out[RADIUS_LOW]
        out[BALL_HIGH] = one.rate + best(one.g, here).value + one.spread
