"""The [perception] table of a cell: its cameras with the calibration results that may be used today."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from asc_rt.cell_files import Camera, CellFile, Perception, Pose
from asc_rt.faults import Faults
from asc_rt.perception.pose import BACKENDS
from calibration.result import CalibrationError, Result, load
from drivers import registry

CAMERAS = "cameras"  # human.calibration of the sensor that these cameras are
LEAST_SIDE_M = 0.3


@dataclass(frozen=True, slots=True)
class CameraOptions:
    name: str
    backend: str  # of drivers.registry
    device: dict[str, Any]  # what its constructor takes
    pose: Result  # hand-eye: T_base_cam
    lens: Result | None  # intrinsics; None: what the device says
    clock: Result | None  # time offset: t_robot = t_camera + offset
    background: Path
    binning: int  # pixels of the lens's mode that make one of the stream, each way

    @property
    def offset_ns(self) -> int:
        return 0 if self.clock is None else round(self.clock.value[0] * 1e9)

    @property
    def digest(self) -> bytes:
        """32 bytes, of all its results."""
        return hashlib.sha256(b"".join(r.digest for r in (self.pose, self.lens, self.clock) if r)).digest()


@dataclass(frozen=True, slots=True)
class PoseOptions:
    backend: str  # of asc_rt.perception.pose
    model: Path
    digest: bytes  # 32, of the model


@dataclass(frozen=True, slots=True)
class PerceptionOptions:
    sensor: str  # one of human.sensors
    remote: bool  # on another machine
    low: tuple[float, ...]  # m, corners of the guarded volume
    high: tuple[float, ...]
    voxel: float  # m
    margin: float  # m around the robot
    detection: float  # m
    record: bool  # what the cameras see, too
    cameras: tuple[CameraOptions, ...]
    pose: PoseOptions | None = None

    @property
    def digest(self) -> bytes:
        """32 bytes: what the sensor's messages carry as their calibration. One other file, and it is another."""
        model = b"" if self.pose is None else self.pose.digest
        return hashlib.sha256(b"".join(camera.digest for camera in self.cameras) + model).digest()


def options(path: Path, cell: CellFile, faults: Faults) -> PerceptionOptions | None:
    """None: the cell has no cameras, or `faults` say what is wrong with them."""
    table = cell.perception
    if table is None:
        return None
    before = len(faults)
    _check(path, cell, table, faults)
    cameras = [_camera(path, name, camera, faults) for name, camera in sorted(table.camera.items())]
    pose = None if table.pose is None else _pose(path, table.pose, faults)
    if len(faults) > before:
        return None
    return PerceptionOptions(
        sensor=table.sensor,
        remote=table.remote,
        low=table.low,
        high=table.high,
        voxel=table.voxel_m,
        margin=table.margin_m,
        detection=table.detection_m,
        record=table.record,
        cameras=tuple(camera for camera in cameras if camera is not None),
        pose=pose,
    )


def _check(path: Path, cell: CellFile, table: Perception, faults: Faults) -> None:
    human = cell.human
    if table.sensor not in human.sensors:
        names = ", ".join(human.sensors)
        faults.note(path, "perception.sensor", f"{table.sensor!r} is not expected; one of human.sensors: {names}")
    named = human.calibrations.get(table.sensor, human.calibration)
    if named != CAMERAS:
        key = f"human.calibrations.{table.sensor}" if table.sensor in human.calibrations else "human.calibration"
        faults.note(path, key, f"{named!r} is not what these cameras are calibrated by; {CAMERAS!r}")
    for name, camera in sorted(table.camera.items()):
        if camera.device.name in registry.FILES and not cell.simulated:
            told = f"{camera.device.name!r} plays what was, who is here now is not in it; only in a simulated cell"
            faults.note(path, f"perception.camera.{name}.device", told)
    for axis, low, high in zip("xyz", table.low, table.high, strict=True):
        if high - low < LEAST_SIDE_M:
            least = f"at least {LEAST_SIDE_M:g} m above low"
            faults.note(path, "perception.high", f"{axis}: {high:g} m over low {low:g} m is no volume; {least}")


def _camera(path: Path, name: str, camera: Camera, faults: Faults) -> CameraOptions | None:
    key = f"perception.camera.{name}"
    device = dict(camera.device.model_extra or {})
    try:
        registry.camera_class(camera.device.name)(device)
    except ValueError as error:
        for line in str(error).splitlines():
            faults.note(path, f"{key}.device", line)
    folder = path.parent
    pose = _result(path, f"{key}.calibration", folder / camera.calibration, "hand-eye", faults)
    lens, clock = (
        _result(path, f"{key}.{field}", folder / file, kind, faults) if file else None
        for field, file, kind in (
            ("intrinsics", camera.intrinsics, "intrinsics"),
            ("time_offset", camera.time_offset, "time-offset"),
        )
    )
    if pose is None:
        return None
    background = folder.resolve() / camera.background
    return CameraOptions(name, camera.device.name, device, pose, lens, clock, background, camera.binning)


def _pose(path: Path, pose: Pose, faults: Faults) -> PoseOptions | None:
    """Whether its library is there and takes the model is found out where perception runs."""
    if pose.backend not in BACKENDS:
        known = ", ".join(sorted(BACKENDS))
        faults.note(path, "perception.pose.backend", f"unknown pose backend {pose.backend!r}; known: {known}")
    model = path.parent.resolve() / pose.model
    try:
        return PoseOptions(pose.backend, model, hashlib.sha256(model.read_bytes()).digest())
    except OSError as error:
        told = f"{model}: cannot be read: {error.strerror}; name the model's file, or take [perception.pose] out"
        faults.note(path, "perception.pose.model", told)
        return None


def _result(path: Path, key: str, file: Path, kind: str, faults: Faults) -> Result | None:
    """The result, if it may be used today. Whose it is is asked once the device is open."""
    try:
        return load(file, kind)
    except CalibrationError as error:
        for line in error.lines:
            faults.note(path, key, line)
        return None
