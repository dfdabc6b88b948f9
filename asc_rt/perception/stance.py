"""Does a camera stand where it stood when the cell was commissioned?

What it measures near its background (floor, walls, furniture) is fitted to it point to plane: a small displacement xi
(translation t, rotation w, camera axes) moves a background point p with normal n by n . (t + w x p) along n, so

    min_xi sum_i ((n_i . (p_i - b_i) - [n_i, b_i x n_i] xi) / sigma_i)^2        over |n_i . (p_i - b_i)| < GATE

People and the robot stand out of the background by more than the gate, nearly everywhere. A camera that has turned by
5 degrees has no such pixels any more; that is what `drivers.cameras.watch.moved` finds.
"""

from __future__ import annotations

import numpy as np

from asc_rt.perception.grid import View, depth_sigma
from drivers.cameras.base import Depth

POINTS = 3000  # of the background that are looked at, about
SMOOTH = 0.25  # share of the newest picture's displacement: one picture alone is off by up to 20 mm
ARM = 2  # px, of the differences that normals come from
GATE = 0.12  # m
FLAT = 0.2  # share of the depth: neighbours farther apart than this are an edge
LEAST_POINTS = 60
LEAST_SHARE = 0.2  # of the background's points: of fewer nothing is said
REGULAR = 1e-4  # keeps the fit finite where the background shows no more than a plane: that motion cannot be seen
LIMIT = 0.02  # m: farther is MOVED; up to this it enters the position bound


class Stance:
    def __init__(self, view: View, corners: np.ndarray) -> None:
        """`corners` (k, 3) m, base frame: the places whose displacement counts."""
        self._at, b, n = _planes(view)
        sigma = np.maximum(depth_sigma(b[:, 2]), 1e-3)
        self._rays = view.rays[self._at]
        self._unit = view.unit
        self._b, self._n = b, n
        self._J, self._weight = np.hstack([n, np.cross(b, n)]), 1.0 / sigma
        self._xi = np.zeros(6)
        self._corners = (np.asarray(corners) - view.T[:3, 3]) @ view.T[:3, :3]

    def shift(self, depth: Depth) -> float | None:
        """m, the largest displacement of a corner, after this picture; None: too little background in it."""
        z = depth[self._at] * self._unit
        off = np.einsum("ij,ij->i", self._n, self._rays * z[:, None] - self._b)
        near = (z > 0) & (np.abs(off) < GATE)
        if np.count_nonzero(near) < max(LEAST_POINTS, LEAST_SHARE * len(z)):
            return None
        W = self._weight[near]
        J, r = self._J[near] * W[:, None], off[near] * W
        normal = J.T @ J
        xi = np.linalg.solve(normal + REGULAR * np.trace(normal) / 6.0 * np.eye(6), J.T @ r)
        self._xi += SMOOTH * (xi - self._xi)
        moved = self._xi[:3] + np.cross(self._xi[3:], self._corners)
        return float(np.linalg.norm(moved, axis=1).max())


def _planes(view: View) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray, np.ndarray]:
    """Pixels of the background with a surface around them: (rows, columns), (m, 3) m, (m, 3) normals, camera frame."""
    z = view.background * view.unit
    points = view.rays * z[..., None]
    height, width = z.shape
    stride = max(1, int(np.sqrt(z.size / POINTS)))
    v, u = (grid.ravel() for grid in np.mgrid[ARM : height - ARM : stride, ARM : width - ARM : stride])
    around = [(v, u - ARM), (v, u + ARM), (v - ARM, u), (v + ARM, u)]
    near = np.stack([z[at] for at in around])
    good = (z[v, u] > 0) & (near > 0).all(0) & (np.abs(near - z[v, u]).max(0) < FLAT * z[v, u])
    n = np.cross(points[around[1]] - points[around[0]], points[around[3]] - points[around[2]])
    n /= np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-12)
    return (v[good], u[good]), points[v, u][good], n[good]
