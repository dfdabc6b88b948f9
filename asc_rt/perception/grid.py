"""The guarded volume as voxels, and one camera's view of it."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from asc_rt.core.types import Matrix
from drivers.cameras.base import Depth, Intrinsics

__all__ = ["Grid", "Intrinsics", "View", "depth_sigma", "without_specks"]

WINDOWS = (3, 5, 7, 9, 13, 19, 27, 39, 55)  # px: what a voxel may cover of the picture, rounded up
NEAREST = 0.35  # m: depth sensors measure nothing nearer
NOISE_SIGMAS = 3.0


def depth_sigma(z: np.ndarray) -> np.ndarray:
    """Standard deviation (m) of a depth z (m). ASSUMED: a structured-light sensor of the Kinect v1 class."""
    return (1.2 + 1.9 * (z - 0.4) ** 2) * 1e-3


class Grid(NamedTuple):
    """Voxel (i, j, k) is the cube of edge `size` around origin + size (i + 1/2, j + 1/2, k + 1/2), base frame."""

    origin: np.ndarray  # (3,) m
    size: float  # m
    shape: tuple[int, int, int]

    @classmethod
    def over(cls, low: Matrix, high: Matrix, size: float) -> Grid:
        shape = np.maximum(np.rint((np.asarray(high) - low) / size).astype(int), 1)
        return cls(np.array(low, float), size, (int(shape[0]), int(shape[1]), int(shape[2])))

    @property
    def half_diagonal(self) -> float:
        """m, from the centre of a voxel to its corner."""
        return float(np.sqrt(0.75) * self.size)

    def around(self, p0: np.ndarray, p1: np.ndarray, radius: np.ndarray) -> float:
        """m, from these capsules to the nearest of the four sides, where people come in; negative: they stick out."""
        low, high = self.origin[:2], self.origin[:2] + self.size * np.array(self.shape[:2])
        ends, r = np.vstack([p0, p1])[:, :2], np.tile(radius, 2)[:, None]
        return float(min((ends - low - r).min(), (high - ends - r).min()))

    def corners(self) -> np.ndarray:
        """(8, 3) m, of the whole."""
        return np.asarray(self.origin + self.size * np.array(list(np.ndindex(2, 2, 2))) * self.shape)

    def centres(self) -> np.ndarray:
        """(voxels, 3) m, in C order of `shape`."""
        index = np.stack(np.meshgrid(*(np.arange(n) for n in self.shape), indexing="ij"), -1).reshape(-1, 3)
        return np.asarray(self.origin + self.size * (index + 0.5))


class View:
    """What one camera can say about the voxels. T_base_cam maps camera to base; z forward, x right, y down."""

    def __init__(self, lens: Intrinsics, unit: float, T_base_cam: Matrix, background: Depth, grid: Grid) -> None:
        self.lens, self.unit, self.T, self.background = lens, unit, np.array(T_base_cam, float), background
        self.rays = rays_of(lens)
        centres = (grid.centres() - self.T[:3, 3]) @ self.T[:3, :3]
        z = centres[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = _project(lens, centres)
            needed = lens.fx * grid.size / z + 1.0  # px across, and one more for mixed pixels
            level = np.minimum(np.searchsorted(WINDOWS, needed), len(WINDOWS) - 1)
        half = np.array(WINDOWS)[level] // 2
        inside = (z > NEAREST) & (u >= half) & (v >= half) & (u < lens.width - half) & (v < lens.height - half)
        u, v = (np.where(inside, np.rint(x), 0).astype(np.int64) for x in (u, v))
        flat = (level * lens.height + v) * lens.width + u
        self.pixel = np.where(inside, flat, -1).astype(np.int32)
        self.levels = int(level[inside].max(initial=0)) + 1
        self.far_side = ((z + grid.size / 2 + NOISE_SIGMAS * depth_sigma(z)) / unit).astype(np.float32)  # counts

    def nearest(self, depth: Depth) -> Depth:
        """(levels, height, width) counts: the least depth within each window; 0 where any pixel of it has no
        measurement. Each window is made from the one before it."""
        found = np.empty((self.levels, *depth.shape), np.uint16)
        before, width = without_specks(depth), 1
        for level, window in enumerate(WINDOWS[: self.levels]):
            more = window - width + 1
            cv2.erode(before, np.ones((more, more), np.uint8), dst=found[level])
            before, width = found[level], window
        return found

    def free(self, depth: Depth) -> np.ndarray:
        """(voxels,) bool: all of the voxel lies before what the camera sees."""
        nearest = self.nearest(depth).ravel()
        return (self.pixel >= 0) & (self.far_side < nearest[np.maximum(self.pixel, 0)])


def without_specks(depth: Depth) -> Depth:
    """A lone missing pixel takes the least depth beside it: it hides nothing that is wider than a pixel. Two
    together stay missing."""
    missing = (depth == 0).astype(np.uint8)
    ring = np.ones((3, 3), np.uint8)
    ring[1, 1] = 0
    lone = (missing > 0) & (cv2.dilate(missing, ring) == 0)
    return np.where(lone, cv2.erode(depth, ring), depth)


def rays_of(lens: Intrinsics) -> np.ndarray:
    """(height, width, 3) the direction of each pixel, z = 1."""
    u, v = np.meshgrid(np.arange(lens.width, dtype=float), np.arange(lens.height, dtype=float))
    K = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
    xy = np.stack([u, v], -1).reshape(-1, 1, 2)
    xy = cv2.undistortPoints(xy, K, np.array(lens.distortion or (0.0,) * 5)).reshape(lens.height, lens.width, 2)
    return np.concatenate([xy, np.ones((lens.height, lens.width, 1))], -1)


def _project(lens: Intrinsics, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if not any(lens.distortion):
        return lens.fx * points[:, 0] / points[:, 2] + lens.cx, lens.fy * points[:, 1] / points[:, 2] + lens.cy
    K = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
    uv = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(lens.distortion))[0].reshape(-1, 2)
    return uv[:, 0], uv[:, 1]
