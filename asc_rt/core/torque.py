"""Driving an arm by torque: tau = H(q) u + h(q, dq) with u the joint acceleration that was decided."""

from __future__ import annotations

import numpy as np

from asc_rt.core.brake import at_rest
from asc_rt.core.dynamics import inertia_and_bias
from asc_rt.core.kinematics import forward
from asc_rt.core.polytope import Polytope
from asc_rt.core.realizable import with_torque
from asc_rt.core.safe_control import project
from asc_rt.core.smoothing import SetPoint, SmoothingError
from asc_rt.core.system import System
from asc_rt.core.types import CoreState, CycleInputs, Vector, vector

REST_SPEED = 0.01  # ASSUMED, rad/s: slower than this the arm is held where it is
# ASSUMED: reference towards a goal, 1/s: speed per distance and acceleration per speed error. Critically damped at 4:1.
GOAL_RATE = 3.0
SPEED_RATE = 12.0
# ASSUMED: holding a pose, 1/s2 and 1/s. A model error of 1 rad/s2 moves the arm by 1 / HOLD_STIFFNESS rad.
HOLD_STIFFNESS = 900.0
HOLD_DAMPING = 60.0


def reference(system: System, state: CoreState) -> Vector:
    """u = SPEED_RATE (dq_ref - dq), dq_ref = GOAL_RATE (q_goal - q), all joints slowed alike to the task's speed."""
    wish = GOAL_RATE * (state.goal.q - state.q_cmd)
    most = float(np.max(np.abs(wish) / (system.params.task.speed * system.bounds.dq_max)))
    return vector(SPEED_RATE * (wish / max(1.0, most) - state.dq_cmd))


def stop(system: System, state: CoreState, x: CycleInputs) -> SetPoint:
    """Hold the pose at rest, else bring every joint to rest within its limits; torque limits come first.

    Raises SmoothingError if no torque within the limits exists (an arm that its brakes must catch).
    """
    b, T = system.bounds, system.params.period
    q, dq = (x.joint.q, x.joint.dq) if x.joint is not None else (state.q_cmd, state.dq_cmd)
    hold = HOLD_STIFFNESS * (state.q_cmd - q) - HOLD_DAMPING * dq
    wish = hold if at_rest(state) else -dq / (4.0 * T)
    U = with_torque(system.model.arm, forward(system.model.chain, q, dq), -b.ddq_max, b.ddq_max)
    u = project(np.clip(wish, -b.ddq_max, b.ddq_max), U, b.ddq_max)
    if u is None:
        raise SmoothingError("no torque within the limits brakes the arm")
    point = set_point(system, q, dq, u)
    if at_rest(state):
        zero = vector(np.zeros(system.n))
        return SetPoint(state.q_cmd, zero, zero, point.tau)
    return point


def set_point(system: System, q: Vector, dq: Vector, u: Vector) -> SetPoint:
    H, h = inertia_and_bias(forward(system.model.chain, q, dq), system.model.arm.bodies)
    T = system.params.period
    tau = (H * u).sum(axis=1) + h
    return SetPoint(vector(q + T * dq), vector(dq + T * u), vector(u), vector(tau))


def command_set(system: System, q: Vector, dq: Vector, lower: Vector, upper: Vector) -> Polytope:
    """This period's controls: the joint box and the torque limits, if the arm has them."""
    return with_torque(system.model.arm, forward(system.model.chain, q, dq), lower, upper)
