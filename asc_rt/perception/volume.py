"""Where people could be: space is occupied until a camera sees it free.

`possible` grows by the reach of a person (K = 2 m/s, ISO 13855) from one capture to the next, from itself and from
every place where people can come from unseen, and loses what any camera sees free. So a person who steps behind the
robot stays there, and the shadow behind a person is occupied. Without a seen surface is empty: a pocket that is
cut off from everything and in which nobody fits; and what joins the way in, until as much as an arm stays unseen there
for two captures.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from asc_rt.perception import kernels
from asc_rt.perception.grid import Grid, View, depth_sigma
from drivers.cameras.base import Depth

REACH_SPEED = 2.0  # m/s: nobody moves any part faster. ISO 13855's K for hands, ASSUMED for people near robots
PERSON_VOLUME = 0.040  # m3: a body takes more; in a smaller closed pocket there is none. ASSUMED: 40 kg
LEAST_AREA = 4e-4  # m2 of seen surface that is a thing, not noise: the detection capability (55 mm rods)
LEAST_PIXELS = 3
LEAST_INTRUSION = 0.002  # m3, 0.3 m of an arm, where people come in, without a seen surface
BACKGROUND_STEP = 0.025  # m before the background, at least


class Volume:
    """`update` with what the cameras saw. Raises nothing; without a camera everything that people reach is possible."""

    def __init__(self, grid: Grid, views: Sequence[View]) -> None:
        self.grid, self.views = grid, tuple(views)
        self._centres = grid.centres()
        self._free = [view.free(view.background) for view in views]
        self.guarded = np.logical_or.reduce(self._free)  # seen free in the empty cell
        self._sources = self._unseen_entries()
        self._steps = [steps(view) for view in views]
        self._possible = np.ones(len(self._centres), np.uint8)
        self._unseen = self._possible > 0  # at the last capture
        self._t_ns: int | None = None

    def coverage(self, sees: Sequence[bool]) -> float:
        """Share of the volume that those cameras see when nobody is there."""
        free = [mask for mask, one in zip(self._free, sees, strict=True) if one]
        return float(np.mean(np.logical_or.reduce(free))) if free else 0.0

    def update(
        self, t_ns: int, depths: Sequence[Depth | None], arm: tuple[np.ndarray, np.ndarray, np.ndarray]
    ) -> np.ndarray:
        """(n, 3) m: centres of the voxels that may hold somebody at t_ns. `arm`: its capsules grown by the margin."""
        seen, count = np.zeros(len(self._centres), np.float32), np.zeros(len(self._centres), np.int32)
        self._grow(t_ns)
        for view, step, depth in zip(self.views, self._steps, depths, strict=True):
            if depth is not None:
                self._find_surfaces(view, step, depth, arm, seen, count)
        self._possible[count > 0] = 1
        for view, depth in zip(self.views, depths, strict=True):
            if depth is not None:
                kernels.carve(self._possible, view.pixel, view.far_side, view.nearest(depth).ravel())
        self._take_out(arm)
        return self._keep_what_may_be_a_person(seen, count)

    def _grow(self, t_ns: int) -> None:
        """By the way that anybody can make since the last capture, also from where people come in unseen; the cylinder
        around that ball."""
        dt = 0.0 if self._t_ns is None else max(t_ns - self._t_ns, 0) * 1e-9
        self._t_ns = t_ns
        reach = min(REACH_SPEED * dt / self.grid.size, float(max(self.grid.shape)))
        n = int(np.ceil(reach)) + int(reach == 0.0)
        offset = np.maximum(np.abs(np.arange(-n, n + 1)) - 1, 0)
        disc = (np.hypot(offset[:, None], offset[None]) <= reach).astype(np.uint8)
        nx, ny, nz = self.grid.shape
        before = self._possible | self._sources
        up = cv2.dilate(before.reshape(nx * ny, nz), np.ones((1, 2 * n + 1), np.uint8)).reshape(nx, ny, nz)
        self._possible = np.ascontiguousarray(_each_layer(up, disc)).ravel()

    def _find_surfaces(
        self, view: View, step: np.ndarray, depth: Depth, arm: tuple[np.ndarray, np.ndarray, np.ndarray],
        seen: np.ndarray, count: np.ndarray,
    ) -> None:  # fmt: skip
        grid, lens = self.grid, view.lens
        kernels.foreground(
            depth, view.background, step, view.unit, view.rays, 1.0 / (lens.fx * lens.fy), view.T,
            grid.origin, grid.size, grid.shape, self.guarded, *arm, seen, count,
        )  # fmt: skip

    def _take_out(self, arm: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
        """The robot itself, and the shell around it within which nothing can be told from it."""
        found = np.flatnonzero(self._possible)
        inside = kernels.distances(self._centres[found], *arm) <= 0.0
        self._possible[found[inside]] = 0

    def _keep_what_may_be_a_person(self, seen: np.ndarray, count: np.ndarray) -> np.ndarray:
        found, label = kernels.components(self._possible, self.grid.shape)
        again = (self._unseen & self.guarded)[found]  # noise does not hide the same place twice
        self._unseen = self._possible > 0
        if not len(found):
            return np.zeros((0, 3))
        volume, entered = (np.bincount(label, weight) * self.grid.size**3 for weight in (None, again))
        is_thing = (np.bincount(label, seen[found]) >= LEAST_AREA) & (np.bincount(label, count[found]) >= LEAST_PIXELS)
        is_entry = np.bincount(label, self._sources[found]) > 0
        is_large = np.where(is_entry, entered >= LEAST_INTRUSION, volume >= PERSON_VOLUME)
        keep = (is_thing | is_large)[label]
        self._possible[found[~keep]] = 0
        told = found[keep]
        return self._centres[told[self.guarded[told] | (count[told] > 0)]]

    def _unseen_entries(self) -> np.ndarray:
        """Where somebody may come from: the sides of the volume, and what is never seen and joins them."""
        outer = np.zeros(self.grid.shape, bool)
        outer[[0, -1]] = outer[:, [0, -1]] = True
        hidden = (~self.guarded).astype(np.uint8)
        found, label = kernels.components(hidden, self.grid.shape)
        reaches_out = np.bincount(label, outer.ravel()[found]) > 0 if len(found) else np.zeros(0, bool)
        entries = outer.ravel().astype(np.uint8)
        entries[found[reaches_out[label]]] = 1
        return entries


def _each_layer(block: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    """Dilation in x and y of every layer of z: OpenCV takes layers as channels."""
    return cv2.dilate(np.ascontiguousarray(block), kernel)


def steps(view: View) -> np.ndarray:
    """(height, width) counts before the background that noise does not explain."""
    sigma = depth_sigma(view.background * view.unit)
    return np.rint(np.maximum(BACKGROUND_STEP, 4.0 * sigma) / view.unit).astype(np.int32)
