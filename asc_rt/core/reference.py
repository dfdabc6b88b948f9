"""The nominal controller: where the robot would go if nobody were there.

Ruckig's time-optimal, jerk-limited way from the commanded state to the goal, planned anew each cycle from numbers in
the state; the reference control is its acceleration one period from now. Ruckig stands *before* the filter: put
behind it, its own idea of the acceleration broke the safety row in 25-42 % of the steps (facts, real-time Python 6.1).
"""

from __future__ import annotations

import ruckig
from numba import njit

from asc_rt.core.system import System
from asc_rt.core.types import CoreState, StopReason, Vector, vector


def reference(system: System, state: CoreState) -> Vector:
    """u_ref, (n,) rad/s2. A plan that Ruckig refuses asks for zero acceleration; the box then brakes where it must."""
    request = ruckig.InputParameter(system.n)
    request.current_position = state.q_cmd.tolist()
    request.current_velocity = state.dq_cmd.tolist()
    request.current_acceleration = state.ddq_cmd.tolist()
    request.target_position = state.goal.q.tolist()
    limits = system.wanted_limits if state.slow is StopReason.NONE else system.slow_limits
    request.max_velocity, request.max_acceleration, request.max_jerk = limits
    plan = ruckig.Trajectory(system.n)
    try:
        result = system.planner.calculate(request, plan)
    except ruckig.RuckigError:
        return system.zero
    if result not in (ruckig.Result.Working, ruckig.Result.Finished):
        return system.zero
    return vector(plan.at_time(system.params.period)[2])


def reached(system: System, state: CoreState) -> bool:
    """The set-point has come to rest at the goal, within the tolerance per joint."""
    tolerance = system.params.task.goal_tolerance
    return state.goal.id > 0 and bool(_is_at(state.goal.q, state.q_cmd, state.dq_cmd, tolerance))


@njit(cache=True)
def _is_at(goal: Vector, q: Vector, dq: Vector, tolerance: float) -> bool:
    there = True
    for i in range(goal.shape[0]):  # speed: what is left of it would take a second to leave the tolerance
        there = there and abs(q[i] - goal[i]) <= tolerance and abs(dq[i]) <= tolerance
    return there
