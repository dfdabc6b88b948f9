"""The safety index phi = max(phi0, phi*) and the row it puts on the control.

    phi0 = d_min - d
    phi* = d_min^2 - d|d| + k v / M          v = -d_dot: worst-case approach speed; M: one-sided radius

(the paper's phi*, written with v; d|d| keeps the order when the bounded surfaces overlap). On phi* = 0 keeping phi*
<= 0 takes a separation acceleration of 2 d v M / k - v M_dot / M, which is at most M if k >= 2 d v + |d_min^2 - d^2|
(-M_dot) / M.

A position-streaming arm is a third-order system: it cannot brake at once, it first has to ramp its acceleration down
at its jerk limit. phi is therefore asked for over *the whole stop*, not now:

    psi(z) = largest phi on the hardest brake from z = (d, v, a), a = -d_ddot: a falls with jerk J to -B and stays there
             until the approach is over

and the row keeps psi <= 0 after the coming period. psi rises with v, with a and with -d, since a brake that starts
nearer or faster stays nearer and faster throughout; so the row is one number per pair, found by bisection: the least
separation acceleration. The brake is itself a control that keeps psi where it is: that is what makes the row
persistently feasible while M and J last, for every k > 0. (phi at the end of the ramp only, with the braking that
phi* = 0 asks for *now*, is not enough: the speed still grows on the ramp; an abstract system with M = J / (1/s) came to
0.08 d_min.) psi > 0 (a person comes faster than the robot alone can make good) has to fall by the share eta T each
period, and not by M rising: that is no doing of the robot's.

No row asks for more than the smallest of three (`Basis` says which):
    INDEX       what psi asks for
    STANDSTILL  that the robot's own approach, ramps included, ends: a robot that does not approach is safe however fast
                the person comes (ISO 10218-2, speed and separation monitoring); retreating is never slowed. Inside
                d_min the index asks for no less than this.
    RAMP        the ramp itself: the share JERK_SHARE of what the joint bounds of this period leave, up to BRAKE_SHARE M
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from asc_rt.core.abstraction import Separation
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

SHARPNESS = 28  # bisections of a row: 1e-6 m/s2 of 200, and the safe end is taken
SEARCHES, POLISHES = 5, 2  # steps to the largest phi of a brake; smooth there: within 1e-5 of it

INDEX, STANDSTILL, RAMP, M_FLOOR = (int(b) for b in (Basis.INDEX, Basis.STANDSTILL, Basis.RAMP, Basis.M_FLOOR))


@njit(cache=True)
def phi_star(d: float, v: float, M: float, d_min: float, k: float) -> float:
    return d_min * d_min - d * abs(d) + k * v / M


@njit(cache=True)
def phi(d: float, v: float, M: float, d_min: float, k: float) -> float:
    return max(d_min - d, phi_star(d, v, M, d_min, k))


@njit(cache=True)
def _braking(t: float, d: float, v: float, a: float, B: float, J: float) -> tuple[float, float, float]:
    """(d, v, a) after t seconds of the hardest brake: a falls with jerk J to -B and stays there."""
    ramp = min(t, (a + B) / J)
    v_ramp = v + a * ramp - J * ramp * ramp / 2.0
    rest = t - ramp
    way = v * ramp + a * ramp * ramp / 2.0 - J * ramp * ramp * ramp / 6.0 + v_ramp * rest - B * rest * rest / 2.0
    return d - way, v_ramp - B * rest, a - J * ramp


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
    """Largest phi on the hardest brake from (d, v, a); see above. M is taken as it will be at the end of the ramp."""
    now = phi(d, v, max(M_floor, M), d_min, k)
    square = a * a + 2.0 * J * v
    if v < 0.0:  # retreating: the approach begins, if ever, where v = 0
        if a <= 0.0 or square <= 0.0:
            return now
        d = _braking((a - math.sqrt(square)) / J, d, v, a, 0.0, J)[0]
        v, a = 0.0, math.sqrt(square)
    M = max(M_floor, M + min(0.0, M_dot) * max(0.0, a + BRAKE_SHARE * M) / J)
    B = max(BRAKE_SHARE * M, -a)
    ramp = (a + B) / J
    v_ramp = _braking(ramp, d, v, a, B, J)[1]
    end = ramp + v_ramp / B if v_ramp > 0.0 else (a + math.sqrt(a * a + 2.0 * J * v)) / J
    # phi* rises as long as 2 d v + k a / M > 0, which ends once, on the ramp or after it: bisection, then Newton. On a
    # brake that ends behind the surface (d < 0) phi0 takes over.
    corner = min(ramp, end)
    d_t, v_t, a_t = _braking(corner, d, v, a, B, J)
    after = 2.0 * max(d_t, 0.0) * v_t + k * a_t / M > 0.0
    early, late = (corner, end) if after else (0.0, corner)
    t = 0.5 * (early + late)
    for i in range(SEARCHES + POLISHES):
        d_t, v_t, a_t = _braking(t, d, v, a, B, J)
        slope = 2.0 * max(d_t, 0.0) * v_t + k * a_t / M
        curve = (2.0 * (d_t * a_t - v_t * v_t) if d_t > 0.0 else 0.0) - (0.0 if after else k * J / M)
        if slope > 0.0:
            early = t
        else:
            late = t
        newton = i >= SEARCHES and curve < 0.0
        t = min(late, max(early, t - slope / curve)) if newton else 0.5 * (early + late)
    d_t, v_t, _ = _braking(t, d, v, a, B, J)
    return max(now, phi_star(max(d_t, 0.0), v_t, M, d_min, k), d_min - _braking(end, d, v, a, B, J)[0])


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
        M + T * min(0.0, M_dot),
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
    most: float,
) -> float:
    """Greatest approach acceleration after the coming period that keeps the row, m/s2; `most`: all there can be."""
    target = max(0.0, psi(d, v, a, M, M_dot, J, d_min, k, M_floor) * (1.0 - eta * T))
    low, high = -4.0 * M - abs(a) - 10.0, most
    if _psi_after(high, d, v, a, T, M, M_dot, J, d_min, k, M_floor) <= target:
        return high
    if _psi_after(low, d, v, a, T, M, M_dot, J, d_min, k, M_floor) > target:
        return low
    for _ in range(SHARPNESS):
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
        along = J = most = least = 0.0
        for j in range(ddq.shape[0]):
            along += pairs.C[i, j] * ddq[j]
            most += max(pairs.C[i, j] * lower[j], pairs.C[i, j] * upper[j])
            least += min(pairs.C[i, j] * lower[j], pairs.C[i, j] * upper[j])
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
        most_approach = -(least + pairs.drift[i])
        index = (
            -greatest_approach(d, v, a, T, M[i], M_dot[i], J, d_min, k, eta, M_floor, most_approach) - pairs.drift[i]
        )
        if d < d_min:  # not even towards a person who gives way
            index = max(index, standstill)
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
