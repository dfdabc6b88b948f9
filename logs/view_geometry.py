"""Where everything is in the picture: arms, capsules and the lines between them, for many cycles at once.

All arrays have the cycle first; everything is in the base frame, in metres. Plain numpy, a second time beside the
compiled kernels of the core: the picture shows what was recorded, it must not share the slips of what decided.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from asc_rt.core.kinematics import Chain
from asc_rt.core.robot_model import RobotModel

Array = np.ndarray[Any, Any]

TINY = 1e-12


class Segments(NamedTuple):
    """Capsules: m segments of every cycle, each with its radius."""

    p0: Array  # (r, m, 3)
    p1: Array  # (r, m, 3)
    radius: Array  # (r, m)

    def take(self, index: Array) -> Segments:
        """The segments of `index` (r, k), cycle by cycle."""
        return Segments(
            np.take_along_axis(self.p0, index[..., None], axis=1),
            np.take_along_axis(self.p1, index[..., None], axis=1),
            np.take_along_axis(self.radius, index, axis=1),
        )


class Poses(NamedTuple):
    """The same as the viewer wants it: from the origin along +z for `length`."""

    origin: Array  # (..., 3)
    quaternion: Array  # (..., 4) x y z w
    length: Array  # (...)


def forward(chain: Chain, q: Array) -> tuple[Array, Array]:
    """Rotation (r, n, 3, 3) and origin (r, n, 3) of every joint frame at joint positions q (r, n)."""
    count, n = q.shape
    rotations, origins = np.empty((count, n, 3, 3)), np.empty((count, n, 3))
    rotation, origin = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    for i in range(n):
        origin = origin + rotation @ chain.offset[i]
        rotation = rotation @ chain.rotation[i] @ about(chain.axis[i], q[:, i])
        rotations[:, i], origins[:, i] = rotation, origin
    return rotations, origins


def about(axis: Array, angle: Array) -> Array:
    """Rotations (r, 3, 3) by the angles (r,) about one axis."""
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle)[:, None, None] * K + (1.0 - np.cos(angle))[:, None, None] * (K @ K)


def robot_segments(model: RobotModel, q: Array) -> Segments:
    """The capsules of arm and tool at joint positions q (r, n)."""
    rotations, origins = forward(model.chain, q)
    base = np.zeros((len(q), 1, 3))
    rotations = np.concatenate([np.tile(np.eye(3), (len(q), 1, 1, 1)), rotations], axis=1)
    origins = np.concatenate([base, origins], axis=1)
    joint = model.capsules.joint + 1  # -1 is the base
    p0, p1 = (
        origins[:, joint] + np.einsum("rmij,mj->rmi", rotations[:, joint], local)
        for local in (model.capsules.p0, model.capsules.p1)
    )
    return Segments(p0, p1, np.tile(model.capsules.radius, (len(q), 1)))


def poses(segments: Segments) -> Poses:
    """The shortest turn that brings +z onto each segment; a point needs none."""
    along = segments.p1 - segments.p0
    length = np.linalg.norm(along, axis=-1)
    point = length < TINY
    z = np.where(point[..., None], [0.0, 0.0, 1.0], along / np.where(point, 1.0, length)[..., None])
    quaternion = np.stack([-z[..., 1], z[..., 0], np.zeros_like(length), 1.0 + z[..., 2]], axis=-1)
    quaternion[z[..., 2] < -1.0 + 1e-9] = (1.0, 0.0, 0.0, 0.0)
    quaternion /= np.linalg.norm(quaternion, axis=-1, keepdims=True)
    return Poses(segments.p0, quaternion, length)


def connecting_lines(robot: Segments, human: Segments) -> Array:
    """(r, k, 2, 3): from surface to surface where capsule i of `robot` and capsule i of `human` are nearest.

    The ends lie on the line that joins the nearest points of the axes. Where two capsules overlap they have changed
    sides, and the line is as long as the overlap is deep.
    """
    s, t = _nearest(robot, human)
    a = robot.p0 + s[..., None] * (robot.p1 - robot.p0)
    b = human.p0 + t[..., None] * (human.p1 - human.p0)
    gap = b - a
    distance = np.linalg.norm(gap, axis=-1, keepdims=True)
    direction = np.where(distance > TINY, gap / np.maximum(distance, TINY), [0.0, 0.0, 1.0])
    return np.stack([a + robot.radius[..., None] * direction, b - human.radius[..., None] * direction], axis=-2)


def _nearest(a: Segments, b: Segments) -> tuple[Array, Array]:
    """Parameters in [0, 1] of the nearest points: the best of the free solution and the four with an end point.

    The squared distance is convex in (s, t), so the least over the square is the free one or lies on its edge.
    """
    u, v, r = a.p1 - a.p0, b.p1 - b.p0, a.p0 - b.p0
    uu, vv, uv, ur, vr = (np.einsum("...i,...i", x, y) for x, y in ((u, u), (v, v), (u, v), (u, r), (v, r)))
    det = uu * vv - uv * uv
    free = det > 1e-9 * uu * vv
    safe = np.where(free, det, 1.0)
    zero, one = np.zeros_like(uu), np.ones_like(uu)
    s_on = lambda t: np.clip((uv * t - ur) / np.maximum(uu, TINY), 0.0, 1.0)  # noqa: E731
    t_on = lambda s: np.clip((uv * s + vr) / np.maximum(vv, TINY), 0.0, 1.0)  # noqa: E731
    inner_s = np.clip(np.where(free, (uv * vr - vv * ur) / safe, 0.0), 0.0, 1.0)
    inner_t = np.clip(np.where(free, (uu * vr - uv * ur) / safe, 0.0), 0.0, 1.0)
    S = np.stack([inner_s, zero, one, s_on(zero), s_on(one)])
    T = np.stack([inner_t, t_on(zero), t_on(one), zero, one])
    w = r + S[..., None] * u - T[..., None] * v
    best = np.einsum("...i,...i", w, w).argmin(axis=0)[None]
    return np.take_along_axis(S, best, axis=0)[0], np.take_along_axis(T, best, axis=0)[0]
