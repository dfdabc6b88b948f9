"""The control set U as the QP has it, and the exact maximum of a linear function over it.

    U = {u : lower <= u <= upper,  low <= G u <= high}        u: joint acceleration, rad/s2

The box holds the joint limits; the rows of G are the torque limits (G = H, low = -tau_max - h, high = tau_max - h) or
absent. One pair needs max C u over U, so this linear program sits in every cycle and in every sample of a certificate.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from asc_rt.core.types import BoolVector, IntVector, Matrix, Vector

TOLERANCE = 1e-9  # relative to the bounds: a row violated by less is kept
NUDGE = 1e-11  # of the size of c: the value may be less by about this share of the size of U
MAX_PIVOTS = 200  # far above the 2n or so that occur; a cycling program ends as "empty", which stops the robot


class Polytope(NamedTuple):
    lower: np.ndarray  # (n,) rad/s2
    upper: np.ndarray  # (n,)
    G: np.ndarray  # (m, n)
    low: np.ndarray  # (m,) Nm
    high: np.ndarray  # (m,)


@njit(cache=True)
def pack(U: Polytope) -> Matrix:
    """A Polytope in one array, as kernels hand it over: (2, n) lower, upper; low, high and the n rows of G follow if
    there are torque limits."""
    n, m = U.lower.shape[0], U.G.shape[0]
    packed = np.empty((4 + m if m else 2, n))
    packed[0], packed[1] = U.lower, U.upper
    if m:
        packed[2], packed[3], packed[4:] = U.low, U.high, U.G
    return packed


@njit(cache=True)
def unpack(packed: Matrix) -> Polytope:
    """Inverse of `pack`: views."""
    if packed.shape[0] > 2:
        return Polytope(packed[0], packed[1], packed[4:], packed[2], packed[3])
    return Polytope(packed[0], packed[1], packed[2:], packed[0, :0], packed[0, :0])


class Support(NamedTuple):
    """The best vertex of U in a direction c, and why it is the best: c = y_box + G^T y_rows.

    A multiplier is positive at an upper bound, negative at a lower one, zero where the constraint is not active. By the
    envelope theorem the value moves with the data as d(c) . u + sum_i y_i d(bound_i) - y_rows . dG u.
    """

    value: float  # -inf if U is empty
    u: np.ndarray  # (n,)
    y: np.ndarray  # (n + m,) of the box, then of the rows


@njit(cache=True)
def greatest(c: Vector, U: Polytope) -> float:
    """max c . u over U; -inf if U is empty. Without rows the joints are on their own."""
    if U.G.shape[0] > 0 or np.any(U.lower > U.upper):
        return support(c, U).value
    value = 0.0
    for i in range(c.shape[0]):
        value += c[i] * (U.upper[i] if c[i] > 0.0 else U.lower[i])
    return value


@njit(cache=True)
def moved(best: Support, c: Vector, U: Polytope, c_there: Vector, there: Polytope) -> float:
    """Change of max c . u from (c, U) to (c_there, there) nearby, to first order."""
    n, change = c.shape[0], 0.0
    for i in range(n):
        change += (c_there[i] - c[i]) * best.u[i]
        y = best.y[i]
        if y > 0.0:
            change += y * (there.upper[i] - U.upper[i])
        elif y < 0.0:
            change += y * (there.lower[i] - U.lower[i])
    for r in range(U.G.shape[0]):
        y = best.y[n + r]
        if y == 0.0:
            continue
        change += y * (there.high[r] - U.high[r]) if y > 0.0 else y * (there.low[r] - U.low[r])
        for k in range(n):
            change -= y * (there.G[r, k] - U.G[r, k]) * best.u[k]
    return change


@njit(cache=True)
def _worst_row(u: Vector, U: Polytope) -> tuple[int, bool]:
    """The most violated constraint (< n box, >= n row of G), and whether at its upper bound; -1: none."""
    n = u.shape[0]
    worst, entering, to_upper = TOLERANCE, -1, True
    for r in range(n + U.G.shape[0]):
        if r < n:
            reached, below, above = u[r], U.lower[r], U.upper[r]
        else:
            reached, below, above = 0.0, U.low[r - n], U.high[r - n]
            for k in range(n):
                reached += U.G[r - n, k] * u[k]
        if below <= reached <= above:
            continue
        scale = 1.0 / (1.0 + abs(below) + abs(above))
        if (reached - above) * scale > worst:
            worst, entering, to_upper = (reached - above) * scale, r, True
        if (below - reached) * scale > worst:
            worst, entering, to_upper = (below - reached) * scale, r, False
    return entering, to_upper


@njit(cache=True)
def _exchange(w: Vector, side: float, leaving: int, inverse: Matrix) -> None:
    """The inverse after the leaving constraint's normal was replaced by one that is side * w in the old basis."""
    n = w.shape[0]
    for k in range(n):
        inverse[k, leaving] /= side * w[leaving]
    for j in range(n):
        if j != leaving:
            for k in range(n):
                inverse[k, j] -= side * w[j] * inverse[k, leaving]


@njit(cache=True)
def _vertex(active: IntVector, at_upper: BoolVector, inverse: Matrix, U: Polytope, u: Vector) -> None:
    """The point where the active constraints meet."""
    n = u.shape[0]
    u[:] = 0.0
    for j in range(n):
        r = active[j]
        below, above = (U.lower[r], U.upper[r]) if r < n else (U.low[r - n], U.high[r - n])
        bound = above if at_upper[j] else below
        for k in range(n):
            u[k] += inverse[k, j] * bound


@njit(cache=True)
def support(c: Vector, U: Polytope) -> Support:
    """max c . u over U with its vertex and multipliers, by the dual simplex method.

    Starts at the vertex of the box that c points to, which is dual feasible, and brings the worst violated row into
    the basis until none is violated. With no rows G it is the closed form sum_i max(c_i lower_i, c_i upper_i).

    A joint that c does not need (those beyond the link of the pair) has the multiplier 0, and with several of these the
    method can run in circles. So it steps by a c that is a little larger everywhere, each entry by another share, and
    takes the multipliers of the true c in the end.
    """
    n = c.shape[0]
    multipliers = np.zeros(n + U.G.shape[0])
    u = np.empty(n)
    value = 0.0
    for i in range(n):
        u[i] = U.upper[i] if c[i] > 0.0 else U.lower[i]
        value += c[i] * u[i]
        multipliers[i] = c[i]
    if _worst_row(u, U)[0] < 0:  # as nearly always: the vertex of the box will do
        return Support(value, u, multipliers)
    multipliers[:] = 0.0
    y = np.empty(n)  # multipliers of the n active constraints
    active = np.arange(n)  # the active constraints: < n box, >= n row of G
    at_upper = c > 0.0
    inverse = np.eye(n)  # of the matrix whose rows are the active constraints' normals
    w = np.empty(n)
    most = 1.0 + np.abs(c).max()
    for i in range(n):
        share = NUDGE * most * (1.0 + (0.6180339887 * i) % 1.0)
        y[i] = c[i] + share if at_upper[i] else c[i] - share
    _vertex(active, at_upper, inverse, U, u)
    for _ in range(MAX_PIVOTS):
        entering, to_upper = _worst_row(u, U)
        if entering < 0:
            value = 0.0
            for k in range(n):
                value += c[k] * u[k]
                for i in range(n):
                    multipliers[active[k]] += c[i] * inverse[i, k]
            return Support(value, u, multipliers)
        side = 1.0 if to_upper else -1.0
        leaving, least = -1, np.inf
        for j in range(n):
            w[j] = 0.0
            for k in range(n):
                normal = (1.0 if k == entering else 0.0) if entering < n else U.G[entering - n, k]
                w[j] += side * normal * inverse[k, j]
            blocks = w[j] > 1e-12 if at_upper[j] else w[j] < -1e-12
            if blocks and y[j] / w[j] < least:
                leaving, least = j, y[j] / w[j]
        if leaving < 0:
            break
        for j in range(n):
            y[j] -= least * w[j]
        y[leaving] = side * least
        active[leaving], at_upper[leaving] = entering, to_upper
        _exchange(w, side, leaving, inverse)
        _vertex(active, at_upper, inverse, U, u)
    return Support(-np.inf, u, multipliers)
