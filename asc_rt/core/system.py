"""Params made ready for the cycle: model, limit arrays, planner; and the first state. Built before the robot is
touched."""

from __future__ import annotations

import numpy as np
import ruckig

from asc_rt.core import robot_model
from asc_rt.core.params import Params
from asc_rt.core.safety_index import index_of
from asc_rt.core.types import CoreState, Goal, Mode, StopReason, Vector, vector

# The reference leaves this share of the limits to the filter, so that following it exactly never sits on a bound.
REFERENCE_SHARE = 0.95
# Rounding of (u - ddq) / T must not make the exact profile look too fast.
ROUNDING = 1.0 + 1e-6


class System:
    """Nothing in here changes from cycle to cycle; the planner keeps no state between calculate() calls."""

    def __init__(self, params: Params, stop_speed: Vector | None = None) -> None:
        """`stop_speed`: (n,) rad/s, the arm's own limit: a tool that has to go slower may come while it is faster."""
        self.params = params
        self.n = params.n
        self.stop_speed = stop_speed if stop_speed is not None else np.array(params.robot.dq_max)
        self._held = tuple(System(params.holding(i), self.stop_speed) for i in range(len(params.changer.mounts)))
        first = params.holding(0)
        r = first.robot
        self.model = robot_model.load(r, first.tool, params.control)
        self.bounds = self.model.arm.bounds
        self.index = index_of(params.safety, at_once=params.control == "torque")
        self.packed_index = vector(self.index)
        self.zero = vector(np.zeros(params.n))
        self.planner = ruckig.Ruckig(self.n)
        # Lists, as the planner takes them: velocity, acceleration, jerk of the reference; the last two of what is sent.
        acceleration, jerk = [REFERENCE_SHARE * a for a in r.ddq_max], [REFERENCE_SHARE * j for j in r.dddq_max]
        fastest, slow = min(REFERENCE_SHARE, params.task.speed), min(params.task.speed, params.task.slow_speed)
        self.wanted_limits = [fastest * v for v in r.dq_max], acceleration, jerk
        self.slow_limits = [slow * v for v in r.dq_max], acceleration, jerk  # while something asks for caution
        self.smoothing_limits = ([ROUNDING * a for a in r.ddq_max], [ROUNDING * j for j in r.dddq_max])

    def holding(self, mount: int) -> System:
        """Ready for the tool of this mount: everything that a cycle needs, built before the loop."""
        return self._held[mount] if self._held else self


def initial(system: System) -> CoreState:
    """Before the first sample of the robot."""
    zero = vector(np.zeros(system.n))
    return CoreState(
        tick=0,
        mode=Mode.IDLE,
        reason=StopReason.NONE,
        slow=StopReason.NONE,
        q_cmd=zero,
        dq_cmd=zero,
        ddq_cmd=zero,
        goal=Goal(0, zero),
        reached_id=0,
        event_id=0,
        silent_cycles=0,
        ending=False,
        tool=0,
    )
