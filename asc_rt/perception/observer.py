"""One capture of all cameras -> people as capsules with bounds. Pure: no clock, no bus, no camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asc_rt.core.robot_model import RobotModel
from asc_rt.core.types import Vector
from asc_rt.perception import kernels
from asc_rt.perception.arm import Arm
from asc_rt.perception.grid import Grid, View
from asc_rt.perception.parts import PARTS, Parts, Tracker
from asc_rt.perception.volume import Volume
from drivers.cameras.base import Depth

MARGIN = 0.06  # m around the robot in which nothing is told from it: covers 50 ms of time error at 1 rad/s. MEASURED


@dataclass(frozen=True, slots=True)
class Seen:
    t_ns: int
    parts: Parts
    position_bound: float  # m: how far a surface may lie outside its capsule
    around: float  # m: nobody outside the guarded volume is nearer to the arm


class Observer:
    """`observe` each capture, in order."""

    def __init__(
        self, model: RobotModel, grid: Grid, views: Sequence[View], pose_bounds: Sequence[float],
        margin: float = MARGIN, parts: int = PARTS,
    ) -> None:  # fmt: skip
        """`pose_bounds` (m): how far each camera's calibration may misplace a point anywhere in the volume; `parts`:
        capsules at most."""
        self.volume, self._tracker = Volume(grid, views), Tracker(parts)
        self._model, self._margin = model, margin
        self._arm = Arm(model)
        self.pose_bounds = tuple(pose_bounds)
        self._bound = grid.half_diagonal + max(pose_bounds, default=0.0)

    def coverage(self, sees: Sequence[bool]) -> float:
        """Share of the guarded volume that the cameras see which see at all."""
        return self.volume.coverage(sees)

    def to_arm(self, points: np.ndarray, q: Vector) -> np.ndarray:
        """(n,) m, of the points to the arm at q (rad)."""
        return kernels.distances(points, *self._arm.capsules(q), self._model.capsules.radius)

    def observe(self, t_ns: int, depths: Sequence[Depth | None], q: Vector) -> Seen:
        """`depths`: of each camera, captured at t_ns, None where there is none to be believed; `q` rad at t_ns."""
        p0, p1 = self._arm.capsules(q)
        grown = self._model.capsules.radius + self._margin
        points = self.volume.update(t_ns, depths, (p0, p1, grown))
        distance = kernels.distances(points, p0, p1, self._model.capsules.radius)
        around = self.volume.grid.around(p0, p1, self._model.capsules.radius)
        return Seen(t_ns, self._tracker.update(t_ns, points, distance), self._bound, around)
