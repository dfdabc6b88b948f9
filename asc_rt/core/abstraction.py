"""The abstraction: arm and people -> per pair z = [d, d_dot], how the control enters d_ddot, and what it can realize.

For a robot capsule and a human capsule let w = p_r - p_h join the nearest points of the two segments.
D = |w|, n = w / D.

    d      = D - r_r - r_h                                    separation distance of the surfaces
    d_dot  = n . w_dot                                        w_dot = v_r - v_h at the nearest points
    d_ddot = C u + drift                                      u = joint acceleration
    C      = n^T J(q)                                         J: Jacobian of the robot's nearest point
    drift  = n . (J_dot dq - a_h) + (|w_dot|^2 - d_dot^2 - b^T A^-1 b) / D

b^T A^-1 b is the witness slip: the nearest points move along the segments. With F(t) = min over (s, t) of |w|^2 / 2 the
envelope theorem gives F'' = |w_dot|^2 + w . w_ddot - b^T A^-1 b, with A the Hessian of |w|^2 / 2 and b its mixed
derivative, both over those of (s, t) that are inside their segment. Leaving the term out over-estimates d_ddot by
20-30 m/s2 at the 99th percentile, on the unsafe side (facts: safe control 4.1, real-time Python 6).

The realizable set of d_ddot under u in U is an interval, and the one-sided radius
    M = drift - a_h_max + max over U of C u
is what an index that only ever asks for *more* separation needs (errata 1, 3, 4 of the paper: the zero-centred ball
shrinks for nothing when the drift helps, and is negative in up to 9 % of the states of an acceleration-limited arm).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from asc_rt.core.kinematics import Chain, Motion, Three, cross, dot, forward, plus, rotated
from asc_rt.core.robot_model import Capsules
from asc_rt.core.types import IntVector, Vector

# ASSUMED: below this the direction of separation is numerical noise; the pair counts as touching.
MIN_AXIS_DISTANCE = 1e-6
ROUNDING = 1e-9  # m, of a distance within 1e5 m


class People(NamedTuple):
    """k human capsules, predicted to the moment of interest and grown by their bounds."""

    p0: np.ndarray  # (k, 3) m
    p1: np.ndarray  # (k, 3) m
    v0: np.ndarray  # (k, 3) m/s
    v1: np.ndarray  # (k, 3) m/s
    radius: np.ndarray  # (k,) m, position bound included
    velocity_bound: np.ndarray  # (k,) m/s


class Separation(NamedTuple):
    """p pairs."""

    robot: np.ndarray  # (p,) robot capsule
    human: np.ndarray  # (p,) human capsule
    d: np.ndarray  # (p,) m
    d_dot: np.ndarray  # (p,) m/s, least within the velocity bound
    C: np.ndarray  # (p, n) m
    drift: np.ndarray  # (p,) m/s2, least within the bound on the person's acceleration
    d_dot_robot: np.ndarray  # (p,) m/s, of the robot's own motion, as if the person stood still
    drift_robot: np.ndarray  # (p,) m/s2, likewise


@njit(cache=True)
def nearest(p0: Three, p1: Three, q0: Three, q1: Three) -> tuple[float, float]:
    """Parameters (s, t) in [0, 1] of the nearest points of two segments; a segment may be a point."""
    a = e = b = c = f = 0.0
    for k in range(3):
        u, v, r = p1[k] - p0[k], q1[k] - q0[k], p0[k] - q0[k]
        a += u * u
        e += v * v
        b += u * v
        c += u * r
        f += v * r
    tiny = 1e-12
    if a <= tiny:
        return 0.0, min(1.0, max(0.0, f / e)) if e > tiny else 0.0
    if e <= tiny:
        return min(1.0, max(0.0, -c / a)), 0.0
    det = a * e - b * b
    s = min(1.0, max(0.0, (b * f - c * e) / det)) if det > 1e-9 * a * e else 0.0
    t = (b * s + f) / e
    if t < 0.0:
        t, s = 0.0, min(1.0, max(0.0, -c / a))
    elif t > 1.0:
        t, s = 1.0, min(1.0, max(0.0, (b - c) / a))
    return s, t


@njit(cache=True)
def _slip(s: float, t: float, w: Three, rate: Three, e_r: Three, e_h: Three, de_r: Three, de_h: Three) -> float:
    """b^T A^-1 b over the free parameters; de_r, de_h: rates of e_r, e_h."""
    b_s = dot(e_r, rate) + dot(w, de_r)
    b_t = -dot(e_h, rate) - dot(w, de_h)
    rr, hh, rh = dot(e_r, e_r), dot(e_h, e_h), dot(e_r, e_h)
    s_free = 0.0 < s < 1.0 and rr > 1e-12
    t_free = 0.0 < t < 1.0 and hh > 1e-12
    det = rr * hh - rh * rh
    if s_free and t_free and det > 1e-4 * rr * hh:
        return (hh * b_s * b_s + 2.0 * rh * b_s * b_t + rr * b_t * b_t) / det
    # Parallel segments slide past each other without limit; each one alone bounds the slip of the distance there is.
    along_s = b_s * b_s / rr if s_free else 0.0
    along_t = b_t * b_t / hh if t_free else 0.0
    return max(along_s, along_t)


@njit(cache=True)
def place(motion: Motion, joint: int, local: Three) -> tuple[float, float, float]:
    """World position of a point fixed to the link of `joint`; -1: to the base."""
    if joint < 0:
        return local[0], local[1], local[2]
    return plus(motion.origin[joint], 1.0, rotated(motion.rotation[joint], local))


@njit(cache=True)
def pair(
    motion: Motion,
    joint: int,
    r0: Three,
    r1: Three,
    people: People,
    h: int,
    human_acceleration: float,
    C: Vector,
) -> tuple[float, float, float, float]:
    """(d_dot, drift, d_dot_robot, drift_robot) of one pair; C is filled in. World end points r0, r1 of the robot's."""
    h0, h1 = people.p0[h], people.p1[h]
    v0 = people.v0[h]
    s, t = nearest(r0, r1, h0, h1)
    e_r, e_h, de_h = plus(r1, -1.0, r0), plus(h1, -1.0, h0), plus(people.v1[h], -1.0, v0)
    point = plus(r0, s, e_r)
    w = plus(plus(point, -1.0, h0), -t, e_h)
    D = max(np.sqrt(dot(w, w)), MIN_AXIS_DISTANCE)
    v_r = bias = de_r = (0.0, 0.0, 0.0)
    if joint >= 0:
        omega = motion.omega[joint]
        arm = plus(point, -1.0, motion.origin[joint])
        turn = cross(omega, arm)
        v_r = plus(motion.velocity[joint], 1.0, turn)
        bias = plus(motion.acceleration[joint], 1.0, cross(motion.alpha[joint], arm))
        bias = plus(bias, 1.0, cross(omega, turn))
        de_r = cross(omega, e_r)
    for i in range(C.shape[0]):
        C[i] = dot(w, cross(motion.axis[i], plus(point, -1.0, motion.origin[i]))) / D if i <= joint else 0.0
    rate = plus(plus(v_r, -1.0, v0), -t, de_h)
    d_dot, d_dot_robot, along = dot(w, rate) / D, dot(w, v_r) / D, dot(w, bias) / D
    slip = _slip(s, t, w, rate, e_r, e_h, de_r, de_h)
    slip_robot = _slip(s, t, w, v_r, e_r, e_h, de_r, (0.0, 0.0, 0.0))
    drift = along + (dot(rate, rate) - d_dot * d_dot - slip) / D - human_acceleration
    drift_robot = along + (dot(v_r, v_r) - d_dot_robot * d_dot_robot - slip_robot) / D
    return d_dot - people.velocity_bound[h], drift, d_dot_robot, drift_robot


@njit(cache=True)
def distance(r0: Three, r1: Three, radius: float, people: People, h: int) -> float:
    """d of one pair, m."""
    h0, h1 = people.p0[h], people.p1[h]
    s, t = nearest(r0, r1, h0, h1)
    w = plus(plus(r0, s, plus(r1, -1.0, r0)), -1.0, plus(h0, t, plus(h1, -1.0, h0)))
    d: float = max(np.sqrt(dot(w, w)), MIN_AXIS_DISTANCE) - radius - people.radius[h]
    return d


@njit(cache=True)
def _at_least(r0: Three, r1: Three, radius: float, people: People, h: int) -> float:
    """A lower bound on `distance` at a fraction of its cost, m: the spheres around both capsules."""
    h0, h1 = people.p0[h], people.p1[h]
    apart = plus(plus(r0, 1.0, r1), -1.0, plus(h0, 1.0, h1))
    e_r, e_h = plus(r1, -1.0, r0), plus(h1, -1.0, h0)
    halves = np.sqrt(dot(e_r, e_r)) + np.sqrt(dot(e_h, e_h))
    least: float = 0.5 * (np.sqrt(dot(apart, apart)) - halves) - radius - people.radius[h] - ROUNDING
    return least


@njit(cache=True)
def least_distance(chain: Chain, capsules: Capsules, people: People, q: Vector) -> float:
    """Smallest d of all pairs of a moving robot capsule and a human capsule, m; inf without a pair, nan if one is."""
    motion = forward(chain, q, np.zeros(q.shape[0]))
    least = np.inf
    for i in range(capsules.joint.shape[0]):
        joint = capsules.joint[i]
        if joint < 0:
            continue
        r0, r1 = place(motion, joint, capsules.p0[i]), place(motion, joint, capsules.p1[i])
        for h in range(people.p0.shape[0]):
            if _at_least(r0, r1, capsules.radius[i], people, h) > least:
                continue
            d = distance(r0, r1, capsules.radius[i], people, h)
            if np.isnan(d):
                return np.nan
            least = min(least, d)
    return least


@njit(cache=True)
def separation_at(
    motion: Motion, capsules: Capsules, people: People, reach: float, human_acceleration: float
) -> Separation:
    """All pairs of a *moving* robot capsule and a human capsule nearer than `reach`. What no joint moves has no row.

    Distances come first: a pair out of reach costs no more than its distance. In the order of the capsules.
    """
    m, h_count, n = capsules.joint.shape[0], people.p0.shape[0], motion.origin.shape[0]
    robot, human = np.empty(m * h_count, np.int64), np.empty(m * h_count, np.int64)
    d = np.empty(m * h_count)
    count = 0
    for i in range(m):
        joint = capsules.joint[i]
        if joint < 0:
            continue
        r0, r1 = place(motion, joint, capsules.p0[i]), place(motion, joint, capsules.p1[i])
        for h in range(h_count):
            if _at_least(r0, r1, capsules.radius[i], people, h) >= reach:
                continue
            d[count] = distance(r0, r1, capsules.radius[i], people, h)
            if d[count] >= reach:
                continue  # not so for a distance that is not a number: that one is near
            robot[count], human[count] = i, h
            count += 1
    values, C = np.empty((4, count)), np.empty((count, n))
    for p in range(count):
        i = robot[p]
        joint = capsules.joint[i]
        r0, r1 = place(motion, joint, capsules.p0[i]), place(motion, joint, capsules.p1[i])
        d_dot, drift, d_dot_robot, drift_robot = pair(motion, joint, r0, r1, people, human[p], human_acceleration, C[p])
        values[0, p], values[1, p], values[2, p], values[3, p] = d_dot, drift, d_dot_robot, drift_robot
    return Separation(robot[:count], human[:count], d[:count], values[0], C, values[1], values[2], values[3])


@njit(cache=True)
def separation(
    chain: Chain,
    capsules: Capsules,
    people: People,
    q: Vector,
    dq: Vector,
    reach: float,
    human_acceleration: float,
) -> Separation:
    """`separation_at` of a state (q, dq)."""
    return separation_at(forward(chain, q, dq), capsules, people, reach, human_acceleration)


@njit(cache=True)
def nearest_first(found: Separation) -> Separation:
    """The pairs in the order of their distance, equal ones as they came; not-a-numbers last."""
    return picked(found, np.argsort(found.d, kind="mergesort"))


@njit(cache=True)
def picked(found: Separation, order: IntVector) -> Separation:
    """These of the pairs."""
    return Separation(
        found.robot[order],
        found.human[order],
        found.d[order],
        found.d_dot[order],
        found.C[order],
        found.drift[order],
        found.d_dot_robot[order],
        found.drift_robot[order],
    )
