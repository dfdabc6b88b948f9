"""The compiled loops of perception. Grids and lists of voxels are flat, in C order of the grid's shape."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True)
def to_capsules(x: float, y: float, z: float, p0: np.ndarray, p1: np.ndarray, radius: np.ndarray) -> float:
    """Distance (m) of a point to the nearest surface of the capsules; negative inside."""
    least = np.inf
    for i in range(radius.shape[0]):
        ax, ay, az = p1[i, 0] - p0[i, 0], p1[i, 1] - p0[i, 1], p1[i, 2] - p0[i, 2]
        bx, by, bz = x - p0[i, 0], y - p0[i, 1], z - p0[i, 2]
        length = ax * ax + ay * ay + az * az
        s = 0.0
        if length > 0.0:
            s = min(max((ax * bx + ay * by + az * bz) / length, 0.0), 1.0)
        dx, dy, dz = bx - s * ax, by - s * ay, bz - s * az
        least = min(least, np.sqrt(dx * dx + dy * dy + dz * dz) - radius[i])
    return least


@njit(cache=True)
def foreground(
    depth: np.ndarray, background: np.ndarray, step: np.ndarray, unit: float, rays: np.ndarray, pixel_area: float,
    T: np.ndarray, origin: np.ndarray, size: float, shape: tuple[int, int, int], guarded: np.ndarray,
    p0: np.ndarray, p1: np.ndarray, radius: np.ndarray, area: np.ndarray, count: np.ndarray,
) -> None:  # fmt: skip
    """Adds to each voxel the seen surface (m2, and pixels) that is neither background nor robot.

    `step` (counts): how much nearer than the background counts as before it. Where no background is known, only voxels
    that the cameras can see empty count: what always stood in the dark is furniture.
    """
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            d, b = int(depth[v, u]), int(background[v, u])
            if d == 0 or (b > 0 and d > b - step[v, u]):
                continue
            z = d * unit
            cx, cy = rays[v, u, 0] * z, rays[v, u, 1] * z
            x = T[0, 0] * cx + T[0, 1] * cy + T[0, 2] * z + T[0, 3]
            y = T[1, 0] * cx + T[1, 1] * cy + T[1, 2] * z + T[1, 3]
            h = T[2, 0] * cx + T[2, 1] * cy + T[2, 2] * z + T[2, 3]
            i, j, k = int((x - origin[0]) // size), int((y - origin[1]) // size), int((h - origin[2]) // size)
            if i < 0 or j < 0 or k < 0 or i >= shape[0] or j >= shape[1] or k >= shape[2]:
                continue
            at = (i * shape[1] + j) * shape[2] + k
            if (b == 0 and not guarded[at]) or to_capsules(x, y, h, p0, p1, radius) <= 0.0:
                continue
            area[at] += z * z * pixel_area
            count[at] += 1


@njit(cache=True)
def carve(possible: np.ndarray, pixel: np.ndarray, far_side: np.ndarray, nearest: np.ndarray) -> None:
    """Takes away what a camera sees free: all of the voxel lies before the nearest thing in its window."""
    for at in range(possible.shape[0]):
        if possible[at] and pixel[at] >= 0 and far_side[at] < nearest[pixel[at]]:
            possible[at] = 0


@njit(cache=True)
def components(possible: np.ndarray, shape: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """(voxels that are possible), (their component, from 0): neighbours share a face, an edge or a corner."""
    nx, ny, nz = shape
    label = np.full(possible.shape[0], -1, np.int32)
    stack, found = np.empty(possible.shape[0], np.int32), np.flatnonzero(possible)
    n = 0
    for start in found:
        if label[start] >= 0:
            continue
        label[start], stack[0], top = n, start, 1
        while top > 0:
            top -= 1
            at = stack[top]
            i, j, k = at // (ny * nz), (at // nz) % ny, at % nz
            for a in range(max(i - 1, 0), min(i + 2, nx)):
                for b in range(max(j - 1, 0), min(j + 2, ny)):
                    for c in range(max(k - 1, 0), min(k + 2, nz)):
                        to = (a * ny + b) * nz + c
                        if possible[to] and label[to] < 0:
                            label[to], stack[top] = n, to
                            top += 1
        n += 1
    return found, label[found]


@njit(cache=True)
def distances(points: np.ndarray, p0: np.ndarray, p1: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """(n,) m, of the points to the capsules' surfaces."""
    out = np.empty(points.shape[0])
    for i in range(points.shape[0]):
        out[i] = to_capsules(points[i, 0], points[i, 1], points[i, 2], p0, p1, radius)
    return out


@njit(cache=True)
def assign(points: np.ndarray, centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n,) index of the nearest centre, (n,) squared distance to it."""
    index, square = np.empty(points.shape[0], np.int64), np.empty(points.shape[0])
    for i in range(points.shape[0]):
        best, where = np.inf, 0
        for c in range(centres.shape[0]):
            d = 0.0
            for k in range(3):
                e = points[i, k] - centres[c, k]
                d += e * e
            if d < best:
                best, where = d, c
        index[i], square[i] = where, best
    return index, square
