"""Sampled states pulled onto phi = 0, where the index needs its control: is there one, with the real limits? Compiled.

The person's point is moved along the line of separation until phi = 0. That changes nothing about the arm, C, v or the
nearest point, only the drift. There, exactly (one linear program over U):

    phi*:  exists u:  2 d v - k d_ddot(u) / M - k v M_dot(u) / M^2 <= 0      d_ddot = C u + drift - a_h
    phi_b: M >= a

States in which the robot's own nearest point does not approach are left out: there the index asks for no more than that
this stays so, however fast the person comes (`safety_index`, STANDSTILL).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from asc_rt.core.abstraction import People
from asc_rt.core.robot_model import Arm
from asc_rt.core.types import Matrix, Vector
from asc_rt.synthesis.draw import Draw, State, realise
from asc_rt.synthesis.kernel import STEP, Situation, best, foot, radius, shifted, situation

# What became of a state.
ON_BOUNDARY, RETREATING, UNREACHED, UNDER_FLOOR = range(4)
# Columns.
STATUS, DISTANCE, SPEED, M, MARGIN = range(5)
BISECTIONS = 40
SCAN = 24  # distances looked at for the outermost zero of phi*


@njit(cache=True, nogil=True)
def moved_to(s: Situation, people: People, capsule_radius: float, d: float) -> People:
    """The same person at surface distance d, along the line of separation."""
    t = foot(s, people.p0[0])
    point, away = np.empty((1, 3)), np.empty(3)
    square = 0.0
    for k in range(3):
        point[0, k] = s.r0[k] + t * (s.r1[k] - s.r0[k])
        away[k] = people.p0[0, k] - point[0, k]
        square += away[k] * away[k]
    for k in range(3):
        point[0, k] += (d + capsule_radius) * away[k] / math.sqrt(square)
    return People(point, point, people.v0, people.v1, people.radius, people.velocity_bound)


@njit(cache=True, nogil=True)
def _drift_over_distance(arm: Arm, draw: Draw, s: State, here: Situation, d_min: float) -> tuple[float, float, float]:
    """(c, c_near, c_far) of drift = c + c_near / D + c_far D, D = d + radius, along the line of separation.

    The square of the witness line's rate goes with 1 / D; the slip along a turning capsule's axis is the square of a
    linear function of D, over D.
    """
    size = arm.capsules.radius[s.capsule]
    D, drift = np.empty(3), np.empty(3)
    for i in range(3):
        d = d_min + 0.5 * i * (draw.d_high - d_min)
        people = moved_to(here, s.people, size, d)
        D[i], drift[i] = d + size, situation(arm, draw.given.limited, people, s.q, s.dq, s.capsule).drift
    low, high = (drift[1] - drift[0]) / (D[1] - D[0]), (drift[2] - drift[1]) / (D[2] - D[1])
    near = (high - low) / (1.0 / (D[0] * D[1]) - 1.0 / (D[1] * D[2]))
    far = low + near / (D[0] * D[1])
    return drift[0] - near / D[0] - far * D[0], near, far


@njit(cache=True, nogil=True)
def _zero(c: float, near: float, far: float, size: float, v: float, d_min: float, d_high: float, k: float) -> float:
    """Outermost d at which phi* = 0 with M(d) = c + near / D + far D; inf: phi* > 0 up to d_high."""
    inside, outside = d_min, np.inf
    for i in range(SCAN + 1):
        d = d_high - (d_high - d_min) * i / SCAN
        M_here = c + near / (d + size) + far * (d + size)
        if M_here <= 0.0 or (d * d - d_min * d_min) * M_here < k * v:
            inside = d
            break
        outside = d
    if outside == np.inf:
        return np.inf
    for _ in range(BISECTIONS):
        d = 0.5 * (inside + outside)
        M_here = c + near / (d + size) + far * (d + size)
        if M_here <= 0.0 or (d * d - d_min * d_min) * M_here < k * v:
            inside = d
        else:
            outside = d
    return outside


@njit(cache=True, nogil=True)
def _pull(arm: Arm, draw: Draw, s: State, k: float, d_min: float, floor: float, stopping: bool, out: Vector) -> None:
    """k: of phi*; stopping: of phi_b, its deceleration a."""
    here = situation(arm, draw.given.limited, s.people, s.q, s.dq, s.capsule)
    size, v = arm.capsules.radius[s.capsule], -here.d_dot
    out[STATUS], out[DISTANCE], out[SPEED], out[M], out[MARGIN] = RETREATING, np.nan, v, np.nan, np.nan
    if v <= 0.0 or here.d_dot_robot >= 0.0:
        return
    if stopping:
        d = d_min + v * v / (2.0 * k)
    else:
        c, near, far = _drift_over_distance(arm, draw, s, here, d_min)
        c += best(here.C, here).value - draw.given.human_acceleration
        d = _zero(c, near, far, size, v, d_min, draw.d_high, k)
    if d > draw.d_high:
        out[STATUS] = UNREACHED
        return
    people = moved_to(here, s.people, size, d)
    there = situation(arm, draw.given.limited, people, s.q, s.dq, s.capsule)
    r = radius(
        arm, draw.given, people, s.q, s.dq, s.capsule, there,
        shifted(arm, draw.given.limited, people, s.q, s.dq, s.capsule, STEP), 1.0, best(there.C, there),
    )  # fmt: skip
    out[STATUS] = ON_BOUNDARY if r.value > floor else UNDER_FLOOR
    out[DISTANCE], out[M] = there.d, r.value
    if stopping:
        out[MARGIN] = r.value - k
        return
    value = max(r.value, floor)
    d_ddot = there.drift - draw.given.human_acceleration
    gain = best(there.C + v / value * r.g, there).value + d_ddot + v / value * (r.rate - r.spread)
    out[MARGIN] = gain * k / value - 2.0 * d * v


@njit(cache=True, nogil=True)
def pull_all(arm: Arm, draw: Draw, units: Matrix, k: float, d_min: float, floor: float, stopping: bool) -> Matrix:
    """(N, 5): STATUS, DISTANCE m, SPEED m/s, M m/s2, MARGIN (m2/s of phi*, m/s2 of phi_b; feasible from 0 on)."""
    out = np.empty((units.shape[0], 5))
    for i in range(units.shape[0]):
        _pull(arm, draw, realise(arm, draw, units[i]), k, d_min, floor, stopping, out[i])
    return out
