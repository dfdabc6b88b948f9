"""Where people may be at the moment that counts: the newest message, carried forward and grown by its bounds.

A set-point sent now is reached one command latency later, so the commanded arm is compared with the people of then:
horizon = age + command latency. Positions move with the measured velocity; the radius grows by the position bound and
by velocity bound times horizon. Old data make a bigger person, never a frozen one.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from asc_rt.core.abstraction import People
from asc_rt.core.types import HumanState, Matrix

COLUMNS = 15  # p0, p1, v0, v1, radius, position bound, velocity bound
NOBODY = np.zeros((0, COLUMNS))


def seen(human: HumanState | None) -> Matrix:
    """What a message says of people at capture, as one array for the kernels: (m, COLUMNS).

    Without data nobody: the caller must not be moving then (mode).
    """
    if human is None:
        return NOBODY
    out = np.empty((len(human.radius), COLUMNS))
    out[:, 0:3], out[:, 3:6], out[:, 6:9], out[:, 9:12] = human.p0, human.p1, human.v0, human.v1
    out[:, 12], out[:, 13], out[:, 14] = human.radius, human.position_bound, human.velocity_bound
    return out


@njit(cache=True)
def carried(people: Matrix, horizon: float) -> People:
    """The people `horizon` seconds after capture."""
    v0, v1, velocity_bound = people[:, 6:9].copy(), people[:, 9:12].copy(), people[:, 14].copy()
    return People(
        people[:, 0:3] + horizon * v0,
        people[:, 3:6] + horizon * v1,
        v0,
        v1,
        people[:, 12] + people[:, 13] + abs(horizon) * velocity_bound,
        velocity_bound,
    )


@njit(cache=True)
def is_finite(people: Matrix) -> bool:
    return bool(np.isfinite(people).all())


def predict(human: HumanState | None, horizon: float) -> People:
    """`carried` of a message."""
    return People(*carried(seen(human), horizon))
