"""The cameras of a cell, opened and compared with what they are calibrated for; each is read by a thread of its own."""

from __future__ import annotations

import queue
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from asc_rt.cell_cameras import CameraOptions, PerceptionOptions
from asc_rt.core.robot_model import RobotModel
from asc_rt.core.types import MAX_CAPSULES
from asc_rt.faults import FaultsError
from asc_rt.perception import background
from asc_rt.perception.eye import Eye
from asc_rt.perception.grid import Grid, View
from asc_rt.perception.observer import Observer
from asc_rt.perception.parts import PARTS
from asc_rt.perception.stance import LIMIT, Stance
from calibration.result import Result
from drivers import registry
from drivers.cameras.base import CameraInfo, Depth, DepthCamera, DepthFrame, DriverError, Intrinsics

OPEN_S = 60.0  # a camera may need so long to come up
RETRY_S = 1.0
READ_NS = 200_000_000

Frames = queue.SimpleQueue[tuple[int, DepthFrame]]


class CameraError(FaultsError):
    """A camera that must not be used, or that is not there."""


@dataclass(frozen=True, slots=True)
class Opened:
    options: CameraOptions
    camera: DepthCamera
    info: CameraInfo  # with the lens that counts

    def view(self, grid: Grid, depth: Depth | None = None) -> View:
        """`depth`: the background; None: none is known yet."""
        lens = self.info.intrinsics
        empty = np.zeros((lens.height, lens.width), np.uint16) if depth is None else depth
        return View(lens, self.info.unit_m, self.options.pose.pose(), empty, grid)


def open_all(options: PerceptionOptions, stop: Sequence[int]) -> list[Opened]:
    """CameraError: one does not come up, or is not the one that the files are for."""
    opened, faults = [], []
    for camera in options.cameras:
        found = _open(camera, stop)
        faults += found if isinstance(found, list) else []
        opened += [found] if isinstance(found, Opened) else []
    if faults:
        for one in opened:
            one.camera.close()
        raise CameraError(faults)
    return opened


def grid_of(options: PerceptionOptions) -> Grid:
    return Grid.over(np.array(options.low), np.array(options.high), options.voxel)


def observer_of(
    options: PerceptionOptions, opened: Sequence[Opened], model: RobotModel, sensors: int
) -> tuple[Observer, list[Eye]]:
    """`sensors`: of the whole cell, which share the capsules that control takes.

    BackgroundError: a camera has none, or one of another camera or calibration.
    """
    grid = grid_of(options)
    depths = [background.load(one.options.background, one.info, one.options.digest).depth for one in opened]
    views = [one.view(grid, depth) for one, depth in zip(opened, depths, strict=True)]
    eyes = [
        Eye(one.options.name, one.info, view, one.options.offset_ns, Stance(view, grid.corners()))
        for one, view in zip(opened, views, strict=True)
    ]
    bounds = [pose_bound(one.options.pose, grid) for one in opened]
    parts = min(PARTS, MAX_CAPSULES // sensors)
    return Observer(model, grid, views, bounds, options.margin, parts), eyes


def pose_bound(pose: Result, grid: Grid) -> float:
    """m: how far a point anywhere in the volume may be misplaced: 3 sigma of the calibration, and as much as the camera
    may have moved since before it is noticed."""
    farthest = float(np.linalg.norm(grid.corners() - pose.pose()[:3, 3], axis=1).max())
    return pose.position_bound(farthest) + LIMIT


def _open(options: CameraOptions, stop: Sequence[int]) -> Opened | list[str]:
    camera = registry.camera_class(options.backend)(dict(options.device))
    deadline, told = time.monotonic() + OPEN_S, False
    while True:
        try:
            info = camera.open()
            break
        except DriverError as error:
            if stop or time.monotonic() > deadline:
                return [f"camera {options.name}: {error}; {error.hint}"]
            if not told:
                print(f"perception: waiting for camera {options.name}: {error}", file=sys.stderr)
            told = True
            time.sleep(RETRY_S / 4)
    faults = mismatches(options, info)
    if faults:
        camera.close()
        return faults
    return Opened(options, camera, with_lens(info, options))


def mismatches(options: CameraOptions, info: CameraInfo) -> list[str]:
    """What does not fit between the device and its calibration results."""
    results = {"calibration": options.pose, "intrinsics": options.lens, "time_offset": options.clock}
    faults = []
    for key, result in results.items():
        where = f"camera {options.name}: {key}"
        if result is None:
            continue
        made = result.serials.get("camera", "none")
        if made != info.serial:
            faults.append(f"{where}: made for camera {made!r}, this one is {info.serial!r}; use the file of this one")
        runs, bins = info.intrinsics, options.binning
        mode = f"{bins * runs.width}x{bins * runs.height}"
        if key == "intrinsics" and result.mode != mode:
            as_told = f"{runs.mode!r}" + (f", {mode!r} with binning {bins}" if bins > 1 else "")
            faults.append(f"{where}: made in {result.mode!r}, it runs in {as_told}; calibrate in that mode")
    return faults


def with_lens(info: CameraInfo, options: CameraOptions) -> CameraInfo:
    """`info` with the calibrated lens in place of the device's own. Pixel 0 of a binned picture has its middle between
    the first `binning` pixels, which is (binning - 1) / 2 of theirs."""
    if options.lens is None:
        return info
    lens, bins = info.intrinsics, options.binning
    fx, fy, cx, cy = options.lens.value[:4]
    middle = (bins - 1) / 2
    calibrated = Intrinsics(
        lens.width, lens.height, fx / bins, fy / bins, (cx - middle) / bins, (cy - middle) / bins,
        tuple(float(v) for v in options.lens.distortion()),
    )  # fmt: skip
    return replace(info, intrinsics=calibrated)


class Reader:
    """Reads one camera on a thread, into a queue. One that is unplugged is opened again and again until it is back: the
    same one, in the same mode, or it stays away."""

    def __init__(self, number: int, opened: Opened, frames: Frames, tell: Callable[[str], None]) -> None:
        self._number, self._opened, self._frames, self._tell = number, opened, frames, tell
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"camera {opened.options.name}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._closing.set()
        self._thread.join(2.0)
        self._opened.camera.close()

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                frame = self._opened.camera.read(time.monotonic_ns() + READ_NS)
            except DriverError as error:
                self._tell(f"camera {self._opened.options.name}: {error}; {error.hint}")
                self._open_again()
                continue
            if frame is not None:
                self._frames.put((self._number, frame))

    def _open_again(self) -> None:
        while not self._closing.wait(RETRY_S):
            try:
                info = with_lens(self._opened.camera.open(), self._opened.options)
            except DriverError:
                continue
            if (info.serial, info.intrinsics) == (self._opened.info.serial, self._opened.info.intrinsics):
                self._tell(f"camera {self._opened.options.name}: it is back")
                return
            self._tell(f"camera {self._opened.options.name}: another camera ({info.serial}) has come in its place")
            self._opened.camera.close()
