"""What one camera is sure to see: upright rods of many widths at many distances, `python -m sim_hil seeing --rods`.

A rod is seen if the first capture that has it tells somebody where it stands. Between two rods the cell is empty.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from tqdm import tqdm

from asc_rt.config import load_cell
from asc_rt.core.system import System
from asc_rt.perception import kernels
from asc_rt.perception.grid import Grid, View
from asc_rt.perception.observer import Observer, Seen
from calibration.geometry import look_at
from sim_hil.depth import UNIT, Eye, Optics, Scene
from sim_hil.person import Array
from sim_hil.seeing import PERIOD, VOXEL, lens_of

WIDTHS = (0.005, 0.015, 0.03, 0.04, 0.055, 0.07, 0.1, 0.16)  # m
RANGES = (1.0, 1.5, 2.0, 2.5, 3.0, 3.5)  # m from the camera
PICTURES = {"640x480": Optics(640, 480, 525.0, 525.0), "160x120": Optics()}  # a Kinect's; the simulated cell's
CAMERA, TARGET = np.array([3.2, 1.6, 0.4]), (0.0, 1.6, 0.2)  # m
VOLUME = (-0.6, 1.1, -0.35), (2.4, 2.1, 1.0)  # m: a passage beside the arm, which hides none of it
ASIDE = (1.4, 1.8)  # m, y of the rods: in every picture
CLEARING = 20  # captures at most
FOOT, TOP = -0.2, 0.8  # m
POSE = np.radians([-90, -40, 0, 0, 0, 0])  # of the arm, away from them


@dataclass
class Bench:
    """One camera before the empty cell, and what perception makes of it."""

    scene: Scene
    eye: Eye
    observer: Observer
    t_ns: int = 0

    def look(self, rods: list[tuple[Array, Array, float]]) -> Seen:
        """One capture of those rods; [] none."""
        self.scene.rods(rods or [(np.full(3, 99.0), np.full(3, 99.0), 0.01)])
        self.t_ns += round(PERIOD * 1e9)
        return self.observer.observe(self.t_ns, [self.eye.sense()], POSE)


@lru_cache(maxsize=1)
def bench(picture: str) -> Bench:
    optics, params = PICTURES[picture], load_cell("fanuc-sim-truth").params
    scene, pose = Scene(params), look_at(CAMERA, TARGET)
    scene.pose(POSE)
    eye = Eye(scene, pose, optics, 1)
    grid = Grid.over(np.array(VOLUME[0]), np.array(VOLUME[1]), VOXEL)
    view = View(lens_of(optics), UNIT, pose, eye.empty(), grid)
    return Bench(scene, eye, Observer(System(params).model, grid, [view], [0.0]))


def seen(picture: str, width: float, far: float, tries: int) -> float:
    """Share of `tries` rods that are seen. A pure function."""
    rng, b = np.random.default_rng([round(width * 1e3), round(far * 10)]), bench(picture)
    b.eye.reseed(int(rng.integers(1 << 30)))
    found = 0
    for _ in range(tries):
        x, y = CAMERA[0] - far, rng.uniform(*ASIDE)
        rod = np.array([x, y, FOOT]), np.array([x, y, TOP]), width / 2
        cleared = any(not _tells(b.look([]), rod) for _ in range(CLEARING))  # of what the last one hid, and of noise
        found += cleared and _tells(b.look([rod]), rod)
    return found / tries


def _tells(told: Seen, rod: tuple[Array, Array, float]) -> bool:
    """A capsule reaches the rod, its bound counted."""
    p, points = told.parts, np.linspace(rod[0], rod[1], 20)
    near = kernels.distances(points, p.p0, p.p1, p.radius)
    return bool((near <= rod[2] + told.position_bound).any())


def table(tries: int, workers: int) -> dict[str, dict[str, dict[str, float]]]:
    """Share of rods that are seen, by picture, width (mm) and distance (m)."""
    jobs = [(picture, width, far, tries) for picture in PICTURES for width in WIDTHS for far in RANGES]
    with ProcessPoolExecutor(workers) as pool:
        shares = iter(tqdm(pool.map(seen, *zip(*jobs, strict=True)), total=len(jobs), disable=None))
    return {
        picture: {f"{1e3 * width:.0f}": {f"{far:g}": next(shares) for far in RANGES} for width in WIDTHS}
        for picture in PICTURES
    }
