"""The control set U as the QP has it, and the exact maximum of a linear function over it.

    U = {u : lower <= u <= upper,  low <= G u <= high}        u: joint acceleration, rad/s2

The box holds the joint limits; the rows of G are the torque limits (G = H, low = -tau_max - h, high = tau_max - h) or
absent. One pair needs max C u over U, so this linear program sits in every cycle and in every sample of a certificate.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from asc_rt.core.types import Vector

TOLERANCE = 1e-9  # relative to the bounds: a row violated by less is kept
MAX_PIVOTS = 200  # far above the 2n or so that occur; a cycling program ends as "empty", which stops the robot


class Polytope(NamedTuple):
    lower: np.ndarray  # (n,) rad/s2
    upper: np.ndarray  # (n,)
    G: np.ndarray  # (m, n)
    low: np.ndarray  # (m,) Nm
    high: np.ndarray  # (m,)


@njit(cache=True)
def greatest(c: Vector, U: Polytope) -> float:
    """max c . u over U, by the dual simplex method; -inf if U is empty.

    Starts at the vertex of the box that c points to, which is dual feasible, and brings the worst violated row into
    the basis until none is violated. With no rows G it is the closed form sum_i max(c_i lower_i, c_i upper_i).
    """
    n, m = c.shape[0], U.G.shape[0]
    value = 0.0
    u, y = np.empty(n), c.copy()  # vertex; multipliers of the n active constraints
    active = np.arange(n)  # index of the active constraint: < n box, >= n row of G
    at_upper = np.empty(n, np.bool_)
    inverse = np.eye(n)  # of the matrix whose rows are the active constraints' normals
    for i in range(n):
        at_upper[i] = c[i] > 0.0
        u[i] = U.upper[i] if at_upper[i] else U.lower[i]
        value += c[i] * u[i]
    if m == 0:
        return value
    w, normal = np.empty(n), np.empty(n)
    for _ in range(MAX_PIVOTS):
        worst, entering, to_upper = TOLERANCE, -1, True
        for r in range(n + m):
            if r < n:
                reached, below, above = u[r], U.lower[r], U.upper[r]
            else:
                reached, below, above = 0.0, U.low[r - n], U.high[r - n]
                for k in range(n):
                    reached += U.G[r - n, k] * u[k]
            scale = 1.0 / (1.0 + abs(below) + abs(above))
            if (reached - above) * scale > worst:
                worst, entering, to_upper = (reached - above) * scale, r, True
            if (below - reached) * scale > worst:
                worst, entering, to_upper = (below - reached) * scale, r, False
        if entering < 0:
            value = 0.0
            for k in range(n):
                value += c[k] * u[k]
            return value
        side = 1.0 if to_upper else -1.0
        for k in range(n):
            normal[k] = (1.0 if k == entering else 0.0) if entering < n else U.G[entering - n, k]
        leaving, least = -1, np.inf
        for j in range(n):
            w[j] = 0.0
            for k in range(n):
                w[j] += side * normal[k] * inverse[k, j]
            blocks = w[j] > 1e-12 if at_upper[j] else w[j] < -1e-12
            if blocks and y[j] / w[j] < least:
                leaving, least = j, y[j] / w[j]
        if leaving < 0:
            return -np.inf
        for j in range(n):
            y[j] -= least * w[j]
        y[leaving] = side * least
        active[leaving], at_upper[leaving] = entering, to_upper
        pivot = side * w[leaving]
        for k in range(n):
            inverse[k, leaving] /= pivot
        for j in range(n):
            if j != leaving:
                for k in range(n):
                    inverse[k, j] -= side * w[j] * inverse[k, leaving]
        for k in range(n):
            u[k] = 0.0
        for j in range(n):
            r = active[j]
            if r < n:
                bound = U.upper[r] if at_upper[j] else U.lower[r]
            else:
                bound = U.high[r - n] if at_upper[j] else U.low[r - n]
            for k in range(n):
                u[k] += inverse[k, j] * bound
    return -np.inf
