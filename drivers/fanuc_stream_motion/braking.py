"""The driver's own stop, for when nobody decides any more: jerk-limited, all joints together, from what was sent."""

from __future__ import annotations

import numpy as np

from asc_rt.core.types import Matrix, Vector, vector

LONGEST = 400  # cycles


def stop_way(sent: list[Vector], limits: Matrix, period: float) -> list[Vector]:
    """The set-points that bring the arm to rest after `sent` (the last three, (6,) rad, oldest first).

    With s = k / N the speed is v(s) = v0 (1 - 3 s^2 + 2 s^3) + a0 N T (s - 2 s^2 + s^3): from v0 and a0 to rest. N is
    the least whose accelerations and jerks, differenced as the controller does, stay inside `limits` (3, 6), for both
    conventions of J3; or LONGEST if none does.
    """
    rows = _both(np.array(sent))
    v0 = (rows[2] - rows[1]) / period
    a0 = (v0 - (rows[1] - rows[0]) / period) / period
    allowed = np.column_stack([limits, limits[:, 2]])
    speeds = np.zeros((1, rows.shape[1]))
    for count in range(1, LONGEST + 1):
        s = np.arange(1, count + 1)[:, None] / count
        speeds = v0 * (1 - 3 * s**2 + 2 * s**3) + a0 * count * period * (s - 2 * s**2 + s**3)
        at_rest = np.zeros((2, rows.shape[1]))
        acceleration = np.diff(np.vstack([v0, speeds, at_rest]), axis=0) / period
        jerk = np.diff(np.vstack([a0, acceleration]), axis=0) / period
        if np.all(np.abs(acceleration) <= allowed[1]) and np.all(np.abs(jerk) <= allowed[2]):
            break
    way = sent[-1] + np.cumsum(speeds[:, :-1], axis=0) * period
    return [vector(q) for q in way]


def _both(q: Matrix) -> Matrix:
    """With FANUC's J3 as a seventh joint."""
    return np.column_stack([q, q[:, 2] - q[:, 1]])
