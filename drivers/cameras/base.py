"""What a depth camera is: the other half of the hardware abstraction layer.

Life: open() -> read() again and again -> close(). A camera turns what its device says into `DepthFrame`: depth as the
sensor counts it, with the unit beside it, and with stamps on the monotonic clock of this machine. It starts no thread,
fills no holes, smooths nothing and retries nothing: filters that invent depth have no place before a decision about
people. Errors are those of `drivers.base`; expected silence is None. Whether the frames may be believed is judged by
`drivers.cameras.watch`, the same for every backend.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from drivers.base import DriverError

Depth = npt.NDArray[np.uint16]  # (height, width) counts of `unit_m` along the optical axis; 0: no measurement
Image = npt.NDArray[np.uint8]  # (height, width) or (height, width, 3) RGB: its pixels are the depth's

__all__ = ["CameraInfo", "Depth", "DepthCamera", "DepthFrame", "DriverError", "Image", "Intrinsics"]


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """Pinhole with Brown's lens. Pixel (u, v) of a point (x, y, z): fx x/z + cx, fy y/z + cy, after the distortion."""

    width: int
    height: int
    fx: float  # px
    fy: float
    cx: float  # px, of the centre of the pixel (0, 0) counted
    cy: float
    distortion: tuple[float, ...] = ()  # k1 k2 p1 p2 k3 ... as OpenCV orders them; (): the device has rectified

    @property
    def mode(self) -> str:
        """How calibration files name it: "640x480"."""
        return f"{self.width}x{self.height}"


@dataclass(frozen=True, slots=True)
class CameraInfo:
    """What open() found out about the device."""

    model: str
    serial: str
    firmware: str
    intrinsics: Intrinsics
    unit_m: float  # metres per count; never assumed
    period_ns: int  # nominal
    latency_ns: int  # least time from mid-exposure to arrival: no frame can be younger
    has_image: bool = False  # its frames bring a picture, too


@dataclass(frozen=True, slots=True)
class DepthFrame:
    depth: Depth  # read-only
    t_capture_ns: int  # mid-exposure, monotonic clock of this machine
    t_capture_sigma_ns: int  # how far that may be off, one standard deviation
    t_device_ns: int  # the device's own clock; compared with itself only
    t_arrival_ns: int  # when the frame reached this process
    seq: int  # the device's count: a gap is a lost frame
    image: Image | None = None  # read-only, of the same exposure; for who recognises things, never for distances

    @property
    def invalid_ratio(self) -> float:
        """Share of the pixels without a measurement."""
        return 1.0 - np.count_nonzero(self.depth) / self.depth.size


class DepthCamera(Protocol):
    def __init__(self, options: dict[str, Any]) -> None:
        """`options`: the cell's [perception.camera.NAME.device] table. Opens nothing. ValueError names a wrong one."""

    def open(self) -> CameraInfo:
        """Find the device, start it, say what it is. LinkError, HandshakeError."""

    def read(self, deadline_ns: int) -> DepthFrame | None:
        """The newest frame that was not yet read; None at the deadline: silence. ProtocolError, LinkError."""

    def close(self) -> None:
        """Release the device. Idempotent."""


def frozen(depth: npt.NDArray[Any]) -> Depth:
    """A read-only image of counts."""
    image = np.ascontiguousarray(depth, dtype=np.uint16)
    image.setflags(write=False)
    return image


def frozen_image(picture: npt.NDArray[Any]) -> Image:
    """A read-only picture, its own memory."""
    image = np.array(picture, dtype=np.uint8, order="C")
    image.setflags(write=False)
    return image


def check_options(name: str, options: dict[str, Any], known: dict[str, type | tuple[type, ...]]) -> None:
    """ValueError, one line per fault: an option that is not `known`, or not of its kind."""
    faults = [f"{name}: unknown option {key}; known: {', '.join(known)}" for key in sorted(options.keys() - known)]
    for key in known.keys() & options.keys():
        if isinstance(options[key], bool) != (known[key] is bool) or not isinstance(options[key], known[key]):
            faults.append(f"{name}: {key}: {options[key]!r} is not possible")
    if faults:
        raise ValueError("\n".join(faults))
