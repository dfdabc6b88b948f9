"""The controls that the arm really has in a state: joint limits that stay feasible, and torque limits."""

from __future__ import annotations

import numpy as np
from numba import njit

from asc_rt.core.dynamics import inertia_and_bias
from asc_rt.core.kinematics import Motion
from asc_rt.core.limits import acceleration_box
from asc_rt.core.polytope import Polytope
from asc_rt.core.robot_model import Arm
from asc_rt.core.types import Vector


@njit(cache=True)
def with_torque(arm: Arm, motion: Motion, lower: Vector, upper: Vector) -> Polytope:
    """The box and, for a torque-controlled arm, -effort <= H u + h <= effort."""
    if arm.effort.shape[0] == 0:
        return Polytope(lower, upper, np.zeros((0, lower.shape[0])), np.zeros(0), np.zeros(0))
    H, h = inertia_and_bias(motion, arm.bodies)
    return Polytope(lower, upper, H, -arm.effort - h, arm.effort - h)


@njit(cache=True)
def control_set(arm: Arm, motion: Motion, q: Vector, dq: Vector) -> Polytope:
    """U(x), the set that M is computed from."""
    lower, upper = acceleration_box(arm.bounds, q, dq)
    return with_torque(arm, motion, lower, upper)
