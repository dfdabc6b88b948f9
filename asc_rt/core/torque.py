"""Driving an arm by torque: tau = H(q) u + h(q, dq) with u the joint acceleration that was decided."""

from __future__ import annotations

import numpy as np
from numba import njit

from asc_rt.core import polytope
from asc_rt.core.brake import at_rest
from asc_rt.core.dynamics import inertia_and_bias
from asc_rt.core.kinematics import forward
from asc_rt.core.realizable import with_torque
from asc_rt.core.robot_model import unpack
from asc_rt.core.safe_control import project
from asc_rt.core.smoothing import SetPoint, SmoothingError
from asc_rt.core.system import System
from asc_rt.core.types import CoreState, CycleInputs, Matrix, StopReason, Vector, frozen

REST_SPEED = 0.01  # ASSUMED, rad/s: slower than this the arm is held where it is
# ASSUMED, 1/s: speed per distance and acceleration per speed error, critically damped at 1:4. On the way to a goal, and
# where the arm is held: there a model error, or rounding of the torques, of 1 rad/s2 leaves it 1 / 900 rad off, on the
# way 1 / 36.
ON_THE_WAY = (3.0, 12.0)
HELD = (15.0, 60.0)


def reference(system: System, state: CoreState) -> Vector:
    """u = b (dq_ref - dq), dq_ref = a (q_goal - q), all joints slowed alike to the task's speed. A goal that has been
    reached is held, at the speed with which the arm came into its tolerance."""
    task = system.params.task
    if state.reached_id == state.goal.id and np.all(np.abs(state.goal.q - state.q_cmd) <= task.goal_tolerance):
        creep = np.full(system.n, ON_THE_WAY[0] * task.goal_tolerance)
        return frozen(_towards(state.goal.q, state.q_cmd, state.dq_cmd, creep, *HELD))
    speed = task.speed if state.slow is StopReason.NONE else min(task.speed, task.slow_speed)
    return frozen(_towards(state.goal.q, state.q_cmd, state.dq_cmd, speed * system.bounds.dq_max, *ON_THE_WAY))


@njit(cache=True)
def _towards(goal: Vector, q: Vector, dq: Vector, fastest: Vector, a: float, b: float) -> Vector:
    wish = a * (goal - q)
    return b * (wish / max(1.0, np.max(np.abs(wish) / fastest)) - dq)


def stop(system: System, state: CoreState, x: CycleInputs) -> SetPoint:
    """Hold the pose at rest, else bring every joint to rest within its limits; torque limits come first.

    Raises SmoothingError if no torque within the limits exists (an arm that its brakes must catch).
    """
    b, T = system.bounds, system.params.period
    q, dq = (x.joint.q, x.joint.dq) if x.joint is not None else (state.q_cmd, state.dq_cmd)
    wish = _towards(state.q_cmd, q, dq, b.dq_max, *HELD) if at_rest(state) else -dq / (4.0 * T)
    U = _brakes(system.model.packed, q, dq)
    u = project(np.clip(wish, -b.ddq_max, b.ddq_max), U, b.ddq_max)
    if u is None:
        raise SmoothingError("no torque within the limits brakes the arm")
    point = set_point(system, q, dq, u)
    if at_rest(state):
        return SetPoint(state.q_cmd, system.zero, system.zero, point.tau)
    return point


def set_point(system: System, q: Vector, dq: Vector, u: Vector) -> SetPoint:
    return SetPoint(*frozen(_set_point(system.model.packed, q, dq, u, system.params.period)))


@njit(cache=True)
def _set_point(packed: Vector, q: Vector, dq: Vector, u: Vector, T: float) -> Matrix:
    """(q, dq) one period on, u and tau = H u + h, (4, n)."""
    arm, n = unpack(packed), u.shape[0]
    H, h = inertia_and_bias(forward(arm.chain, q, dq), arm.bodies)
    point = np.empty((4, n))
    for i in range(n):
        point[0, i], point[1, i], point[2, i], point[3, i] = q[i] + T * dq[i], dq[i] + T * u[i], u[i], h[i]
        for j in range(n):
            point[3, i] += H[i, j] * u[j]
    return point


@njit(cache=True)
def _brakes(packed: Vector, q: Vector, dq: Vector) -> Matrix:
    """The controls that a stop may use, as a packed polytope."""
    arm = unpack(packed)
    return polytope.pack(with_torque(arm, forward(arm.chain, q, dq), -arm.bounds.ddq_max, arm.bounds.ddq_max))
