"""The nominal controller: where the robot would go if nobody were there.

Ruckig's time-optimal, jerk-limited way from the commanded state to the goal, planned anew each cycle from numbers in
the state; the reference control is its acceleration one period from now. Ruckig stands *before* the filter: put
behind it, its own idea of the acceleration broke the safety row in 25-42 % of the steps (facts, real-time Python 6.1).
"""

from __future__ import annotations

import numpy as np
import ruckig

from asc_rt.core.system import System
from asc_rt.core.types import CoreState, Vector, vector

# The reference leaves this share of the limits to the filter, so that following it exactly never sits on a bound.
SHARE = 0.95


def reference(system: System, state: CoreState) -> Vector:
    """u_ref, (n,) rad/s2. A plan that Ruckig refuses asks for zero acceleration; the box then brakes where it must."""
    r = system.params.robot
    request = ruckig.InputParameter(system.n)
    request.current_position = state.q_cmd.tolist()
    request.current_velocity = state.dq_cmd.tolist()
    request.current_acceleration = state.ddq_cmd.tolist()
    request.target_position = state.goal.q.tolist()
    request.max_velocity = [min(SHARE, system.params.task.speed) * v for v in r.dq_max]
    request.max_acceleration = [SHARE * a for a in r.ddq_max]
    request.max_jerk = [SHARE * j for j in r.dddq_max]
    plan = ruckig.Trajectory(system.n)
    try:
        result = system.planner.calculate(request, plan)
    except ruckig.RuckigError:
        return vector([0.0] * system.n)
    if result not in (ruckig.Result.Working, ruckig.Result.Finished):
        return vector([0.0] * system.n)
    return vector(plan.at_time(system.params.period)[2])


def reached(system: System, state: CoreState) -> bool:
    """The set-point has come to rest at the goal, within the tolerance per joint."""
    tolerance = system.params.task.goal_tolerance
    near = np.abs(state.q_cmd - state.goal.q) <= tolerance
    slow = np.abs(state.dq_cmd) <= tolerance  # rad/s: what is left would take a second to leave the tolerance
    return bool(np.all(near & slow)) and state.goal.id > 0
