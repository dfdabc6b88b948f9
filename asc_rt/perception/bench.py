"""`asc bench perception`: CPU of one core for a frame of 640x480, per camera, from depth to capsules.

A made room (floor and walls by the lens), a person-sized column and the cell's arm before two cameras; watch, stance,
background, self-filter, carving, clusters and tracks included. Only what the camera itself costs is left out.
"""

from __future__ import annotations

import time
from itertools import count

import cv2
import numpy as np

from asc_rt.core.params import Params
from asc_rt.core.system import System
from asc_rt.core.types import Matrix
from asc_rt.perception.eye import CameraInfo, DepthFrame, Eye
from asc_rt.perception.grid import Grid, Intrinsics, View, rays_of
from asc_rt.perception.observer import Observer
from asc_rt.perception.stance import Stance
from calibration.geometry import look_at
from drivers.cameras.base import frozen

LENS = Intrinsics(640, 480, 448.0, 448.0, 319.5, 239.5)
EYES = ((0.3, 2.4, 2.6), (1.9, -1.6, 2.6))  # m
TARGET = (0.15, 0.0, -0.1)
LOW, HIGH, VOXEL = (-1.4, -1.5, -0.45), (1.8, 1.5, 1.15), 0.05
FLOOR, WALL = -0.6, 3.4  # m
PERSON = ((0.6, 0.6), 0.22, 1.1)  # m: where, radius, top
PERIOD_NS, FRAMES, WARM = 66_000_000, 40, 8
GOAL_MS = 12.0


def bench(params: Params) -> list[tuple[str, float]]:
    """(name, ms) of a frame of one camera: median and 90 % quantile of FRAMES."""
    cv2.setNumThreads(1)
    grid = Grid.over(np.array(LOW), np.array(HIGH), VOXEL)
    poses = [look_at(eye, TARGET) for eye in EYES]
    empty = [_depth(pose, person=False) for pose in poses]
    views = [View(LENS, 0.001, pose, frozen(depth * 1000), grid) for pose, depth in zip(poses, empty, strict=True)]
    info = CameraInfo("bench", "", "", LENS, 0.001, PERIOD_NS, 0)
    eyes = [Eye("", info, view, 0, Stance(view, grid.corners())) for view in views]
    observer = Observer(System(params).model, grid, views, [0.0] * len(views))
    somebody, rng, spent = [_depth(pose, person=True) for pose in poses], np.random.default_rng(1), []
    for k in range(FRAMES + WARM):
        noisy = [frozen(np.rint(d * 1000 + rng.normal(0, 5, d.shape))) for d in somebody]
        t_ns, number = (k + 1) * PERIOD_NS, count(k)
        begin = time.process_time()
        for eye, depth in zip(eyes, noisy, strict=True):
            eye.look(DepthFrame(depth, t_ns, 0, t_ns, t_ns, next(number)))
        observer.observe(t_ns, noisy, np.zeros(params.n))
        spent.append((time.process_time() - begin) * 1e3 / len(eyes))
    shares = {"median": 0.5, "p90": 0.9}
    return [(f"frame_640x480_{name}", float(np.quantile(spent[WARM:], share))) for name, share in shares.items()]


def _depth(T: Matrix, person: bool) -> Matrix:
    """(height, width) m of the room, and of an upright cylinder in it."""
    rays, at = rays_of(LENS) @ T[:3, :3].T, T[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        ways = [(side - at[i]) / rays[..., i] for i in (0, 1) for side in (-WALL, WALL)]
        depth = np.min([np.where(way > 0, way, 9.0) for way in [*ways, (FLOOR - at[2]) / rays[..., 2]]], axis=0)
        if person:
            (x, y), radius, top = PERSON
            a = rays[..., 0] ** 2 + rays[..., 1] ** 2
            b = rays[..., 0] * (at[0] - x) + rays[..., 1] * (at[1] - y)
            root = b * b - a * ((at[0] - x) ** 2 + (at[1] - y) ** 2 - radius**2)
            way = (-b - np.sqrt(root)) / a
            hit = (root > 0) & (way > 0) & (at[2] + way * rays[..., 2] < top)
            depth = np.where(hit & (way < depth), way, depth)
    return np.asarray(depth)
