"""The QP: the control closest to the reference that keeps every row and every joint bound.

    min_u  sum_i ((u_i - u_ref_i) / scale_i)^2   s.t.   C u >= floor,   u in U (joint limits, torque limits)

When the rows conflict, in this order: the joint limits hold; rows that rest on the index hold; the others (a person
comes faster than the arm can make good, or is outside the certified ranges) share what is there:
    min  ... + PRESSING (1 - share)^2   s.t.   C u >= base + share (floor - base),   0 <= share <= 1
base (`safety_index`) is about what the commanded acceleration gives already, so share says how much of the extra
braking was possible; it is recorded. Rows of the index that cannot be kept have no share and no slack, and base is kept
by all: INFEASIBLE, and the robot brakes.

One row that binds, the usual case, has its exact answer in closed form (`_of_one_row`, a few us); everything else is
PIQP's, set up afresh each cycle: a reused solver carries its history and does not replay to the bit. Limits are by
iteration, never by time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import piqp
from numba import njit

from asc_rt.core.polytope import unpack
from asc_rt.core.types import IntVector, Matrix, Vector

MAX_ITERATIONS, TOLERANCE = 60, 1e-9
# Rows are asked for with this margin and the box is drawn in by it, so that the solver's own tolerance stays inside the
# limits: m/s2 and share of ddq_max.
SOLVER_MARGIN = 1e-6
# ASSUMED: weight of the share against the deviation from the reference, both without unit: ten times full acceleration.
PRESSING = 100.0


@dataclass(frozen=True, slots=True)
class Solution:
    u_ref: Vector  # rad/s2
    u: Vector  # rad/s2; meaningless if not feasible
    feasible: bool
    filtered: bool  # a row (not only the box) moved the reference
    iterations: int
    share: float  # 1: every row whole; less: of the ramp, see above


def solve(u_ref: Vector, C: Matrix, floor: Vector, base: Vector, U: Matrix, scale: Vector) -> Solution:
    """`base` <= floor, equal where a row has no share; `U`: packed; `scale`: ddq_max, (n,), rad/s2."""
    boxed, fits, sound, graded, binding = _screen(u_ref, C, floor, base, U)
    if not sound:
        return Solution(u_ref, u_ref, False, True, 0, 0.0)
    if fits:
        return Solution(u_ref, boxed, True, False, 0, 1.0)
    found = _quadratic(u_ref, C, floor, floor, binding, U, scale, False)
    iterations, share = found.iterations, found.share
    if not found.solved and graded:
        found = _quadratic(u_ref, C, floor, base, binding, U, scale, True)
        iterations, share = iterations + found.iterations, found.share
    kept = found.solved and bool(_keeps(found.u, C, floor, base, share, U))
    return Solution(u_ref, found.u, kept, True, iterations, share)


def project(u: Vector, U: Matrix, scale: Vector) -> Vector | None:
    """The control of U (packed) nearest to u; None if U is empty."""
    if inside(u, U):
        return u
    found = _quadratic(u, np.zeros((0, len(u))), np.zeros(0), np.zeros(0), np.zeros(0, np.int64), U, scale, False)
    return found.u if found.solved and inside(found.u, U) else None


@njit(cache=True)
def _screen(
    u_ref: Vector, C: Matrix, floor: Vector, base: Vector, packed: Matrix
) -> tuple[Vector, bool, bool, bool, IntVector]:
    """(reference within the box; does it keep everything; are the rows numbers; has one a share; rows that bind).

    The reference is a wish; the limits are in the QP as well. Rows that no control in the box can violate do not bind:
    they are left out, exactly.
    """
    U, n, boxed = unpack(packed), u_ref.shape[0], _boxed(u_ref, packed)
    fits, sound, graded = inside(boxed, packed), True, False
    binding, count = np.empty(floor.shape[0], np.int64), 0
    for i in range(floor.shape[0]):
        value = least = 0.0
        for j in range(n):
            value += C[i, j] * boxed[j]
            least += C[i, j] * (U.lower[j] if C[i, j] > 0.0 else U.upper[j])
        fits = fits and value >= floor[i]
        sound = sound and floor[i] < np.inf
        if least < floor[i] + SOLVER_MARGIN:
            binding[count] = i
            count += 1
            graded = graded or floor[i] > base[i]
    return boxed, fits, sound, graded, binding[:count]


@njit(cache=True)
def _boxed(u: Vector, packed: Matrix) -> Vector:
    U, n = unpack(packed), u.shape[0]
    boxed = np.empty(n)
    for j in range(n):
        boxed[j] = min(max(u[j], U.lower[j]), U.upper[j])
    return boxed


@njit(cache=True)
def inside(u: Vector, packed: Matrix) -> bool:
    """Is u in the packed polytope; False also if u is not a number."""
    U = unpack(packed)
    for j in range(u.shape[0]):
        if not U.lower[j] <= u[j] <= U.upper[j]:
            return False
    for r in range(U.G.shape[0]):
        value = 0.0
        for j in range(u.shape[0]):
            value += U.G[r, j] * u[j]
        if not U.low[r] <= value <= U.high[r]:
            return False
    return True


@njit(cache=True)
def _keeps(u: Vector, C: Matrix, floor: Vector, base: Vector, share: float, U: Matrix) -> bool:
    """Every row, with the share of its ramp, and every bound."""
    return keeps_rows(u, C, base + share * (floor - base)) and inside(u, U)


@njit(cache=True)
def keeps_rows(u: Vector, C: Matrix, floor: Vector) -> bool:
    """C u >= floor; False also for what is not a number."""
    for i in range(floor.shape[0]):
        value = 0.0
        for j in range(u.shape[0]):
            value += C[i, j] * u[j]
        if not value >= floor[i]:
            return False
    return True


@dataclass(frozen=True, slots=True)
class _Found:
    u: Vector
    share: float
    solved: bool
    iterations: int


def _quadratic(
    u_ref: Vector,
    C: Matrix,
    floor: Vector,
    base: Vector,
    binding: IntVector,
    U: Matrix,
    scale: Vector,
    shared: bool,
) -> _Found:
    """The program in u / scale, with the share as one more variable if `shared`, and its answer."""
    u, share, solved, is_easy = _easily(u_ref, C, floor, base, binding, U, scale, shared)
    if is_easy:
        return _Found(u, share, solved, 0)
    x, solved, iterations = _of_piqp(*_program(u_ref, C, floor, base, binding, U, scale, shared))
    return _Found(*_meant(x, U, scale, shared), solved, iterations)


@njit(cache=True)
def _easily(
    u_ref: Vector,
    C: Matrix,
    floor: Vector,
    base: Vector,
    binding: IntVector,
    U: Matrix,
    scale: Vector,
    shared: bool,
) -> tuple[Vector, float, bool, bool]:
    """(u, share, solved, True) of a program with one row; else nothing, and False."""
    P, c, G, low, high, lower, upper = _program(u_ref, C, floor, base, binding, U, scale, shared)
    if low.shape[0] != 1 or high[0] != np.inf:
        return np.empty(0), 0.0, False, False
    x, solved = _of_one_row(P, c, G, low, lower, upper)
    u, share = _meant(x, U, scale, shared)
    return u, share, solved, True


@njit(cache=True)
def _meant(x: Vector, U: Matrix, scale: Vector, shared: bool) -> tuple[Vector, float]:
    """(u, share). A joint without any room has none for rounding either."""
    n = scale.shape[0]
    return _boxed(x[:n] * scale, U), max(0.0, float(x[n]) - SOLVER_MARGIN) if shared else 1.0


def _of_piqp(
    P: Matrix, c: Vector, G: Matrix, low: Vector, high: Vector, lower: Vector, upper: Vector
) -> tuple[Vector, bool, int]:
    solver = piqp.DenseSolver()
    settings = solver.settings
    settings.max_iter, settings.eps_abs, settings.eps_rel = MAX_ITERATIONS, TOLERANCE, TOLERANCE
    solver.setup(P, c, None, None, G, low, high, lower, upper)
    solved = solver.solve() == piqp.PIQP_SOLVED
    return solver.result.x, solved, int(solver.result.info.iter)


@njit(cache=True)
def _of_one_row(P: Matrix, c: Vector, G: Matrix, low: Vector, lower: Vector, upper: Vector) -> tuple[Vector, bool]:
    """min x P x / 2 + c x,  g x >= low,  lower <= x <= upper, with a diagonal P; and whether that is possible.

    By the conditions of Karush, Kuhn and Tucker x(y) = clip((y g - c) / P, lower, upper) with the least multiplier
    y >= 0 at which the row is kept. g x(y) never falls, and is straight between the y at which a component meets an end
    of its range: the answer lies between the last of them that breaks the row and the first that keeps it.
    """
    g, n, keeps, breaks = G[0], c.shape[0], np.inf, 0.0
    x = _with_multiplier(0.0, P, c, g, lower, upper)
    if _dot(g, x) >= low[0]:
        return x, True
    for j in range(n):
        if g[j] == 0.0:
            continue
        for end in (lower[j], upper[j]):
            y = (P[j, j] * end + c[j]) / g[j]
            if breaks < y < keeps:
                if _dot(g, _with_multiplier(y, P, c, g, lower, upper)) >= low[0]:
                    keeps = y
                else:
                    breaks = y
    if keeps == np.inf:
        return x, False
    first = _with_multiplier(breaks, P, c, g, lower, upper)
    last = _with_multiplier(keeps, P, c, g, lower, upper)
    share = (low[0] - _dot(g, first)) / (_dot(g, last) - _dot(g, first))
    return first + share * (last - first), True


@njit(cache=True)
def _with_multiplier(y: float, P: Matrix, c: Vector, g: Vector, lower: Vector, upper: Vector) -> Vector:
    x = np.empty(c.shape[0])
    for j in range(c.shape[0]):
        x[j] = min(max((y * g[j] - c[j]) / P[j, j], lower[j]), upper[j])
    return x


@njit(cache=True)
def _program(
    u_ref: Vector,
    C: Matrix,
    floor: Vector,
    base: Vector,
    binding: IntVector,
    packed: Matrix,
    scale: Vector,
    shared: bool,
) -> tuple[Matrix, Vector, Matrix, Vector, Vector, Vector, Vector]:
    """(P, c, G, low, high, lower, upper) of  min x P x / 2 + c x,  low <= G x <= high,  lower <= x <= upper.

    x = u / scale, and the share if `shared`. Torque rows that no control in the box can violate are left out, exactly.
    """
    U, n, extra, p = unpack(packed), u_ref.shape[0], int(shared), binding.shape[0]
    P, c = np.zeros((n + extra, n + extra)), np.empty(n + extra)
    lower, upper = np.zeros(n + extra), np.ones(n + extra)
    for j in range(n):
        inset = min(SOLVER_MARGIN * scale[j], 0.5 * (U.upper[j] - U.lower[j]))
        lower[j], upper[j] = (U.lower[j] + inset) / scale[j], (U.upper[j] - inset) / scale[j]
        P[j, j], c[j] = 1.0, -u_ref[j] / scale[j]
    if shared:
        P[n, n], c[n] = PRESSING, -PRESSING
    torque, count = np.empty(U.G.shape[0], np.int64), 0
    for r in range(U.G.shape[0]):
        least = most = 0.0
        for j in range(n):
            a, b = U.G[r, j] * U.lower[j], U.G[r, j] * U.upper[j]
            least, most = least + min(a, b), most + max(a, b)
        if least < U.low[r] + SOLVER_MARGIN or most > U.high[r] - SOLVER_MARGIN:
            torque[count] = r
            count += 1
    G = np.zeros((n + extra, p + count)).T  # column by column, as the solver reads it
    low, high = np.empty(p + count), np.full(p + count, np.inf)
    for i in range(p):
        row = binding[i]
        low[i] = base[row] + SOLVER_MARGIN
        for j in range(n):
            G[i, j] = C[row, j] * scale[j]
        if shared:
            G[i, n] = base[row] - floor[row]
    for i in range(count):
        r = torque[i]
        low[p + i], high[p + i] = U.low[r] + SOLVER_MARGIN, U.high[r] - SOLVER_MARGIN
        for j in range(n):
            G[p + i, j] = U.G[r, j] * scale[j]
    return P, c, G, low, high, lower, upper


@njit(cache=True)
def _dot(a: Vector, b: Vector) -> float:
    """Summed in this order on every machine, which a library of linear algebra does not promise."""
    value = 0.0
    for j in range(a.shape[0]):
        value += a[j] * b[j]
    return value
