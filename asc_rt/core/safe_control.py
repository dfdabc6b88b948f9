"""The QP: the control closest to the reference that keeps every row and every joint bound.

    min_u  sum_i ((u_i - u_ref_i) / scale_i)^2   s.t.   C u >= floor,   u in U (joint limits, torque limits)

When the rows conflict, in this order: the joint limits hold; rows that rest on the index hold; rows that ask for the
ramp (a person comes faster than the arm can make good) share what is there:
    min  ... + PRESSING (1 - share)^2   s.t.   C u >= base + share (floor - base),   0 <= share <= 1
base is what the commanded acceleration gives already, so share says how much of the extra braking was possible; it is
recorded. Rows of the index that cannot be kept have no share and no slack: INFEASIBLE, and the robot brakes.

PIQP, set up afresh each cycle: a reused solver carries its history and does not replay to the bit. Limits are by
iteration, never by time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import piqp

from asc_rt.core.polytope import Polytope
from asc_rt.core.types import Matrix, Vector

MAX_ITERATIONS = 60
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


def solve(u_ref: Vector, C: Matrix, floor: Vector, base: Vector, U: Polytope, scale: Vector) -> Solution:
    """`base` <= floor, equal where a row has no share; `scale`: ddq_max, (n,), rad/s2."""
    if np.any(np.isnan(floor)) or np.any(floor == np.inf):
        return Solution(u_ref, u_ref, False, True, 0, 0.0)
    boxed = np.clip(u_ref, U.lower, U.upper)  # the reference is a wish; the limits are in the QP below as well
    if np.all(C @ boxed >= floor) and _inside(boxed, U):
        return Solution(u_ref, boxed, True, False, 0, 1.0)
    # Rows that no control in the box can violate are left out, exactly.
    binding = np.where(C > 0.0, C * U.lower, C * U.upper).sum(axis=1) < floor + SOLVER_MARGIN
    whole, floor_bound, base_bound = C[binding], floor[binding], base[binding]
    found = _quadratic(u_ref, whole, floor_bound, np.zeros(len(floor_bound)), U, scale, shared=False)
    iterations, share = found.iterations, 1.0
    graded = floor_bound - base_bound
    if not found.solved and np.any(graded > 0.0):
        found = _quadratic(u_ref, whole, base_bound, graded, U, scale, shared=True)
        iterations, share = iterations + found.iterations, found.share
    kept = found.solved and bool(np.all(C @ found.u >= base + share * (floor - base)) and _inside(found.u, U))
    return Solution(u_ref, found.u, kept, True, iterations, share)


def project(u: Vector, U: Polytope, scale: Vector) -> Vector | None:
    """The control of U nearest to u; None if U is empty."""
    if _inside(u, U):
        return u
    none = np.zeros((0, len(u)))
    found = _quadratic(u, none, np.zeros(0), np.zeros(0), U, scale, shared=False)
    return found.u if found.solved and _inside(found.u, U) else None


def _inside(u: Vector, U: Polytope) -> bool:
    torque = U.G @ u
    return bool(
        np.all(np.isfinite(u))
        and np.all((u >= U.lower) & (u <= U.upper))
        and np.all((torque >= U.low) & (torque <= U.high))
    )


@dataclass(frozen=True, slots=True)
class _Found:
    u: Vector
    share: float
    solved: bool
    iterations: int


def _quadratic(
    u_ref: Vector, C: Matrix, base: Vector, graded: Vector, U: Polytope, scale: Vector, shared: bool
) -> _Found:
    """One PIQP call in u / scale, with the share as one more variable if `shared`."""
    n, extra = len(u_ref), int(shared)
    inset = np.minimum(SOLVER_MARGIN * scale, 0.5 * (U.upper - U.lower))
    weight = np.concatenate((np.ones(n), np.full(extra, PRESSING)))
    rows = np.hstack((C * scale, -graded[:, None])) if shared else C * scale
    torque = np.hstack((U.G * scale, np.zeros((len(U.low), extra))))
    solver = piqp.DenseSolver()
    solver.settings.max_iter = MAX_ITERATIONS
    solver.settings.eps_abs = 1e-9
    solver.settings.eps_rel = 1e-9
    solver.setup(
        np.diag(weight),
        -weight * np.concatenate((u_ref / scale, np.ones(extra))),
        None,
        None,
        np.asfortranarray(np.vstack((rows, torque))),
        np.concatenate((base + SOLVER_MARGIN, U.low + SOLVER_MARGIN)),
        np.concatenate((np.full(len(base), np.inf), U.high - SOLVER_MARGIN)),
        np.concatenate(((U.lower + inset) / scale, np.zeros(extra))),
        np.concatenate(((U.upper - inset) / scale, np.ones(extra))),
    )
    solved = solver.solve() == piqp.PIQP_SOLVED
    x = solver.result.x
    share = float(min(1.0, max(0.0, x[n]))) - SOLVER_MARGIN if shared else 1.0
    return _Found(x[:n] * scale, share, solved, int(solver.result.info.iter))
