"""How a jerk-limited mover stops: one closed form for joints that run into a limit and for separation that runs out.

Along one axis, x grows towards the limit: speed v, acceleration a, deceleration at most A, jerk at most J.
"""

from __future__ import annotations

import math

from numba import njit


@njit(cache=True)
def stopping_distance(v: float, a: float, A: float, J: float) -> float:
    """Farthest advance before the mover is at rest (v = 0 and a = 0) on its fastest stop, m or rad; never negative.

    The acceleration is first brought to zero (speed then v1 = v + a^2 / 2J, where a < 0 rewinds the ramp), then an
    S-curve stops v1: distance v1/2 (v1/A + A/J) with a plateau, v1 sqrt(v1/J) without. A mover that already brakes so
    hard that it reverses before the ramp is over turns round at the first zero of v + a t + J t^2/2.
    """
    if a < 0.0 and v > 0.0 and a * a > 2.0 * J * v:
        t = (-a - math.sqrt(a * a - 2.0 * J * v)) / J
        return v * t + a * t * t / 2.0 + J * t * t * t / 6.0
    if a < 0.0 and v <= 0.0:
        return 0.0
    v1 = v + a * a / (2.0 * J)
    if v1 <= 0.0:
        return 0.0
    ramp = v * a / J + a * a * a / (3.0 * J * J)
    curve = v1 * math.sqrt(v1 / J) if v1 * J < A * A else v1 / 2.0 * (v1 / A + A / J)
    return max(0.0, ramp + curve)
