"""What limbs may add to what the depth layer tells, and never take away. Pure.

They come after the capsules of the depth layer, as a body of their own, as many as there is room for, the nearest to
the arm first. So every distance to all capsules is at most the one to the depth layer's. A limb counts only beside
what the depth layer tells: one more than `NEAR` from it is made up, or somebody who has left; one that is inside says
nothing new.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from asc_rt import human_state_pb2 as pb
from asc_rt.perception.observer import Seen
from asc_rt.perception.pose.limbs import Found
from asc_rt.perception.volume import REACH_SPEED

NEAR = 0.10  # m: the shell around the robot (margin_m) with what a voxel is off
OLDEST_NS = 200_000_000
POSE_BODY = 2  # the depth layer's is 1


def added(
    found: Iterable[Found], seen: Seen, room: int, to_arm: Callable[[np.ndarray], np.ndarray]
) -> list[pb.Capsule]:
    """At most `room` of them, at the capture `seen.t_ns`; `to_arm`: (n, 3) m -> (n,) m, distance to the arm.

    Nobody knows how fast a limb moves: its position bound has grown by REACH_SPEED since its own capture, and goes on.
    """
    ranked = list[tuple[float, pb.Capsule]]()
    for one in found:
        age_ns = abs(seen.t_ns - one.t_ns)
        if age_ns > OLDEST_NS or not len(one.radius):
            continue
        bound = one.bound + REACH_SPEED * age_ns * 1e-9
        counts = _counts(one.p0, one.p1, one.radius + bound, seen)
        far = np.minimum(to_arm(one.p0), to_arm(one.p1)) - one.radius
        ranked += [(float(far[i]), _capsule(one, i, float(bound[i]))) for i in np.flatnonzero(counts).tolist()]
    return [capsule for _, capsule in sorted(ranked, key=lambda pair: pair[0])[: max(room, 0)]]


def _counts(p0: np.ndarray, p1: np.ndarray, radius: np.ndarray, seen: Seen) -> np.ndarray:
    """(m,) bool: both ends are beside what is told, and the whole is not inside one part of it."""
    if not len(seen.parts.radius):
        return np.zeros(len(radius), bool)
    worse = np.maximum(_to_each(p0, seen), _to_each(p1, seen))
    beside = np.maximum(_to_each(p0, seen).min(1), _to_each(p1, seen).min(1)) <= NEAR
    return np.asarray(beside & (worse.min(1) > -radius))


def _to_each(points: np.ndarray, seen: Seen) -> np.ndarray:
    """(points, parts) m to the surface of each part, its bound included; negative inside."""
    parts = seen.parts
    axis, apart = parts.p1 - parts.p0, points[:, None] - parts.p0
    length = np.maximum(np.einsum("pk,pk->p", axis, axis), 1e-12)
    s = np.clip(np.einsum("npk,pk->np", apart, axis) / length, 0.0, 1.0)
    off = np.linalg.norm(apart - s[..., None] * axis, axis=2)
    return np.asarray(off - parts.radius - seen.position_bound)


def _capsule(one: Found, i: int, bound: float) -> pb.Capsule:
    return pb.Capsule(
        label=one.names[i], p0=one.p0[i].tolist(), p1=one.p1[i].tolist(), radius=float(one.radius[i]),
        v0=(0.0, 0.0, 0.0), v1=(0.0, 0.0, 0.0), position_bound=bound, velocity_bound=REACH_SPEED,
        visibility=pb.PREDICTED,
    )  # fmt: skip
