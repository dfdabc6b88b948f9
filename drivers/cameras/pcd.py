"""Depth images from organised point clouds (PCD, ASCII header, `binary` or `binary_compressed`): for tests and replays.

The pixel grid must be the sensor's: depth is the field z, NaN or 0 is no measurement.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit

from drivers.base import HandshakeError, LinkError
from drivers.cameras.base import CameraInfo, Depth, DepthFrame, Intrinsics, check_options, frozen

UNIT_M = 0.001
PERIOD_NS = 33_333_333
KINDS = {
    ("F", "4"): "<f4",
    ("F", "8"): "<f8",
    ("U", "1"): "u1",
    ("U", "2"): "<u2",
    ("U", "4"): "<u4",
    ("I", "4"): "<i4",
}


class PcdFiles:
    """Options: `files` (paths, one frame each, shown in order, then silence), `fx`, `fy`, `cx`, `cy` in px."""

    def __init__(self, options: dict[str, Any]) -> None:
        number = (int, float)
        check_options("pcd", options, {"files": list, "fx": number, "fy": number, "cx": number, "cy": number})
        missing = {"files", "fx", "fy", "cx", "cy"} - options.keys()
        if missing:
            raise ValueError(f"pcd: {', '.join(sorted(missing))}: missing")
        self._files = [Path(file) for file in options["files"]]
        self._fx, self._fy, self._cx, self._cy = (float(options[key]) for key in ("fx", "fy", "cx", "cy"))
        self._shown = 0
        self._images: list[Depth] = []

    def open(self) -> CameraInfo:
        self._images, self._shown = [depth_image(file) for file in self._files], 0
        shapes = {image.shape for image in self._images}
        if len(shapes) != 1:
            raise HandshakeError(f"pcd: images of {len(shapes)} sizes", hint="name files of one camera and mode")
        height, width = shapes.pop()
        lens = Intrinsics(width, height, self._fx, self._fy, self._cx, self._cy)
        return CameraInfo("PCD files", self._files[0].stem, "", lens, UNIT_M, PERIOD_NS, latency_ns=0)

    def read(self, deadline_ns: int) -> DepthFrame | None:
        if not self._images:
            raise LinkError("pcd: not open", hint="open() comes before read()")
        if self._shown >= len(self._images):
            time.sleep(max(deadline_ns - time.monotonic_ns(), 0) * 1e-9)
            return None
        self._shown += 1
        now_ns = time.monotonic_ns()
        return DepthFrame(self._images[self._shown - 1], now_ns, 0, self._shown * PERIOD_NS, now_ns, self._shown)

    def close(self) -> None:
        self._images = []


def depth_image(path: Path) -> Depth:
    """The depth of the organised cloud in `path`, mm. LinkError: no such file; HandshakeError: not such a cloud."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise LinkError(f"{path}: cannot be read: {error.strerror}", hint="name an existing .pcd file") from error
    head, mark, body = data.partition(b"\nDATA ")
    header = {words[0]: words[1:] for line in head.decode("ascii", "replace").splitlines() if (words := line.split())}
    kind, _, body = body.partition(b"\n")
    try:
        width, height = int(header["WIDTH"][0]), int(header["HEIGHT"][0])
        fields, kinds = header["FIELDS"], [KINDS[pair] for pair in zip(header["TYPE"], header["SIZE"], strict=True)]
        dtype = np.dtype(list(zip(fields, kinds, strict=True)))
        z = _columns(kind, body, dtype, width * height)
    except (KeyError, ValueError, IndexError) as error:
        raise HandshakeError(f"{path}: not a point cloud that is understood: {error}", hint="save it as PCD") from error
    if not mark or height == 1:
        raise HandshakeError(f"{path}: the cloud is not organised", hint="rows and columns must be the sensor's pixels")
    counts = np.nan_to_num(z.reshape(height, width) / UNIT_M, nan=0.0, posinf=0.0, neginf=0.0)
    return frozen(np.rint(np.clip(counts, 0, np.iinfo(np.uint16).max)))


def _columns(kind: bytes, body: bytes, dtype: np.dtype[Any], points: int) -> np.ndarray:
    if kind == b"binary":
        return np.frombuffer(body, dtype, points)["z"].astype(np.float64)
    if kind != b"binary_compressed":
        raise ValueError(f"DATA {kind.decode(errors='replace')}")
    packed, size = (int(n) for n in np.frombuffer(body, "<u4", 2))
    if size != points * dtype.itemsize or len(body) < 8 + packed:
        raise ValueError("the file is cut off")
    flat = _lzf(np.frombuffer(body, np.uint8, packed, 8), size)
    fields: Any = dtype.fields
    start = points * fields["z"][1]  # compressed clouds are stored field by field
    return flat[start : start + points * dtype["z"].itemsize].view(dtype["z"]).astype(np.float64)


@njit(cache=True)
def _lzf(data: np.ndarray, size: int) -> np.ndarray:
    """LZF: a control byte below 32 copies that many + 1 literals; another one repeats from `distance` before."""
    out = np.zeros(size, np.uint8)
    i = o = 0
    while i < data.shape[0]:
        control = int(data[i])
        i += 1
        if control < 32:
            length = control + 1
            if i + length > data.shape[0] or o + length > size:
                raise ValueError("damaged LZF data")
            out[o : o + length] = data[i : i + length]
            i += length
        else:
            length, far = (control >> 5) + 2, (control & 31) << 8
            if length == 9:
                length += int(data[i])
                i += 1
            source = o - far - int(data[i]) - 1
            i += 1
            if source < 0 or o + length > size:
                raise ValueError("damaged LZF data")
            for k in range(length):  # may overlap what it writes
                out[o + k] = out[source + k]
        o += length
    return out
