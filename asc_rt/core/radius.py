"""M of every pair and how fast it changes, along the state's own motion."""

from __future__ import annotations

import numpy as np
from numba import njit

from asc_rt.core.abstraction import People, Separation, pair, place
from asc_rt.core.kinematics import Motion, forward
from asc_rt.core.limits import acceleration_box
from asc_rt.core.polytope import Polytope, Support, moved, support
from asc_rt.core.realizable import control_set
from asc_rt.core.robot_model import Arm
from asc_rt.core.types import Matrix, Vector

# ASSUMED: difference step for M_dot, s. Central difference: error O(step^2); checked against a ten times larger step.
DIFFERENCE_STEP = 1e-5
# ASSUMED: m/s3. A steeper one-sided difference is no slope but a jump of M (a nearest point arriving at a segment's end
# switches its slip term): it is in M itself from the next cycle on, and as a slope it would only stop the robot for
# nothing.
JUMP = 1e4


@njit(cache=True)
def _shifted(
    arm: Arm,
    people: People,
    q: Vector,
    dq: Vector,
    ddq: Vector,
    human_acceleration: float,
    pairs: Separation,
    t: float,
    U: Polytope,
    torque_counts: bool,
    C: Matrix,
    drift: Vector,
) -> Polytope:
    """C and drift of the pairs, and U, `t` seconds along (dq, ddq) and the people's velocities.

    The torque limits stay those of U if they do not count: no row of theirs is active.
    """
    there = People(
        people.p0 + t * people.v0, people.p1 + t * people.v1, people.v0, people.v1, people.radius, people.velocity_bound
    )
    q_t, dq_t = q + t * dq, dq + t * ddq
    motion = forward(arm.chain, q_t, dq_t)
    for i in range(drift.shape[0]):
        c = pairs.robot[i]
        joint = arm.capsules.joint[c]
        r0, r1 = place(motion, joint, arm.capsules.p0[c]), place(motion, joint, arm.capsules.p1[c])
        drift[i] = pair(motion, joint, r0, r1, there, pairs.human[i], human_acceleration, C[i])[1]
    if torque_counts:
        return control_set(arm, motion, q_t, dq_t)
    lower, upper = acceleration_box(arm.bounds, q_t, dq_t)
    return Polytope(lower, upper, U.G, U.low, U.high)


@njit(cache=True)
def radii_at(
    arm: Arm,
    motion: Motion,
    people: People,
    q: Vector,
    dq: Vector,
    ddq: Vector,
    human_acceleration: float,
    pairs: Separation,
) -> tuple[Vector, Vector]:
    """M and M_dot = dM/dx . x_dot of every pair, x = (q, dq, people), x_dot = (dq, ddq, people's velocities).

    motion: that of (q, dq). One linear program per pair: its vertex and multipliers tell how M moves with C, drift and
    the bounds (envelope theorem), which are evaluated once ahead and once behind. These have kinks (a joint enters its
    braking zone, a nearest point reaches a segment's end), so of the two sides the smaller counts: M falling is what
    harms.
    """
    p, n, h = pairs.d.shape[0], q.shape[0], DIFFERENCE_STEP
    M, slope = np.empty(p), np.empty(p)
    if p == 0:
        return M, slope
    U = control_set(arm, motion, q, dq)
    torque_counts = False
    u, y = np.empty((p, n)), np.empty((p, n + U.G.shape[0]))
    for i in range(p):
        best = support(pairs.C[i], U)
        M[i], u[i], y[i] = pairs.drift[i] + best.value, best.u, best.y
        torque_counts = torque_counts or bool(np.abs(best.y[n:]).sum() > 0.0)
    C, drift = np.empty((2, p, n)), np.empty((2, p))
    ahead = _shifted(arm, people, q, dq, ddq, human_acceleration, pairs, h, U, torque_counts, C[0], drift[0])
    behind = _shifted(arm, people, q, dq, ddq, human_acceleration, pairs, -h, U, torque_counts, C[1], drift[1])
    for i in range(p):
        best = Support(M[i], u[i], y[i])
        right = (drift[0, i] - pairs.drift[i] + moved(best, pairs.C[i], U, C[0, i], ahead)) / h
        left = (pairs.drift[i] - drift[1, i] - moved(best, pairs.C[i], U, C[1, i], behind)) / h
        if abs(right) > JUMP:
            right = left
        if abs(left) > JUMP:
            left = right
        slope[i] = min(left, right) if abs(left) <= JUMP else 0.0
    return M, slope


@njit(cache=True)
def radii(
    arm: Arm, people: People, q: Vector, dq: Vector, ddq: Vector, human_acceleration: float, pairs: Separation
) -> tuple[Vector, Vector]:
    """`radii_at` of a state (q, dq)."""
    return radii_at(arm, forward(arm.chain, q, dq), people, q, dq, ddq, human_acceleration, pairs)
