"""What a camera sees in the empty cell: made once when the cell is commissioned, refused for any other camera.

The file (.npz) holds the depth with the unit, and the hash of what it belongs to: device, mode and calibration results.
Whoever changes one of them has to make it anew.
"""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from asc_rt.core.robot_model import RobotModel
from asc_rt.core.types import Vector
from asc_rt.perception import kernels
from asc_rt.perception.arm import Arm
from asc_rt.perception.grid import View
from drivers.cameras.base import CameraInfo, Depth, frozen

LEAST_SAMPLES = 10  # of a pixel that are not the arm; with fewer nothing is known there
FRAMES = 30  # 2 s of a camera at 15 Hz


class BackgroundError(Exception):
    """The background is missing or belongs to something else; says what to do."""


@dataclass(frozen=True, slots=True)
class Background:
    depth: Depth  # counts; 0: never seen without the arm before it
    belongs_to: str  # hash of device and calibration

    def save(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(path, depth=self.depth, belongs_to=np.array(self.belongs_to))


def belongs_to(info: CameraInfo, calibration: bytes) -> str:
    """Hash of the device (not of its firmware: that is compared by its pictures) and of its calibration results."""
    lens = info.intrinsics
    numbers = [lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion, info.unit_m]
    told = json.dumps([info.model, info.serial, lens.mode, numbers, calibration.hex()])
    return hashlib.sha256(told.encode()).hexdigest()


def load(path: Path, info: CameraInfo, calibration: bytes) -> Background:
    """BackgroundError: no such file, or one of another camera or calibration."""
    try:
        with np.load(path, allow_pickle=False) as file:
            found = Background(frozen(file["depth"]), str(file["belongs_to"]))
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise BackgroundError(f"{path}: no background of a camera: {error}; {_MAKE}") from error
    if found.belongs_to != belongs_to(info, calibration):
        why = "made with another camera, mode or calibration"
        raise BackgroundError(f"{path}: {why} (camera {info.serial}, {info.intrinsics.mode}); {_MAKE}")
    if found.depth.shape != (info.intrinsics.height, info.intrinsics.width):
        raise BackgroundError(f"{path}: {found.depth.shape[1]} x {found.depth.shape[0]} px; {_MAKE}")
    return found


_MAKE = "empty the cell and make it by asc perceive CELL --background"


def learn(
    frames: Sequence[Depth], view_rays: np.ndarray, T_base_cam: np.ndarray, unit: float, model: RobotModel, q: Vector,
    margin: float,
) -> Depth:  # fmt: skip
    """Per pixel the median of all measurements that are not the arm, which stands at `q` (rad); 0 where there are fewer
    than LEAST_SAMPLES."""
    p0, p1 = Arm(model).capsules(q)
    grown = model.capsules.radius + margin
    stack = np.stack([frame.astype(np.float32) for frame in frames])
    for depth in stack:
        points = (view_rays * (depth * unit)[..., None]).reshape(-1, 3) @ T_base_cam[:3, :3].T + T_base_cam[:3, 3]
        on_arm = (kernels.distances(points, p0, p1, grown) <= 0.0).reshape(depth.shape)
        depth[on_arm] = 0.0
    stack[stack == 0.0] = np.nan
    count = np.sum(~np.isnan(stack), axis=0)
    with np.errstate(all="ignore"):
        middle = np.nanmedian(np.where(count > 0, stack, 0.0), axis=0)
    return frozen(np.where(count >= LEAST_SAMPLES, np.rint(middle), 0))


def merged(old: Depth, new: Depth) -> Depth:
    """`new`, and what only `old` knows: the arm stood elsewhere then."""
    return frozen(np.where(new > 0, new, old))


def known(depth: Depth) -> float:
    """Share of the pixels with a background."""
    return float(np.count_nonzero(depth) / depth.size)


def coverage(views: Sequence[View]) -> float:
    """Share of the guarded volume that these views see when nobody is there."""
    seen: Any = np.zeros(len(views[0].pixel), bool)
    for view in views:
        seen |= view.free(view.background)
    return float(np.mean(seen))
