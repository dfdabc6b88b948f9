"""From unit random numbers to a state: joint angles, speeds, and a person's point beside one robot capsule; compiled.

The point is uniform on the surface at distance d of the capsule: its foot along the axis is uniform over the length of
the offset surface (on the two round ends by Archimedes' theorem), the angle around it is uniform. So the separation
distance of the pair is d itself, uniform in the stated range.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from asc_rt.core.abstraction import People, place
from asc_rt.core.kinematics import forward
from asc_rt.core.robot_model import Arm
from asc_rt.core.types import Matrix, Vector
from asc_rt.synthesis.kernel import COLUMNS, Conditions, evaluate

EXTRA = 7  # unit numbers beyond q and dq: capsule, foot, angle, distance, and three of the person's velocity


class Draw(NamedTuple):
    """What is drawn from; see sampling.Ranges for the meaning and the units."""

    capsules: np.ndarray  # (c,) indices of the robot capsules
    d_low: float
    d_high: float
    speed_share: float
    human_speed: float
    given: Conditions
    fixed: np.ndarray  # (3,) m, where the point always is; (0,): drawn


class State(NamedTuple):
    q: np.ndarray  # (n,) rad
    dq: np.ndarray  # (n,) rad/s
    capsule: int
    people: People  # one point


def width(n: int) -> int:
    """Unit numbers that one state of an n-joint arm takes."""
    return 2 * n + EXTRA


@njit(cache=True, nogil=True)
def realise(arm: Arm, draw: Draw, unit: Vector) -> State:
    """The state that `unit`, (width,), stands for. No joint is faster than lets it stop before its limit."""
    n = arm.chain.offset.shape[0]
    b = arm.bounds
    q, dq = np.empty(n), np.empty(n)
    for i in range(n):
        q[i] = b.q_min[i] + unit[i] * (b.q_max[i] - b.q_min[i])
        ahead = behind = b.dq_max[i]
        if draw.given.limited:
            ahead = min(ahead, math.sqrt(2.0 * b.ddq_max[i] * (b.q_max[i] - q[i])))
            behind = min(behind, math.sqrt(2.0 * b.ddq_max[i] * (q[i] - b.q_min[i])))
        dq[i] = draw.speed_share * (unit[n + i] * (ahead + behind) - behind)
    rest = unit[2 * n :]
    capsule = draw.capsules[min(draw.capsules.shape[0] - 1, int(rest[0] * draw.capsules.shape[0]))]
    point, velocity = np.empty((1, 3)), np.empty((1, 3))
    if draw.fixed.shape[0] > 0:
        point[0] = draw.fixed
    else:
        d = draw.d_low + rest[3] * (draw.d_high - draw.d_low)
        _beside(arm, q, capsule, d, rest[1], 2.0 * math.pi * rest[2], point[0])
    z, angle, speed = 2.0 * rest[4] - 1.0, 2.0 * math.pi * rest[5], draw.human_speed * rest[6]
    across = math.sqrt(max(0.0, 1.0 - z * z))
    velocity[0, 0], velocity[0, 1] = speed * across * math.cos(angle), speed * across * math.sin(angle)
    velocity[0, 2] = speed * z
    return State(q, dq, capsule, People(point, point, velocity, velocity, np.zeros(1), np.zeros(1)))


@njit(cache=True, nogil=True)
def _beside(arm: Arm, q: Vector, capsule: int, d: float, along: float, angle: float, out: Vector) -> None:
    """The point at distance d of the capsule's surface."""
    motion = forward(arm.chain, q, np.zeros(q.shape[0]))
    p0 = np.array(place(motion, arm.capsules.joint[capsule], arm.capsules.p0[capsule]))
    p1 = np.array(place(motion, arm.capsules.joint[capsule], arm.capsules.p1[capsule]))
    axis = np.array((0.0, 0.0, 1.0))
    length = math.sqrt((p1[0] - p0[0]) ** 2 + (p1[1] - p0[1]) ** 2 + (p1[2] - p0[2]) ** 2)
    if length > 1e-9:
        axis = (p1 - p0) / length
    reach = d + arm.capsules.radius[capsule]
    z = along * (length + 2.0 * reach) - reach
    past = z if z < 0.0 else max(0.0, z - length)  # beyond an end: on its sphere
    across = math.sqrt(max(0.0, reach * reach - past * past))
    least = 0
    for k in range(1, 3):
        if abs(axis[k]) < abs(axis[least]):
            least = k
    e = np.zeros(3)
    e[least] = 1.0
    side = e - axis[least] * axis
    side /= math.sqrt(1.0 - axis[least] ** 2)
    for k in range(3):
        a, b = (k + 1) % 3, (k + 2) % 3
        other = axis[a] * side[b] - axis[b] * side[a]
        out[k] = p0[k] + z * axis[k] + across * (math.cos(angle) * side[k] + math.sin(angle) * other)


@njit(cache=True, nogil=True)
def evaluate_all(arm: Arm, draw: Draw, units: Matrix, ball: bool) -> Matrix:
    """(N, COLUMNS) for the N states of `units`, (N, width)."""
    out = np.empty((units.shape[0], COLUMNS))
    for i in range(units.shape[0]):
        s = realise(arm, draw, units[i])
        evaluate(arm, draw.given, s.people, s.q, s.dq, s.capsule, ball, out[i])
    return out
