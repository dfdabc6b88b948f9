"""Where people may be at the moment that counts: the newest message, carried forward and grown by its bounds.

A set-point sent now is reached one command latency later, so the commanded arm is compared with the people of then:
horizon = age + command latency. Positions move with the measured velocity; the radius grows by the position bound and
by velocity bound times horizon. Old data make a bigger person, never a frozen one.
"""

from __future__ import annotations

import numpy as np

from asc_rt.core.abstraction import People
from asc_rt.core.types import HumanState


def predict(human: HumanState | None, horizon: float) -> People:
    """The people `horizon` seconds after capture. Without data nobody: the caller must not be moving then (mode)."""
    if human is None:
        none = np.zeros((0, 3))
        return People(none, none, none, none, np.zeros(0), np.zeros(0))
    return People(
        human.p0 + horizon * human.v0,
        human.p1 + horizon * human.v1,
        human.v0,
        human.v1,
        human.radius + human.position_bound + abs(horizon) * human.velocity_bound,
        human.velocity_bound,
    )
