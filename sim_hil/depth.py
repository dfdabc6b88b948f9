"""What a depth camera in the simulated cell sees: MuJoCo's rays, then a sensor's faults. Own optics, no product code.

Noise, shadow and dropouts follow a structured-light sensor (Kinect v1 class): sigma = 1.2 + 1.9 (z - 0.4)^2 mm, a
projector 75 mm beside the lens whose shadow has no depth, and 0.2 % of the pixels missing. Frame: x right, y down,
z forward in the camera; poses are T_base_cam.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from asc_rt.core.params import Params
from sim_hil.person import FLOOR_Z, Array
from sim_hil.plant import MujocoPlant, Wall, build

FARTHEST = 8.0  # m
WALL = 3.4  # m from the base axis: the room has something to see behind the cell
ROOM: tuple[Wall, ...] = (
    *(((x * WALL, 0.0, FLOOR_Z + 1.5), (0.05, WALL, 1.5)) for x in (-1, 1)),
    *(((0.0, y * WALL, FLOOR_Z + 1.5), (WALL, 0.05, 1.5)) for y in (-1, 1)),
)
BASELINE = 0.075  # m, lens to projector
DROPOUT = 0.002
UNIT = 0.001  # m per count


@dataclass(frozen=True, slots=True)
class Optics:
    width: int = 160
    height: int = 120
    fx: float = 112.0  # px: 71 x 56 degrees
    fy: float = 112.0

    @property
    def cx(self) -> float:
        return (self.width - 1) / 2

    @property
    def cy(self) -> float:
        return (self.height - 1) / 2


class Scene(MujocoPlant):
    """The plant seen: arm, person, floor and a room around. Nothing moves by itself: place by `pose`, `set_person`."""

    def __init__(self, params: Params) -> None:
        super().__init__(params)
        self._moving = np.array([*self._robot_geoms, *self._person_geoms])
        self._model.geom_group[:] = 0
        self._model.geom_group[self._moving] = 1

    @property
    def model(self) -> Any:
        return self._model

    @property
    def data(self) -> Any:
        return self._data

    def spheres(self) -> tuple[Array, Array]:
        """Centres and radii around all that moves."""
        return self._data.geom_xpos[self._moving], self._model.geom_rbound[self._moving]

    def _built(self, params: Params) -> Any:
        return build(params, ROOM)

    def pose(self, q: npt.ArrayLike) -> None:
        """The arm stands there."""
        self._data.qpos[:] = q
        mujoco.mj_kinematics(self._model, self._data)

    def rods(self, rods: list[tuple[Array, Array, float]]) -> None:
        """Capsules (end, end, radius) in the place of a person: test targets."""
        from sim_hil.person import Capsules

        ends0, ends1, radii = (np.array(part, float) for part in zip(*rods, strict=True))
        still = np.zeros_like(ends0)
        self.set_person(Capsules(tuple(f"rod{i}" for i in range(len(rods))), ends0, ends1, radii, still, still))


class Eye:
    """One camera. `see` is the truth of a ray per pixel, `sense` what the sensor makes of it."""

    def __init__(self, scene: Scene, T_base_cam: Array, optics: Optics, seed: int) -> None:
        self._scene, self._mount, self._optics = scene, T_base_cam, optics
        self._rng = np.random.default_rng(seed)
        u, v = np.meshgrid(np.arange(optics.width), np.arange(optics.height))
        rays = np.stack([(u - optics.cx) / optics.fx, (v - optics.cy) / optics.fy, np.ones(u.shape)], -1)
        self._length = np.linalg.norm(rays, axis=-1).ravel()
        self._rays = rays.reshape(-1, 3) / self._length[:, None]
        self._moved: Array | None = None
        self.move(np.eye(4))

    def move(self, moved: Array) -> None:
        """From where it was mounted, (4, 4) in its own frame."""
        if self._moved is not None and np.array_equal(moved, self._moved):
            return
        self._moved, self._T = moved, self._mount @ moved
        self._directions = self._rays @ self._T[:3, :3].T
        self._empty = self._cast(np.arange(len(self._rays)), static=True)

    def reseed(self, seed: int) -> None:
        """The noise of another day."""
        self._rng = np.random.default_rng((seed, round(1e3 * float(self._T[1, 3])) + 10_000))

    def empty(self) -> npt.NDArray[np.uint16]:
        """What stands there without arm and people, counts: what a camera learns when the cell is commissioned."""
        return np.rint(self._empty / UNIT).astype(np.uint16).reshape(self._optics.height, self._optics.width)

    def see(self) -> Array:
        """(height, width) m along the optical axis; 0: nothing within reach."""
        depth = self._empty.copy()
        near = np.flatnonzero(self._near_something())
        found = self._cast(near, static=False)
        depth[near] = np.where((found > 0) & ((found < depth[near]) | (depth[near] == 0)), found, depth[near])
        return depth.reshape(self._optics.height, self._optics.width)

    def sense(self) -> npt.NDArray[np.uint16]:
        """Counts of UNIT with shadow, noise and dropouts."""
        z = self.see()
        z = np.where(self._in_shadow(z), 0.0, z)
        sigma = (1.2 + 1.9 * (z - 0.4) ** 2) * 1e-3
        noisy = z + sigma * self._rng.standard_normal(z.shape)
        noisy[(z == 0) | (self._rng.random(z.shape) < DROPOUT)] = 0.0
        return np.clip(np.rint(noisy / UNIT), 0, 65535).astype(np.uint16)

    def _cast(self, pixels: npt.NDArray[Any], static: bool) -> Array:
        """Depth of these pixels' rays on what stands still, or on arm and person."""
        scene, n = self._scene, len(pixels)
        if n == 0:
            return np.zeros(0)
        groups = np.array([static, not static, 0, 0, 0, 0], np.uint8)
        ids, distance = np.zeros(n, np.int32), np.zeros(n)
        rays = np.ascontiguousarray(self._directions[pixels]).ravel()
        mujoco.mj_multiRay(
            scene.model, scene.data, self._T[:3, 3], rays, groups, 1, -1, ids, distance, None, n, FARTHEST
        )
        return np.where(ids >= 0, distance / self._length[pixels], 0.0)

    def _near_something(self) -> npt.NDArray[np.bool_]:
        """Pixels whose ray passes the bounding sphere of anything that moves: the others see the empty room.

        A ray meets a sphere in direction `to` with radius r where it goes at least sqrt(to^2 - r^2) along `to`.
        """
        centres, radii = self._scene.spheres()
        to = centres - self._T[:3, 3]
        tangent = np.einsum("ij,ij->i", to, to) - radii**2  # negative: the camera is in the sphere
        least = np.where(tangent > 0, np.sqrt(np.maximum(tangent, 0.0)), -np.inf)
        return np.any(self._directions @ to.T >= least, axis=1)

    def _in_shadow(self, z: Array) -> npt.NDArray[np.bool_]:
        """The projector stands right of the lens: what something nearer, farther right, hides from it."""
        o = self._optics
        u = np.broadcast_to(np.arange(o.width), z.shape)
        disparity = np.where(z > 0, o.fx * BASELINE / np.maximum(z, 1e-6), 0.0)
        seen_at = u - disparity  # column in the projector's picture
        nearest = np.minimum.accumulate(seen_at[:, ::-1], axis=1)[:, ::-1]
        hidden = np.zeros(z.shape, bool)
        hidden[:, :-1] = seen_at[:, :-1] > nearest[:, 1:] + 0.5
        return hidden
