"""Jerk-limited set-points that reproduce the filtered acceleration to the bit of the limits.

Ruckig, velocity interface, from the commanded state: after one period the acceleration is u and the speed is the
trapezoid dq + T (ddq + u) / 2. The jerk bound |u - ddq| <= J T is inside the QP, so there is always such a profile.
"""

from __future__ import annotations

from dataclasses import dataclass

import ruckig

from asc_rt.core.system import System
from asc_rt.core.types import CoreState, Vector, vector


@dataclass(frozen=True, slots=True)
class SetPoint:
    q: Vector  # rad, one period on
    dq: Vector
    ddq: Vector
    tau: Vector  # Nm; zero for an arm that takes positions


class SmoothingError(Exception):
    """Ruckig has no profile for this acceleration; a limit did not hold where it should have."""


def smooth(system: System, state: CoreState, u: Vector) -> SetPoint:
    """The set-point one period on. Raises SmoothingError."""
    T = system.params.period
    target = state.dq_cmd + T * (state.ddq_cmd + u) / 2.0
    return profile(system, state, target.tolist(), u.tolist(), minimum_duration=T)


def profile(
    system: System,
    state: CoreState,
    dq: list[float],
    ddq: list[float],
    minimum_duration: float | None = None,
) -> SetPoint:
    """One period along Ruckig's profile from the commanded state to the speed dq and the acceleration ddq."""
    request = ruckig.InputParameter(system.n)
    request.control_interface = ruckig.ControlInterface.Velocity
    request.synchronization = ruckig.Synchronization.No
    request.current_position = state.q_cmd.tolist()
    request.current_velocity = state.dq_cmd.tolist()
    request.current_acceleration = state.ddq_cmd.tolist()
    request.target_velocity = dq
    request.target_acceleration = ddq
    request.max_acceleration, request.max_jerk = system.smoothing_limits
    if minimum_duration is not None:
        request.minimum_duration = minimum_duration
        request.synchronization = ruckig.Synchronization.Time
    plan = ruckig.Trajectory(system.n)
    try:
        result = system.planner.calculate(request, plan)
    except ruckig.RuckigError as error:
        raise SmoothingError(str(error)) from error
    if result not in (ruckig.Result.Working, ruckig.Result.Finished):
        raise SmoothingError(str(result))
    q, v, a = plan.at_time(system.params.period)
    return SetPoint(vector(q), vector(v), vector(a), system.zero)
