"""The last look before the wire. It verifies and never reshapes: a set-point is sent as it is or the robot is stopped.

Every limit is inside the QP already; what fails here is a defect somewhere before, and clipping would only hide it.
"""

from __future__ import annotations

import numpy as np

from asc_rt.core.safe_control import SOLVER_MARGIN
from asc_rt.core.smoothing import SetPoint
from asc_rt.core.system import System
from asc_rt.core.types import CoreState, Matrix, Vector

# Share of each limit that rounding may take; ten times what `smoothing` plans with.
ROUNDING = 1e-5


def may_pass(system: System, state: CoreState, point: SetPoint) -> bool:
    """Finite, and inside the position, velocity, acceleration and jerk limits of the robot."""
    b, T = system.bounds, system.params.period
    values = np.concatenate((point.q, point.dq, point.ddq))
    jerk = (point.ddq - state.ddq_cmd) / T
    step = (point.q - state.q_cmd) / T
    wide = 1.0 + ROUNDING
    return bool(
        np.all(np.isfinite(values))
        and np.all((point.q >= b.q_min - ROUNDING) & (point.q <= b.q_max + ROUNDING))
        and np.all(np.abs(point.dq) <= wide * b.dq_max)
        and np.all(np.abs(step) <= wide * b.dq_max)
        and np.all(np.abs(point.ddq) <= wide * b.ddq_max)
        and np.all(np.abs(jerk) <= wide * b.dddq_max)
    )


def torque_may_pass(system: System, point: SetPoint) -> bool:
    """Finite, and inside the torque and acceleration limits. Positions and speeds are measured here, not commanded."""
    values = np.concatenate((point.ddq, point.tau))
    return bool(
        np.all(np.isfinite(values))
        and np.all(np.abs(point.tau) <= (1.0 + ROUNDING) * system.model.arm.effort)
        and np.all(np.abs(point.ddq) <= (1.0 + ROUNDING) * system.bounds.ddq_max)
    )


def keeps_rows(point: SetPoint, C: Matrix, floor: Vector) -> bool:
    """The acceleration that is really sent satisfies every safety row."""
    return bool(np.all(C @ point.ddq >= floor - SOLVER_MARGIN))
