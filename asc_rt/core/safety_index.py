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
                d_min, and near a person faster than the certificate's v_max, the index asks for no less than this.
    RAMP        the ramp itself: the share JERK_SHARE of what the joint bounds of this period leave, up to BRAKE_SHARE M

Most pairs are far away: no control of the period can break their row (FREE), which is known without M.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from asc_rt.core.abstraction import Separation
from asc_rt.core.params import SafetyParams
from asc_rt.core.types import Basis, BoolVector, IntVector, Outside, Vector

# ASSUMED: share of a pair's jerk (sum of |C_i| dddq_max_i) that the index counts on. The rest serves the other rows
# and the change of C and drift during the ramp, which the index takes as constant.
JERK_SHARE = 0.6
# ASSUMED: same for the ramp's end, where all of M would have to come from every joint at once.
BRAKE_SHARE = 0.8

# ASSUMED: m/s2. The ramp is asked for with this much less, so that a pair whose joints are all at their bounds has a
# solution.
SLACKEN = 1e-3
# ASSUMED: what rows give way where they conflict, see `_base`. With neither, people beside the arm at 3 m/s2 of assumed
# acceleration stopped it in 2 of 6 visits by a conflict of 1 to 6 mm/s2.
WEAKEN, STANDSTILL_BASE = 0.1, 0.5
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

# A row is searched for until it is known to SHARPNESS, m/s2, or psi is that CLOSE to its target; the safe end is taken.
SHARPNESS, CLOSE, SEARCH_MOST = 1e-6, 1e-10, 60
SEARCHES, POLISHES = 5, 2  # steps to the largest phi of a brake; smooth there: within 1e-5 of it

INDEX, STANDSTILL, RAMP, M_FLOOR, FREE = (int(b) for b in Basis)
OUTSIDE_DISTANCE, OUTSIDE_SPEED, OUTSIDE_RADIUS = (int(flag) for flag in Outside if flag)


PHI_STAR, PHI_B = 0, 1


class Index(NamedTuple):
    """Which index, its constants, and the approach speed up to which it is certified."""

    kind: int  # PHI_STAR or PHI_B
    d_min: float  # m
    k: float  # of phi*
    brake: float  # m/s2, of phi_b
    eta: float  # 1/s
    M_floor: float  # m/s2
    v_max: float  # m/s
    at_once: bool = False  # the control acts from the beginning of a period, as a torque does: see `limits`


def index_of(safety: SafetyParams, at_once: bool = False) -> Index:
    kind = {"phi-star": PHI_STAR, "phi-b": PHI_B}[safety.index]
    return Index(kind, safety.d_min, safety.k, safety.brake, safety.eta, safety.M_floor, safety.v_max, at_once)


@njit(cache=True)
def unpack(packed: Vector) -> Index:
    """An Index from its numbers in one array, which is how Python hands it to a kernel fastest."""
    x = packed
    return Index(int(x[0]), x[1], x[2], x[3], x[4], x[5], x[6], bool(x[7]))


@njit(cache=True)
def phi_star(d: float, v: float, M: float, d_min: float, k: float) -> float:
    return d_min * d_min - d * abs(d) + k * v / M


@njit(cache=True)
def phi_b(d: float, v: float, d_min: float, brake: float) -> float:
    return d_min - d + (v * v / (2.0 * brake) if v > 0.0 else 0.0)


@njit(cache=True)
def phi(d: float, v: float, M: float, index: Index) -> float:
    if index.kind == PHI_B:
        return phi_b(d, v, index.d_min, index.brake)
    return max(index.d_min - d, phi_star(d, v, M, index.d_min, index.k))


@njit(cache=True)
def _braking(t: float, d: float, v: float, a: float, B: float, J: float) -> tuple[float, float, float]:
    """(d, v, a) after t seconds of the hardest brake: a falls with jerk J to -B and stays there."""
    ramp = min(t, (a + B) / J)
    v_ramp = v + a * ramp - J * ramp * ramp / 2.0
    rest = t - ramp
    way = v * ramp + a * ramp * ramp / 2.0 - J * ramp * ramp * ramp / 6.0 + v_ramp * rest - B * rest * rest / 2.0
    return d - way, v_ramp - B * rest, a - J * ramp


@njit(cache=True)
def _peak(d: float, v: float, a: float, M: float, B: float, J: float, corner: float, end: float, index: Index) -> float:
    """Largest phi* on the brake; corner: where the ramp is over.

    phi* rises as long as 2 d v + k a / M > 0, which ends once, on the ramp or after it: bisection, then Newton. On a
    brake that ends behind the surface (d < 0) phi0 takes over.
    """
    k = index.k
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
    return phi_star(max(d_t, 0.0), v_t, M, index.d_min, k)


@njit(cache=True)
def psi(d: float, v: float, a: float, M: float, M_dot: float, J: float, index: Index) -> float:
    """Largest phi on the hardest brake from (d, v, a); see above. M is taken as it will be at the end of the ramp."""
    now = phi(d, v, max(index.M_floor, M), index)
    square = a * a + 2.0 * J * v
    if v < 0.0:  # retreating: the approach begins, if ever, where v = 0
        if a <= 0.0 or square <= 0.0:
            return now
        d = _braking((a - math.sqrt(square)) / J, d, v, a, 0.0, J)[0]
        v, a = 0.0, math.sqrt(square)
    if index.kind == PHI_STAR:
        M = M + min(0.0, M_dot) * max(0.0, a + BRAKE_SHARE * M) / J
    M = max(index.M_floor, M)
    B = max(BRAKE_SHARE * M if index.kind == PHI_STAR else min(index.brake, BRAKE_SHARE * M), -a)
    ramp = (a + B) / J
    v_ramp = _braking(ramp, d, v, a, B, J)[1]
    end = ramp + v_ramp / B if v_ramp > 0.0 else (a + math.sqrt(a * a + 2.0 * J * v)) / J
    least = index.d_min - _braking(end, d, v, a, B, J)[0]
    if index.kind == PHI_B:  # constant while braking at `brake`, and it rises before that: greatest where it ends
        return max(now, least)
    return max(now, least, _peak(d, v, a, M, B, J, min(ramp, end), end, index))


@njit(cache=True)
def _psi_after(
    u: float, d: float, v: float, a: float, T: float, M: float, M_dot: float, J: float, index: Index
) -> float:
    """psi one period later if the approach acceleration goes from a to u, or is u at once."""
    begin = u if index.at_once else a
    ahead = d - T * v - T * T * (2.0 * begin + u) / 6.0
    fall = T * min(0.0, M_dot) if index.kind == PHI_STAR else 0.0
    return psi(ahead, v + T * (begin + u) / 2.0, u, M + fall, M_dot, J, index)


@njit(cache=True)
def greatest_approach(
    d: float, v: float, a: float, T: float, M: float, M_dot: float, J: float, index: Index, most: float
) -> float:
    """Greatest approach acceleration after the coming period that keeps the row, m/s2; `most`: all there can be; inf:
    all of it keeps the row.

    For most pairs one psi tells. For the others a bracketed secant search (Illinois), which ends at its safe side.
    """
    over = _psi_after(most, d, v, a, T, M, M_dot, J, index)
    if over <= 0.0:
        return np.inf
    target = max(0.0, psi(d, v, a, M, M_dot, J, index) * (1.0 - index.eta * T))
    low, high = -4.0 * M - abs(a) - 10.0, most
    over -= target
    if over <= 0.0:
        return np.inf
    under = _psi_after(low, d, v, a, T, M, M_dot, J, index) - target
    if under > 0.0:
        return low
    weight_low, weight_high, last = under, over, 0
    for i in range(SEARCH_MOST):
        if high - low <= SHARPNESS or under >= -CLOSE:
            break
        share = weight_low / (weight_low - weight_high)
        middle = low + (share if i % 2 == 0 and 0.0 < share < 1.0 else 0.5) * (high - low)
        value = _psi_after(middle, d, v, a, T, M, M_dot, J, index) - target
        if value <= 0.0:
            low, under, weight_low = middle, value, value
            weight_high *= 0.5 if last < 0 else 1.0
            last = -1
        else:
            high, weight_high = middle, value
            weight_low *= 0.5 if last > 0 else 1.0
            last = 1
    return low


@njit(cache=True)
def approach_ending(v: float, a: float, T: float, J: float, at_once: bool = False) -> float:
    """Greatest approach acceleration u with which the approach is over once u has been ramped away, m/s2.

    Speed after the period and the ramp: v + T (a + u) / 2 + u |u| / (2 J) = 0, solved for u; where u acts at once,
    v + T u + u |u| / (2 J) = 0.
    """
    if at_once:
        a, T = 0.0, 2.0 * T
    s = v + T * a / 2.0
    half = J * T / 2.0
    if s <= 0.0:
        return -half + math.sqrt(half * half - 2.0 * J * s)
    return half - math.sqrt(half * half + 2.0 * J * s)


class Effect(NamedTuple):
    """What the control can do to one pair in the coming period, m/s2, and the jerk that the index counts on, m/s3."""

    along: float  # C ddq: of the commanded acceleration
    least: float  # of C u within the joint bounds of this period
    most: float
    jerk: float


@njit(cache=True)
def _effect(C: Vector, ddq: Vector, dddq_max: Vector, lower: Vector, upper: Vector) -> Effect:
    along = jerk = most = least = 0.0
    for j in range(ddq.shape[0]):
        along += C[j] * ddq[j]
        most += max(C[j] * lower[j], C[j] * upper[j])
        least += min(C[j] * lower[j], C[j] * upper[j])
        jerk += JERK_SHARE * abs(C[j]) * dddq_max[j]
    return Effect(along, least, most, jerk)


@njit(cache=True)
def _is_near(d: float, v: float, v_robot: float, index: Index, brake_time: float) -> bool:
    """The approach has used up the distance before the joint-space brake is over."""
    return d - index.d_min < max(v, v_robot) * brake_time


@njit(cache=True)
def free_pairs(
    pairs: Separation,
    ddq: Vector,
    dddq_max: Vector,
    lower: Vector,
    upper: Vector,
    T: float,
    index: Index,
    brake_time: float,
) -> BoolVector:
    """Pairs whose row no control of this period can break, whatever M is (Basis FREE): exact, and M is not needed.

    psi falls with M (where the pair retreats, its sign does not depend on M), and never takes less than the floor. With
    M under its floor there is a row only near.
    """
    free = np.empty(pairs.d.shape[0], np.bool_)
    for i in range(free.shape[0]):
        d, v, v_robot = pairs.d[i], -pairs.d_dot[i], -pairs.d_dot_robot[i]
        e = _effect(pairs.C[i], ddq, dddq_max, lower, upper)
        free[i] = v <= index.v_max and e.jerk > NO_JERK and not _is_near(d, v, v_robot, index, brake_time)
        if free[i]:
            hardest, a = -(e.least + pairs.drift[i]), -(e.along + pairs.drift[i])
            free[i] = _psi_after(hardest, d, v, a, T, index.M_floor, 0.0, e.jerk, index) <= 0.0
    return free


@njit(cache=True)
def _base(basis: int, floor: float, e: Effect) -> float:
    """What is left of a floor where rows conflict, see safe_control: all of an index row; of the end of an approach
    half of what it asks beyond the commanded acceleration; of a ramp, the commanded braking less WEAKEN of what a
    period can take from it."""
    if basis == INDEX:
        return floor
    if basis == STANDSTILL:
        return min(floor, e.along + STANDSTILL_BASE * (floor - e.along))
    return min(floor, e.along - max(SLACKEN, WEAKEN * (e.along - e.least)))


@njit(cache=True)
def row_floors(
    pairs: Separation,
    free: BoolVector,
    M: Vector,
    M_dot: Vector,
    ddq: Vector,
    dddq_max: Vector,
    lower: Vector,
    upper: Vector,
    brake: Vector,
    T: float,
    index: Index,
    brake_time: float,
) -> tuple[Vector, Vector, Vector, IntVector, IntVector]:
    """(phi, floor, base, Basis, Outside) of every pair: the row is C u >= floor; base: see safe_control.

    free: see `free_pairs`. lower, upper: the joint bounds of this period. brake: control of the joint-space brake, and
    how long it takes, s.

    Outside the ranges of its certificate the index is not relied on alone; the fallback is the same for all of them:
    near, the robot's own approach has to end. M under its floor: phi* is not defined, the control hardly reaches this
    direction and the link hardly moves along it; farther away there is no row at all, and near it asks for no more than
    the joint-space brake gives. (A column that turns fast is carried to and fro by its drift alone; asked to end that,
    the first joint, which hardly moves it, was driven on to 1.5 times its speed.)
    """
    p = M.shape[0]
    value, floor, base = np.empty(p), np.empty(p), np.empty(p)
    basis, outside = np.empty(p, np.int64), np.zeros(p, np.int64)
    for i in range(p):
        e = _effect(pairs.C[i], ddq, dddq_max, lower, upper)
        within = (e.along + JERK_SHARE * (e.most - e.along) if e.most > e.along else e.most) - SLACKEN
        d, v, v_robot, drift = pairs.d[i], -pairs.d_dot[i], -pairs.d_dot_robot[i], pairs.drift[i]
        value[i] = phi(d, v, max(M[i], index.M_floor), index)
        outside[i] = OUTSIDE_DISTANCE * (d < index.d_min) + OUTSIDE_SPEED * (v > index.v_max)
        if free[i]:
            floor[i], base[i], basis[i] = NO_ROW, NO_ROW, FREE
            continue
        near = _is_near(d, v, v_robot, index, brake_time)
        creep = min(STANDSTILL_SPEED, max(STANDSTILL_LEAST, STANDSTILL_FADE * (d - index.d_min)))
        own = -approach_ending(v_robot - creep, -(e.along + pairs.drift_robot[i]), T, e.jerk, index.at_once)
        standstill = own - pairs.drift_robot[i]
        if M[i] <= index.M_floor or e.jerk <= NO_JERK:
            basis[i], outside[i] = M_FLOOR, outside[i] + OUTSIDE_RADIUS
            braked = np.sum(pairs.C[i] * brake) - SLACKEN
            floor[i] = min(standstill, within, braked) if near else NO_ROW
            base[i] = _base(M_FLOOR, floor[i], e)
            continue
        a, hardest = -(e.along + drift), -(e.least + drift)
        asked = max(NO_ROW, -greatest_approach(d, v, a, T, M[i], M_dot[i], e.jerk, index, hardest) - drift)
        if d < index.d_min or (near and v > index.v_max):  # inside d_min not even towards a person who gives way
            asked = max(asked, standstill)
        ramp = min(within, BRAKE_SHARE * M[i] - drift)
        floor[i], basis[i] = asked, INDEX
        if standstill <= floor[i]:
            floor[i], basis[i] = standstill, STANDSTILL
        if ramp < floor[i]:
            floor[i], basis[i] = ramp, RAMP
        base[i] = _base(basis[i], floor[i], e)
    return value, floor, base, basis, outside


@njit(cache=True)
def phi_rate(d: float, d_dot: float, d_ddot: float, M: float, M_dot: float, index: Index) -> float:
    """phi_dot: the derivative of whichever part of phi is the larger."""
    if index.kind == PHI_B:
        return -d_dot + min(0.0, d_dot) * d_ddot / index.brake
    if M > 0.0 and phi_star(d, -d_dot, M, index.d_min, index.k) > index.d_min - d:
        return -2.0 * abs(d) * d_dot - index.k * d_ddot / M + index.k * d_dot * M_dot / (M * M)
    return -d_dot
