"""Driver and camera name -> class. Imported only when asked for: one's dependencies never burden another's user."""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import entry_points
from typing import cast

from drivers.base import RobotDriver
from drivers.cameras.base import DepthCamera

GROUP = "asc.drivers"  # entry points of installed packages: name = "module:Class"

BUILTIN = {
    "can": "drivers.can.driver:Can",
    "fanuc-j519": "drivers.fanuc_stream_motion.link:StreamMotion",
    "fanuc-stream-motion-b": "drivers.fanuc_stream_motion.link_b:StreamMotionB",
    "loopback": "drivers.loopback:Loopback",
}


CAMERAS = {
    "azure-mkv": "drivers.cameras.azure:AzureRecording",
    "depth-stream": "drivers.cameras.stream:DepthStream",
    "pcd": "drivers.cameras.pcd:PcdFiles",
    "realsense": "drivers.cameras.realsense:RealSense",
    "recording": "logs.camera:RecordedCamera",
}
FILES = frozenset({"azure-mkv", "pcd", "recording"})  # cameras that show the past under stamps of now


def camera_class(name: str) -> type[DepthCamera]:
    """The camera backend registered as `name`. ValueError: unknown, or it cannot be imported."""
    return cast(type[DepthCamera], _load("camera", name, CAMERAS))


def known() -> dict[str, str]:
    """Every registered driver as name -> "module:Class"; a built-in name cannot be taken by a package."""
    return {entry.name: entry.value for entry in entry_points(group=GROUP)} | BUILTIN


def driver_class(name: str) -> type[RobotDriver]:
    """The class registered as `name`. ValueError: unknown, or it cannot be imported."""
    return cast(type[RobotDriver], _load("driver", name, known()))


def _load(kind: str, name: str, targets: dict[str, str]) -> object:
    if name not in targets:
        raise ValueError(f"unknown {kind} {name!r}; known: {', '.join(sorted(targets))}")
    module, _, attribute = targets[name].partition(":")
    try:
        return getattr(import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"{kind} {name!r} ({targets[name]}) cannot be loaded: {error}") from error
