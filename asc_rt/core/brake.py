"""The stop profile: every joint to rest as fast as its acceleration and jerk limits allow, from the commanded state.

Planned anew each cycle from numbers in the state (the rest of an optimal stop is the optimal stop from there), never
from the measured pose: a re-seed would be a jump. Each joint on its own, because `limits` guarantees room for exactly
this stop.
"""

from __future__ import annotations

from numba import njit

from asc_rt.core.smoothing import SetPoint, profile
from asc_rt.core.system import System
from asc_rt.core.types import CoreState, Vector

# rad/s, rad/s2: under these the set-point is put to rest exactly.
REST_SPEED = 1e-9
REST_ACCELERATION = 1e-6


def brake(system: System, state: CoreState) -> SetPoint:
    """The set-point one period on along the stop. Raises smoothing.SmoothingError."""
    if at_rest(state):
        return SetPoint(state.q_cmd, system.zero, system.zero, system.zero)
    zeros = [0.0] * system.n
    return profile(system, state, zeros, zeros)


def at_rest(state: CoreState) -> bool:
    return bool(_rests(state.dq_cmd, state.ddq_cmd))


@njit(cache=True)
def _rests(dq: Vector, ddq: Vector) -> bool:
    rests = True
    for i in range(dq.shape[0]):
        rests = rests and abs(dq[i]) < REST_SPEED and abs(ddq[i]) < REST_ACCELERATION
    return rests
