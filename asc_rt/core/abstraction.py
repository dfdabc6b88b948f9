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

from asc_rt.core.kinematics import Chain, Motion, cross, forward
from asc_rt.core.polytope import greatest
from asc_rt.core.realizable import control_set
from asc_rt.core.robot_model import Arm, Capsules
from asc_rt.core.types import Vector

# ASSUMED: below this the direction of separation is numerical noise; the pair counts as touching.
MIN_AXIS_DISTANCE = 1e-6
# ASSUMED: difference step for M_dot, s. Central difference: error O(step^2); checked against a ten times larger step.
DIFFERENCE_STEP = 1e-5
# ASSUMED: m/s3. A steeper one-sided difference is no slope but a jump of M (a nearest point arriving at a segment's end
# switches its slip term): it is in M itself from the next cycle on, and as a slope it would only stop the robot for
# nothing.
JUMP = 1e4


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
def _nearest(p0: Vector, p1: Vector, q0: Vector, q1: Vector) -> tuple[float, float]:
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
def _slip(
    s: float,
    t: float,
    w: Vector,
    rate: Vector,
    e_r: Vector,
    e_h: Vector,
    w_r: Vector,
    de_h: Vector,
) -> float:
    """b^T A^-1 b over the free parameters; w_r: angular velocity of the robot capsule, de_h: rate of e_h."""
    de_r = cross(w_r, e_r)
    b_s = b_t = rr = hh = rh = 0.0
    for k in range(3):
        b_s += e_r[k] * rate[k] + w[k] * de_r[k]
        b_t -= e_h[k] * rate[k] + w[k] * de_h[k]
        rr += e_r[k] * e_r[k]
        hh += e_h[k] * e_h[k]
        rh += e_r[k] * e_h[k]
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
def _place(motion: Motion, joint: int, local: Vector, out: Vector) -> None:
    for k in range(3):
        if joint < 0:
            out[k] = local[k]
        else:
            rotation = motion.rotation[joint]
            out[k] = (
                motion.origin[joint, k]
                + rotation[k, 0] * local[0]
                + rotation[k, 1] * local[1]
                + rotation[k, 2] * local[2]
            )


@njit(cache=True)
def _pair(
    motion: Motion,
    joint: int,
    r0: Vector,
    r1: Vector,
    radius: float,
    people: People,
    h: int,
    human_acceleration: float,
    C: Vector,
) -> tuple[float, float, float, float, float]:
    """(d, d_dot, drift, d_dot_robot, drift_robot) of one pair; C is filled in. World end points r0, r1 of the
    robot's."""
    h0, h1 = people.p0[h], people.p1[h]
    s, t = _nearest(r0, r1, h0, h1)
    w, e_r, e_h, de_h = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    v_r, v_h, bias, omega = np.zeros(3), np.empty(3), np.zeros(3), np.zeros(3)
    point = np.empty(3)
    squared = 0.0
    for k in range(3):
        e_r[k], e_h[k] = r1[k] - r0[k], h1[k] - h0[k]
        de_h[k] = people.v1[h, k] - people.v0[h, k]
        point[k] = r0[k] + s * e_r[k]
        v_h[k] = people.v0[h, k] + t * de_h[k]
        w[k] = point[k] - h0[k] - t * e_h[k]
        squared += w[k] * w[k]
    D = max(np.sqrt(squared), MIN_AXIS_DISTANCE)
    if joint >= 0:
        arm = point - motion.origin[joint]
        omega = motion.omega[joint]
        wr = np.array(cross(omega, arm))
        wwr = cross(omega, wr)
        ar = cross(motion.alpha[joint], arm)
        for k in range(3):
            v_r[k] = motion.velocity[joint, k] + wr[k]
            bias[k] = motion.acceleration[joint, k] + ar[k] + wwr[k]
    for i in range(C.shape[0]):
        C[i] = 0.0
        if i <= joint:
            column = cross(motion.axis[i], point - motion.origin[i])
            C[i] = (w[0] * column[0] + w[1] * column[1] + w[2] * column[2]) / D
    rate = v_r - v_h
    d_dot = (w[0] * rate[0] + w[1] * rate[1] + w[2] * rate[2]) / D
    d_dot_robot = (w[0] * v_r[0] + w[1] * v_r[1] + w[2] * v_r[2]) / D
    along = (w[0] * bias[0] + w[1] * bias[1] + w[2] * bias[2]) / D
    square = rate[0] * rate[0] + rate[1] * rate[1] + rate[2] * rate[2]
    square_robot = v_r[0] * v_r[0] + v_r[1] * v_r[1] + v_r[2] * v_r[2]
    slip = _slip(s, t, w, rate, e_r, e_h, omega, de_h)
    slip_robot = _slip(s, t, w, v_r, e_r, e_h, omega, np.zeros(3))
    drift = along + (square - d_dot * d_dot - slip) / D - human_acceleration
    drift_robot = along + (square_robot - d_dot_robot * d_dot_robot - slip_robot) / D
    return (
        D - radius - people.radius[h],
        d_dot - people.velocity_bound[h],
        drift,
        d_dot_robot,
        drift_robot,
    )


@njit(cache=True)
def _distance(r0: Vector, r1: Vector, radius: float, people: People, h: int) -> float:
    """d of one pair alone, to the bit as `_pair` has it, m."""
    h0, h1 = people.p0[h], people.p1[h]
    s, t = _nearest(r0, r1, h0, h1)
    squared = 0.0
    for k in range(3):
        w = r0[k] + s * (r1[k] - r0[k]) - h0[k] - t * (h1[k] - h0[k])
        squared += w * w
    d: float = max(np.sqrt(squared), MIN_AXIS_DISTANCE) - radius - people.radius[h]
    return d


@njit(cache=True)
def least_distance(chain: Chain, capsules: Capsules, people: People, q: Vector) -> float:
    """Smallest d of all pairs of a moving robot capsule and a human capsule, m; inf without a pair, nan if one is."""
    motion = forward(chain, q, np.zeros(q.shape[0]))
    least, r0, r1 = np.inf, np.empty(3), np.empty(3)
    for i in range(capsules.joint.shape[0]):
        if capsules.joint[i] < 0:
            continue
        _place(motion, capsules.joint[i], capsules.p0[i], r0)
        _place(motion, capsules.joint[i], capsules.p1[i], r1)
        for h in range(people.p0.shape[0]):
            d = _distance(r0, r1, capsules.radius[i], people, h)
            if np.isnan(d):
                return np.nan
            least = min(least, d)
    return least


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
    """All pairs of a *moving* robot capsule and a human capsule nearer than `reach`. What no joint moves has no row."""
    motion = forward(chain, q, dq)
    m, h_count, n = capsules.joint.shape[0], people.p0.shape[0], q.shape[0]
    total = m * h_count
    robot, human = np.empty(total, np.int64), np.empty(total, np.int64)
    values = np.empty((5, total))
    C = np.empty((total, n))
    r0, r1 = np.empty(3), np.empty(3)
    count = 0
    for i in range(m):
        joint = capsules.joint[i]
        if joint < 0:
            continue
        _place(motion, joint, capsules.p0[i], r0)
        _place(motion, joint, capsules.p1[i], r1)
        for h in range(h_count):
            if _distance(r0, r1, capsules.radius[i], people, h) >= reach:
                continue  # not so for a distance that is not a number: that one is near
            d, d_dot, drift, d_dot_robot, drift_robot = _pair(
                motion,
                joint,
                r0,
                r1,
                capsules.radius[i],
                people,
                h,
                human_acceleration,
                C[count],
            )
            robot[count], human[count] = i, h
            values[0, count], values[1, count], values[2, count] = d, d_dot, drift
            values[3, count], values[4, count] = d_dot_robot, drift_robot
            count += 1
    return Separation(
        robot[:count],
        human[:count],
        values[0, :count],
        values[1, :count],
        C[:count],
        values[2, :count],
        values[3, :count],
        values[4, :count],
    )


@njit(cache=True)
def _radii_at(
    arm: Arm,
    people: People,
    q: Vector,
    dq: Vector,
    ddq: Vector,
    human_acceleration: float,
    pairs: Separation,
    shift: float,
) -> Vector:
    """M of the given pairs at the state `shift` seconds along (dq, ddq) and the people's velocities."""
    q_s, dq_s = q + shift * dq, dq + shift * ddq
    moved = People(
        people.p0 + shift * people.v0,
        people.p1 + shift * people.v1,
        people.v0,
        people.v1,
        people.radius,
        people.velocity_bound,
    )
    motion = forward(arm.chain, q_s, dq_s)
    U = control_set(arm, motion, q_s, dq_s)
    out = np.empty(pairs.d.shape[0])
    C, r0, r1 = np.empty(q.shape[0]), np.empty(3), np.empty(3)
    for i in range(out.shape[0]):
        c = pairs.robot[i]
        joint = arm.capsules.joint[c]
        _place(motion, joint, arm.capsules.p0[c], r0)
        _place(motion, joint, arm.capsules.p1[c], r1)
        drift = _pair(motion, joint, r0, r1, arm.capsules.radius[c], moved, pairs.human[i], human_acceleration, C)[2]
        out[i] = drift + greatest(C, U)
    return out


@njit(cache=True)
def radii(
    arm: Arm, people: People, q: Vector, dq: Vector, ddq: Vector, human_acceleration: float, pairs: Separation
) -> tuple[Vector, Vector]:
    """M and M_dot = dM/dx . x_dot of every pair, x = (q, dq, people), x_dot = (dq, ddq, people's velocities).

    M has kinks (a C_i changes sign, a joint enters its braking zone, a nearest point reaches a segment's end), so the
    difference is numeric and two-sided; of its left and right halves the smaller one counts: M falling is what harms.
    """
    h = DIFFERENCE_STEP
    here = _radii_at(arm, people, q, dq, ddq, human_acceleration, pairs, 0.0)
    ahead = _radii_at(arm, people, q, dq, ddq, human_acceleration, pairs, h)
    behind = _radii_at(arm, people, q, dq, ddq, human_acceleration, pairs, -h)
    slope = np.empty(here.shape[0])
    for i in range(here.shape[0]):
        right, left = (ahead[i] - here[i]) / h, (here[i] - behind[i]) / h
        if abs(right) > JUMP:
            right = left
        if abs(left) > JUMP:
            left = right
        slope[i] = min(left, right) if abs(left) <= JUMP else 0.0
    return here, slope
