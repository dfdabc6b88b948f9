"""Occupied voxels as few capsules: tracked clusters, each a capsule around all its voxels with its velocity.

The clusters are k-means whose centres live on from frame to frame, so each is a track: a Kalman filter of constant
velocity follows it, predicted with the capture stamps. A jump (gate) starts its velocity anew, never its place:
the capsules always cover every voxel.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from asc_rt.perception import kernels
from asc_rt.perception.volume import REACH_SPEED

PARTS = 16
ROUNDS = 2  # of k-means per frame
NEAR = 0.3  # m: so far from the robot clusters are as fine as beside it
ACCELERATION = 5.0  # m2/s3, spectral density; from hands measured at 30 Hz (q = 5 outside 4 sigma in 0.7 %)
CENTRE_SIGMA = 0.03  # m, of a cluster's centre. ASSUMED: half a voxel
GATE = 4.0
SIGMAS = 3.0


class Parts(NamedTuple):
    p0: np.ndarray  # (m, 3) m
    p1: np.ndarray
    radius: np.ndarray  # (m,) m, around the centres of the voxels
    velocity: np.ndarray  # (m, 3) m/s
    velocity_bound: np.ndarray  # (m,) m/s


class Tracker:
    def __init__(self, parts: int = PARTS) -> None:
        self._count = parts
        self._forget()

    def _forget(self) -> None:
        self._p, self._v = np.zeros((0, 3)), np.zeros((0, 3))
        self._P = np.zeros((0, 2, 2))
        self._t_ns = 0

    def update(self, t_ns: int, points: np.ndarray, distance: np.ndarray) -> Parts:
        """Capsules around all `points` (n, 3) m; `distance` (n,) m of each to the robot: near ones get finer parts."""
        if not len(points):
            self._forget()
            none = np.zeros((0, 3))
            return Parts(none, none, np.zeros(0), none, np.zeros(0))
        self._predict(t_ns)
        weight = 1.0 / (np.maximum(distance, 0.0) + NEAR)
        centres, index = self._cluster(points, weight)
        self._correct(centres)
        ends = [capsule(points[index == part]) for part in range(len(centres))]
        speed = np.linalg.norm(self._v, axis=1)
        bound = np.minimum(SIGMAS * np.sqrt(self._P[:, 1, 1]), REACH_SPEED + speed)
        p0, p1, radius = (np.array(column) for column in zip(*ends, strict=True))
        return Parts(p0, p1, radius, self._v.copy(), bound)

    def _predict(self, t_ns: int) -> None:
        dt = (t_ns - self._t_ns) * 1e-9
        self._t_ns = t_ns
        self._p = self._p + dt * self._v
        F, Q = np.array([[1, dt], [0, 1]]), ACCELERATION * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        self._P = F @ self._P @ F.T + Q

    def _cluster(self, points: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """k-means from the predicted centres; a centre without points is born again where the cover is worst."""
        centres = self._p
        for _ in range(ROUNDS):
            if len(centres):
                used = np.unique(kernels.assign(points, centres)[0])
                self._select(used)
                centres = centres[used]
            while len(centres) < min(self._count, len(points)):
                square = kernels.assign(points, centres)[1] if len(centres) else np.ones(len(points))
                worst = int(np.argmax(square * weight**2))
                if square[worst] == 0.0:
                    break
                centres = np.vstack([centres, points[worst]])
                self._bear(points[worst])
            index = kernels.assign(points, centres)[0]
            members = np.bincount(index, minlength=len(centres))
            sums = np.stack([np.bincount(index, points[:, k], len(centres)) for k in range(3)], 1)
            centres = np.where(members[:, None] > 0, sums / np.maximum(members, 1)[:, None], centres)
        index = kernels.assign(points, centres)[0]
        used = np.unique(index)
        self._select(used)
        return centres[used], np.searchsorted(used, index)

    def _select(self, used: np.ndarray) -> None:
        self._p, self._v, self._P = self._p[used], self._v[used], self._P[used]

    def _bear(self, point: np.ndarray) -> None:
        unknown = np.diag([CENTRE_SIGMA**2, (REACH_SPEED / SIGMAS) ** 2])
        self._p, self._v = np.vstack([self._p, point]), np.vstack([self._v, np.zeros(3)])
        self._P = np.concatenate([self._P, unknown[None]])

    def _correct(self, centres: np.ndarray) -> None:
        innovation = centres - self._p
        S = self._P[:, 0, 0] + CENTRE_SIGMA**2
        gain = self._P[:, :, 0] / S[:, None]
        jumped = np.linalg.norm(innovation, axis=1) > GATE * np.sqrt(S)
        self._p = np.where(jumped[:, None], centres, self._p + gain[:, :1] * innovation)
        self._v = np.where(jumped[:, None], 0.0, self._v + gain[:, 1:] * innovation)
        too_fast = np.maximum(np.linalg.norm(self._v, axis=1, keepdims=True) / REACH_SPEED, 1.0)
        self._v = self._v / too_fast
        left = np.eye(2) - gain[:, :, None] * np.array([1.0, 0.0])
        self._P = left @ self._P
        self._P[jumped] = np.diag([CENTRE_SIGMA**2, (REACH_SPEED / SIGMAS) ** 2])


def capsule(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """(end, end, radius) of a capsule around all points, along their longest extent.

    Radius r: the farthest from the axis. A cap at s covers a point at height t and distance c from the axis if
    |t - s| <= sqrt(r^2 - c^2): the ends are drawn in as far as that allows.
    """
    middle = points.mean(0)
    apart = points - middle
    axis = np.linalg.eigh(apart.T @ apart)[1][:, -1]
    t = apart @ axis
    across = np.sqrt(np.maximum(np.einsum("ij,ij->i", apart, apart) - t * t, 0.0))
    radius = float(across.max())
    slack = np.sqrt(np.maximum(radius**2 - across**2, 0.0))
    high, low = float(np.max(t - slack)), float(np.min(t + slack))
    if high < low:
        high = low = (high + low) / 2
    return middle + low * axis, middle + high * axis, radius
