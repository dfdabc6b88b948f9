"""The last look before the wire. It verifies and never reshapes: a set-point is sent as it is or the robot is stopped.

Every limit is inside the QP already; what fails here is a defect somewhere before, and clipping would only hide it.
"""

from __future__ import annotations

from numba import njit

from asc_rt.core import safe_control
from asc_rt.core.limits import Bounds
from asc_rt.core.safe_control import SOLVER_MARGIN
from asc_rt.core.smoothing import SetPoint
from asc_rt.core.system import System
from asc_rt.core.types import CoreState, Matrix, Mode, Vector

# Share of each limit that rounding may take; ten times what `smoothing` plans with.
ROUNDING = 1e-5


def may_pass(system: System, state: CoreState, point: SetPoint) -> bool:
    """Finite, and inside the position, velocity, acceleration and jerk limits of the robot."""
    before, T = (state.q_cmd, state.ddq_cmd), system.params.period
    # While it stops a tool may have come that has to go slower.
    fastest = system.bounds.dq_max if state.mode is Mode.ACTIVE else system.stop_speed
    return bool(_position_may_pass(system.bounds, fastest, before, (point.q, point.dq, point.ddq), T))


@njit(cache=True)
def _position_may_pass(
    b: Bounds, fastest: Vector, before: tuple[Vector, Vector], point: tuple[Vector, Vector, Vector], T: float
) -> bool:
    """before: (q, ddq); every comparison is False for what is not a number."""
    wide = 1.0 + ROUNDING
    q, dq, ddq = point
    for i in range(q.shape[0]):
        if not (
            b.q_min[i] - ROUNDING <= q[i] <= b.q_max[i] + ROUNDING
            and abs(dq[i]) <= wide * fastest[i]
            and abs(q[i] - before[0][i]) <= T * wide * fastest[i]
            and abs(ddq[i]) <= wide * b.ddq_max[i]
            and abs(ddq[i] - before[1][i]) <= T * wide * b.dddq_max[i]
        ):
            return False
    return True


def torque_may_pass(system: System, point: SetPoint) -> bool:
    """Finite, and inside the torque and acceleration limits. Positions and speeds are measured here, not commanded."""
    return bool(_torque_may_pass(system.bounds.ddq_max, system.model.arm.effort, point.ddq, point.tau))


@njit(cache=True)
def _torque_may_pass(ddq_max: Vector, effort: Vector, ddq: Vector, tau: Vector) -> bool:
    wide, within = 1.0 + ROUNDING, True
    for i in range(ddq.shape[0]):
        within = within and abs(ddq[i]) <= wide * ddq_max[i] and abs(tau[i]) <= wide * effort[i]
    return within


def keeps_rows(point: SetPoint, C: Matrix, floor: Vector) -> bool:
    """The acceleration that is really sent satisfies every safety row."""
    return bool(safe_control.keeps_rows(point.ddq, C, floor - SOLVER_MARGIN))
