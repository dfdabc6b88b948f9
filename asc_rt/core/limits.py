"""Joint bounds that stay feasible: what acceleration may be commanded so that a stop inside every limit remains
possible.

The set-points are jerk-limited: over one period T the acceleration goes linearly from the commanded one to u, so
    q+ = q + T dq + T^2 (2 ddq + u) / 6,   dq+ = dq + T (ddq + u) / 2.
A torque acts at once: from the beginning of the period on the acceleration is u, and u takes the place of ddq in both.
(Who counts half of the last acceleration a into the speed of an arm that has forgotten it finds 2 v / T + a too much,
asks for it to be taken away, and so on: v+ = -v - T a, a+ = -2 v / T - a grows by 1 + sqrt 2 a period. A Panda before a
person shook so with +-8 rad/s2.)
u is allowed if the state (q+, dq+, u) can still be brought to rest inside the position limits and never exceeds the
velocity limit on the way. Naive bounds ((dq_max - dq) / T and the like) become infeasible near a limit.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from asc_rt.core.stopping import stopping_distance
from asc_rt.core.types import Vector

BISECTIONS = 40  # halves an interval of 20 rad/s2 to 2e-11


class Bounds(NamedTuple):
    """Joint limits, each (n,)."""

    q_min: np.ndarray  # rad
    q_max: np.ndarray
    dq_max: np.ndarray  # rad/s
    ddq_max: np.ndarray  # rad/s2
    dddq_max: np.ndarray  # rad/s3


@njit(cache=True)
def _greatest(room: float, dq: float, ddq: float, dq_max: float, A: float, J: float, T: float, at_once: bool) -> float:
    """Greatest allowed u of one joint whose position limit is `room` ahead, within the jerk and acceleration limits.

    If none is allowed (a limit moved, or noise), the hardest braking the jerk permits: the nearest way back.
    """
    low, high = max(-A, ddq - J * T), min(A, ddq + J * T)
    if high < low:
        return low
    if _fits(high, room, dq, ddq, dq_max, A, J, T, at_once):
        return high
    if not _fits(low, room, dq, ddq, dq_max, A, J, T, at_once):
        return low
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        if _fits(middle, room, dq, ddq, dq_max, A, J, T, at_once):
            low = middle
        else:
            high = middle
    return low


@njit(cache=True)
def _fits(
    u: float,
    room: float,
    dq: float,
    ddq: float,
    dq_max: float,
    A: float,
    J: float,
    T: float,
    at_once: bool,
) -> bool:
    begin = u if at_once else ddq
    advance = T * dq + T * T * (2.0 * begin + u) / 6.0
    speed = dq + T * (begin + u) / 2.0
    peak = speed + u * u / (2.0 * J) if u > 0.0 else speed
    return peak <= dq_max and advance + stopping_distance(speed, u, A, J) <= room


@njit(cache=True)
def reserve(dq_max: float, A: float, J: float, T: float) -> float:
    """Part of the way to a position limit that is kept free, rad.

    The planned stop changes its jerk at any moment, set-points only at multiples of T. Full braking that comes later by
    that costs up to J T^2 / 8 of speed (no more than A T), and this much speed lasts until the stop is over.
    """
    return min(J * T * T / 8.0, A * T) * (dq_max / A + A / J)


@njit(cache=True)
def command_box(
    bounds: Bounds, q: Vector, dq: Vector, ddq: Vector, T: float, at_once: bool = False
) -> tuple[Vector, Vector]:
    """Bounds lower <= u <= upper on the next commanded acceleration, rad/s2: position, velocity, acceleration, jerk."""
    n = q.shape[0]
    lower, upper = np.empty(n), np.empty(n)
    for i in range(n):
        A, J, v = bounds.ddq_max[i], bounds.dddq_max[i], bounds.dq_max[i]
        free = reserve(v, A, J, T)
        upper[i] = _greatest(bounds.q_max[i] - free - q[i], dq[i], ddq[i], v, A, J, T, at_once)
        lower[i] = -_greatest(q[i] - free - bounds.q_min[i], -dq[i], -ddq[i], v, A, J, T, at_once)
        if lower[i] > upper[i]:  # both sides call for braking: take the one that is being approached
            if dq[i] > 0.0:
                lower[i] = upper[i]
            else:
                upper[i] = lower[i]
    return lower, upper


@njit(cache=True)
def braking(bounds: Bounds, dq: Vector, lower: Vector, upper: Vector) -> Vector:
    """A control within the bounds that brings every joint to rest: full braking, and in the end no faster than the jerk
    can follow, (n,) rad/s2."""
    brake: Vector = np.minimum(np.maximum(-dq * bounds.dddq_max / bounds.ddq_max, lower), upper)
    return brake


@njit(cache=True)
def acceleration_box(bounds: Bounds, q: Vector, dq: Vector) -> tuple[Vector, Vector]:
    """Accelerations that joint i can reach *within a jerk ramp* without leaving its limits: the U that M is computed
    from.

    upper = min(A, (v_limit(q) - dq) J / A), v_limit = min(dq_max, sqrt(2 A (q_max - q))): continuous in (q, dq), so
    that M is Lipschitz as the paper's lemma needs. The jerk limit itself is in the index (a ramp), not in U.
    """
    n = q.shape[0]
    lower, upper = np.empty(n), np.empty(n)
    for i in range(n):
        A, J = bounds.ddq_max[i], bounds.dddq_max[i]
        ahead = min(bounds.dq_max[i], math.sqrt(2.0 * A * max(0.0, bounds.q_max[i] - q[i])))
        behind = min(bounds.dq_max[i], math.sqrt(2.0 * A * max(0.0, q[i] - bounds.q_min[i])))
        upper[i] = max(-A, min(A, (ahead - dq[i]) * J / A))
        lower[i] = -max(-A, min(A, (behind + dq[i]) * J / A))
    return lower, upper
