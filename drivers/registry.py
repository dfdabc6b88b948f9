"""Driver name -> class. Imported only when asked for, so that one driver's dependencies never burden another's user."""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import entry_points
from typing import cast

from drivers.base import RobotDriver

GROUP = "asc.drivers"  # entry points of installed packages: name = "module:Class"

BUILTIN = {
    "fanuc-j519": "drivers.fanuc_stream_motion.link:StreamMotion",
    "fanuc-stream-motion-b": "drivers.fanuc_stream_motion.link_b:StreamMotionB",
    "loopback": "drivers.loopback:Loopback",
}


def known() -> dict[str, str]:
    """Every registered driver as name -> "module:Class"; a built-in name cannot be taken by a package."""
    return {entry.name: entry.value for entry in entry_points(group=GROUP)} | BUILTIN


def driver_class(name: str) -> type[RobotDriver]:
    """The class registered as `name`. ValueError: unknown, or it cannot be imported."""
    targets = known()
    if name not in targets:
        raise ValueError(f"unknown driver {name!r}; known: {', '.join(sorted(targets))}")
    module, _, attribute = targets[name].partition(":")
    try:
        return cast(type[RobotDriver], getattr(import_module(module), attribute))
    except (ImportError, AttributeError) as error:
        raise ValueError(f"driver {name!r} ({targets[name]}) cannot be loaded: {error}") from error
