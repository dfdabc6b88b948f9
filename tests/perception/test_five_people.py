"""A real Kinect frame of five people (PCL's, BSD-3; beside the checkout, not in it): all of them are covered.

    python -m tests.perception.test_five_people PICTURE.png

draws the capsules over what the camera saw. One camera and no picture of the empty room: floor and wall of the
background are made, and what is behind the five is unseen, hence occupied. This shows cover, not discrimination.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from asc_rt.perception import kernels
from asc_rt.perception.grid import Grid, View
from asc_rt.perception.parts import Parts, Tracker
from asc_rt.perception.volume import Volume
from drivers.cameras import pcd
from drivers.cameras.base import Depth, Intrinsics, frozen

FRAME = Path(__file__).parents[3] / "shared" / "data" / "pcl_five_people" / "five_people.pcd"
LENS = Intrinsics(640, 480, 525.0, 525.0, 319.5, 239.5)
LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # x forward, y left, z up
HEIGHT, WALL = 0.85, 3.6  # m, of the camera over the floor; to the wall
COLUMNS = ((20, 148), (152, 245), (280, 365), (372, 468), (475, 606))  # px, of each person; read off the picture
NEAR, FAR = 1.5, 2.9  # m: they stand between
STEP_NS = 66_000_000
NOWHERE = np.zeros((1, 3)), np.zeros((1, 3)), np.array([-9.0])


def empty_room() -> Depth:
    row = np.arange(480)[:, None] + np.zeros((1, 640))
    floor = np.where(row > 240, HEIGHT * LENS.fy / np.maximum(row - LENS.cy, 0.5), 9.0)
    return frozen(np.minimum(floor, WALL) * 1000)


def seen(depth: Depth) -> tuple[Grid, Parts]:
    T = np.eye(4)
    T[:3, :3] = LEVEL
    grid = Grid.over(np.array([1.3, -1.4, -0.7]), np.array([3.2, 1.4, 0.95]), 0.05)
    room = empty_room()
    volume = Volume(grid, [View(LENS, 0.001, T, room, grid)])
    assert not len(volume.update(0, [room], NOWHERE)), "nobody is in the empty room"
    for k in range(1, 8):
        told = volume.update(k * STEP_NS, [depth], NOWHERE)
    return grid, Tracker(20).update(0, told, told[:, 0] - 1.0)


def people(depth: Depth, grid: Grid) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """(points m, rows, columns) of each person's pixels inside the volume."""
    v, u = np.nonzero((depth > NEAR * 1000) & (depth < FAR * 1000))
    z = depth[v, u] * 0.001
    points = np.stack([(u - LENS.cx) / LENS.fx * z, (v - LENS.cy) / LENS.fy * z, z], 1) @ LEVEL.T
    inside = np.all((points > grid.origin) & (points < grid.origin + grid.size * np.array(grid.shape)), axis=1)
    masks = [inside & (u >= low) & (u < high) for low, high in COLUMNS]
    return [(points[m], v[m], u[m]) for m in masks]


@pytest.mark.skipif(not FRAME.is_file(), reason=f"{FRAME.name} is not beside the checkout")
def test_five_people_before_a_real_kinect_are_covered() -> None:
    depth = pcd.depth_image(FRAME)
    grid, parts = seen(depth)
    for points, _, _ in people(depth, grid):
        assert len(points) > 10_000
        assert kernels.distances(points, parts.p0, parts.p1, parts.radius).max() <= grid.half_diagonal


def picture() -> np.ndarray:
    """Each person's covered pixels in a colour of their own (what is not covered: red), and their nearest point."""
    depth = pcd.depth_image(FRAME)
    grid, parts = seen(depth)
    image = cv2.applyColorMap(np.clip(255 - depth * 0.06, 0, 255).astype(np.uint8), cv2.COLORMAP_BONE)
    image[depth == 0] = 0
    tints = ((90, 200, 90), (220, 160, 60), (60, 190, 230), (200, 120, 220), (170, 210, 80))
    for (points, v, u), tint in zip(people(depth, grid), tints, strict=True):
        off = kernels.distances(points, parts.p0, parts.p1, parts.radius)
        covered = off <= grid.half_diagonal
        for mask, colour in ((covered, tint), (~covered, (0, 0, 255))):
            image[v[mask], u[mask]] = 0.45 * image[v[mask], u[mask]] + 0.55 * np.array(colour)
        text = f"{100 * covered.mean():.0f} %  {points[:, 0].min():.2f} m"
        at = (int(np.median(u)) - 52, max(int(np.quantile(v, 0.002)) - 10, 16))
        cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1, cv2.LINE_AA)
    for p0, p1, radius in zip(parts.p0, parts.p1, parts.radius, strict=True):
        for end in (p0, p1):
            x, y, z = LEVEL.T @ end
            at = (round(LENS.fx * x / z + LENS.cx), round(LENS.fy * y / z + LENS.cy))
            cv2.circle(image, at, round(LENS.fx * radius / z), (230, 230, 230), 1, cv2.LINE_AA)
    return image


if __name__ == "__main__":
    cv2.imwrite(sys.argv[1], picture())
