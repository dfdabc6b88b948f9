"""Params made ready for the cycle: model, limit arrays, planner; and the first state. Built before the robot is
touched."""

from __future__ import annotations

import numpy as np
import ruckig

from asc_rt.core import robot_model
from asc_rt.core.params import Params
from asc_rt.core.types import CoreState, Goal, Mode, StopReason, vector


class System:
    """Nothing in here changes from cycle to cycle; the planner keeps no state between calculate() calls."""

    def __init__(self, params: Params) -> None:
        r = params.robot
        self.params = params
        self.n = params.n
        self.model = robot_model.load(r, params.tool, params.control)
        self.bounds = self.model.arm.bounds
        self.planner = ruckig.Ruckig(self.n)


def initial(system: System) -> CoreState:
    """Before the first sample of the robot."""
    zero = vector(np.zeros(system.n))
    return CoreState(
        tick=0,
        mode=Mode.IDLE,
        reason=StopReason.NONE,
        q_cmd=zero,
        dq_cmd=zero,
        ddq_cmd=zero,
        goal=Goal(0, zero),
        reached_id=0,
        event_id=0,
        silent_cycles=0,
        ending=False,
    )
