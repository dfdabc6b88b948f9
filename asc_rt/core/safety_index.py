"""The safety index phi = max(phi0, phi*) and the row it puts on the control.

    phi0 = d_min - d
    phi* = d_min^2 - d|d| + k v / M          v = -d_dot: worst-case approach speed; M: one-sided radius

(the paper's phi*, written with v; d|d| keeps the order when the bounded surfaces overlap). On phi* = 0 keeping phi*
<= 0 takes a separation acceleration of 2 d v M / k - v M_dot / M, which is at most M if k >= 2 d v + |d_min^2 - d^2|
(-M_dot) / M.

A position-streaming arm is a third-order system: it cannot brake at once, it first has to ramp its acceleration down at
its jerk limit. phi is therefore asked for at the *end of that ramp*, not now:

    psi(z) = phi at the end of the ramp that starts in z = (d, v, a), a = -d_ddot, and falls with jerk J until the
    braking
             that phi* = 0 asks for there is reached (or the approach is over)

and the row keeps psi <= 0 after the coming period. psi rises with the acceleration that is commanded, so the row is one
number per pair, found by bisection: the least separation acceleration. If psi(z) <= 0 now, the ramp itself is a control
that keeps the row next time: that is what makes it persistently feasible while M and J last. psi > 0 (a person comes
faster than the robot alone can make good) has to fall by the share eta T each period.

No row asks for more than the smallest of three (`Basis` says which):
    INDEX       what psi asks for
    STANDSTILL  that the robot's own approach, ramps included, ends: a robot that does not approach is safe however fast
                the person comes (ISO 10218-2, speed and separation monitoring); retreating is never slowed
    RAMP        the ramp itself: the share JERK_SHARE of what the joint bounds of this period leave, up to BRAKE_SHARE M
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from asc_rt.core.abstraction import Separation
from asc_rt.core.limits import BISECTIONS
from asc_rt.core.types import Basis, IntVector, Vector

# ASSUMED: share of a pair's jerk (sum of |C_i| dddq_max_i) that the index counts on. The rest serves the other rows
# and the change of C and drift during the ramp, which the index takes as constant.
JERK_SHARE = 0.6
# ASSUMED: same for the ramp's end, where all of M would have to come from every joint at once.
BRAKE_SHARE = 0.8

# ASSUMED: m/s2. The ramp is asked for with this much less, so that a pair whose joints are all at their bounds has a
# solution.
SLACKEN = 1e-3
# ASSUMED: m/s. A robot slower than this stands still: the bound that lets u = 0 keep every row at rest, strictly.
# Well under what counts as approaching when runs are judged (10 mm/s). It fades out towards d_min (1/s), or the robot
# would creep through d_min into a person who stands still; what is left is 4 mm in an hour.
STANDSTILL_SPEED = 0.002
STANDSTILL_FADE = 0.5
STANDSTILL_LEAST = 1e-6
# m/s3: a pair that the control moves with less jerk than this it does not move at all.
NO_JERK = 1e-6

# m/s2: a floor that every control keeps; finite, so that arithmetic with floors is.
NO_ROW = -1e6

INDEX, STANDSTILL, RAMP, M_FLOOR = (int(b) for b in (Basis.INDEX, Basis.STANDSTILL, Basis.RAMP, Basis.M_FLOOR))


@njit(cache=True)
def phi_star(d: float, v: float, M: float, d_min: float, k: float) -> float:
    return d_min * d_min - d * abs(d) + k * v / M


@njit(cache=True)
def phi(d: float, v: float, M: float, d_min: float, k: float) -> float:
    return max(d_min - d, phi_star(d, v, M, d_min, k))


@njit(cache=True)
def psi(
    d: float,
    v: float,
    a: float,
    M: float,
    M_dot: float,
    J: float,
    d_min: float,
    k: float,
    M_floor: float,
) -> float:
    """phi at the end of the ramp from (d, v, a); see above."""
    brake = min(BRAKE_SHARE * M, 2.0 * max(d, 0.0) * max(v, 0.0) * M / k)
    t = max(0.0, (a + brake) / J)
    # the approach may be over before: first zero of v + a t - J t^2 / 2
    if v <= 0.0 and a <= 0.0:
        t = 0.0
    elif v + a * t - J * t * t / 2.0 < 0.0:
        t = (a + math.sqrt(max(0.0, a * a + 2.0 * J * v))) / J
    d_end = d - (v * t + a * t * t / 2.0 - J * t * t * t / 6.0)
    v_end = v + a * t - J * t * t / 2.0
    M_end = max(M_floor, M + min(0.0, M_dot) * t)
    return phi(d_end, v_end, M_end, d_min, k)


@njit(cache=True)
def _psi_after(
    u: float,
    d: float,
    v: float,
    a: float,
    T: float,
    M: float,
    M_dot: float,
    J: float,
    d_min: float,
    k: float,
    M_floor: float,
) -> float:
    """psi one period later if the approach acceleration goes from a to u."""
    return psi(
        d - T * v - T * T * (2.0 * a + u) / 6.0,
        v + T * (a + u) / 2.0,
        u,
        M + T * M_dot,
        M_dot,
        J,
        d_min,
        k,
        M_floor,
    )


@njit(cache=True)
def greatest_approach(
    d: float,
    v: float,
    a: float,
    T: float,
    M: float,
    M_dot: float,
    J: float,
    d_min: float,
    k: float,
    eta: float,
    M_floor: float,
) -> float:
    """Greatest approach acceleration after the coming period that keeps the row, m/s2."""
    target = max(0.0, psi(d, v, a, M, M_dot, J, d_min, k, M_floor) * (1.0 - eta * T))
    low, high = -4.0 * M - abs(a) - 10.0, M + abs(a) + 100.0
    if _psi_after(high, d, v, a, T, M, M_dot, J, d_min, k, M_floor) <= target:
        return high
    if _psi_after(low, d, v, a, T, M, M_dot, J, d_min, k, M_floor) > target:
        return low
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        if _psi_after(middle, d, v, a, T, M, M_dot, J, d_min, k, M_floor) <= target:
            low = middle
        else:
            high = middle
    return low


@njit(cache=True)
def approach_ending(v: float, a: float, T: float, J: float) -> float:
    """Greatest approach acceleration u with which the approach is over once u has been ramped away, m/s2.

    Speed after the period and the ramp: v + T (a + u) / 2 + u |u| / (2 J) = 0, solved for u.
    """
    s = v + T * a / 2.0
    half = J * T / 2.0
    if s <= 0.0:
        return -half + math.sqrt(half * half - 2.0 * J * s)
    return half - math.sqrt(half * half + 2.0 * J * s)


@njit(cache=True)
def row_floors(
    pairs: Separation,
    M: Vector,
    M_dot: Vector,
    ddq: Vector,
    dddq_max: Vector,
    lower: Vector,
    upper: Vector,
    T: float,
    d_min: float,
    k: float,
    eta: float,
    M_floor: float,
    brake_time: float,
) -> tuple[Vector, Vector, Vector, IntVector]:
    """(phi, floor, base, Basis) of every pair: the row is C u >= floor; base: see safe_control.

    lower, upper: the joint bounds of this period.

    M under its floor: phi* is not defined, the control hardly reaches this direction and the link hardly moves along it
    (Basis M_FLOOR). Then the pair has no row as long as the joint-space brake (`brake_time`, s) is over before the
    approach has used up the distance; nearer, the approach has to end.
    """
    p = M.shape[0]
    value, floor, base, basis = np.empty(p), np.empty(p), np.empty(p), np.empty(p, np.int64)
    for i in range(p):
        along = J = most = 0.0
        for j in range(ddq.shape[0]):
            along += pairs.C[i, j] * ddq[j]
            most += max(pairs.C[i, j] * lower[j], pairs.C[i, j] * upper[j])
            J += JERK_SHARE * abs(pairs.C[i, j]) * dddq_max[j]
        within = (along + JERK_SHARE * (most - along) if most > along else most) - SLACKEN
        d, v, v_robot = pairs.d[i], -pairs.d_dot[i], -pairs.d_dot_robot[i]
        value[i] = phi(d, v, max(M[i], M_floor), d_min, k)
        creep = min(STANDSTILL_SPEED, max(STANDSTILL_LEAST, STANDSTILL_FADE * (d - d_min)))
        standstill = -approach_ending(v_robot - creep, -(along + pairs.drift_robot[i]), T, J) - pairs.drift_robot[i]
        if M[i] <= M_floor or J <= NO_JERK:
            basis[i] = M_FLOOR
            near = d - d_min < max(v, v_robot) * brake_time
            floor[i] = min(standstill, within) if near else NO_ROW
            base[i] = min(floor[i], along - SLACKEN)
            continue
        a = -(along + pairs.drift[i])
        index = -greatest_approach(d, v, a, T, M[i], M_dot[i], J, d_min, k, eta, M_floor) - pairs.drift[i]
        ramp = min(within, BRAKE_SHARE * M[i] - pairs.drift[i])
        floor[i], basis[i] = index, INDEX
        if standstill < floor[i]:
            floor[i], basis[i] = standstill, STANDSTILL
        if ramp < floor[i]:
            floor[i], basis[i] = ramp, RAMP
        base[i] = min(floor[i], along - SLACKEN) if basis[i] == RAMP else floor[i]
    return value, floor, base, basis


@njit(cache=True)
def phi_rate(
    pairs: Separation,
    M: Vector,
    M_dot: Vector,
    achieved: Vector,
    d_min: float,
    k: float,
) -> Vector:
    """phi_dot under the control that is sent, C u = achieved: the derivative of whichever of phi0, phi* is larger."""
    rate = np.empty(M.shape[0])
    for i in range(M.shape[0]):
        d, d_dot = pairs.d[i], pairs.d_dot[i]
        rate[i] = -d_dot
        if M[i] > 0.0 and phi_star(d, -d_dot, M[i], d_min, k) > d_min - d:
            d_ddot = achieved[i] + pairs.drift[i]
            rate[i] = -2.0 * abs(d) * d_dot - k * d_ddot / M[i] + k * d_dot * M_dot[i] / (M[i] * M[i])
    return rate
