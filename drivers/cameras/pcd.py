"""Depth images from organised point clouds (PCD, ASCII header, `binary` or `binary_compressed`): for tests and replays.

The pixel grid must be the sensor's: depth is the field z, NaN or 0 is no measurement; the picture is the field rgb or
rgba, if there is one.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from drivers.base import HandshakeError, LinkError
from drivers.cameras.base import (
    CameraInfo,
    Depth,
    DepthFrame,
    Image,
    Intrinsics,
    check_options,
    frozen,
    frozen_image,
)

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
COLOURS = ("rgb", "rgba")  # 4 bytes: blue, green, red, and one that says nothing


class Cloud(NamedTuple):
    depth: Depth
    image: Image | None


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
        self._clouds: list[Cloud] = []

    def open(self) -> CameraInfo:
        self._clouds, self._shown = [read_cloud(file) for file in self._files], 0
        shapes = {cloud.depth.shape for cloud in self._clouds}
        if len(shapes) != 1:
            raise HandshakeError(f"pcd: images of {len(shapes)} sizes", hint="name files of one camera and mode")
        height, width = shapes.pop()
        lens = Intrinsics(width, height, self._fx, self._fy, self._cx, self._cy)
        coloured = all(cloud.image is not None for cloud in self._clouds)
        return CameraInfo("PCD files", self._files[0].stem, "", lens, UNIT_M, PERIOD_NS, 0, coloured)

    def read(self, deadline_ns: int) -> DepthFrame | None:
        if not self._clouds:
            raise LinkError("pcd: not open", hint="open() comes before read()")
        if self._shown >= len(self._clouds):
            time.sleep(max(deadline_ns - time.monotonic_ns(), 0) * 1e-9)
            return None
        self._shown += 1
        depth, image = self._clouds[self._shown - 1]
        now_ns = time.monotonic_ns()
        return DepthFrame(depth, now_ns, 0, self._shown * PERIOD_NS, now_ns, self._shown, image)

    def close(self) -> None:
        self._clouds = []


def depth_image(path: Path) -> Depth:
    """The depth of the organised cloud in `path`, mm. LinkError: no such file; HandshakeError: not such a cloud."""
    return read_cloud(path).depth


def read_cloud(path: Path) -> Cloud:
    """As `depth_image`, with the picture."""
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
        column = _columns(kind, body, dtype, width * height)
        z = column("z").astype(np.float64)
        colour = next((column(field) for field in COLOURS if field in fields), None)
    except (KeyError, ValueError, IndexError) as error:
        raise HandshakeError(f"{path}: not a point cloud that is understood: {error}", hint="save it as PCD") from error
    if not mark or height == 1:
        raise HandshakeError(f"{path}: the cloud is not organised", hint="rows and columns must be the sensor's pixels")
    counts = np.nan_to_num(z.reshape(height, width) / UNIT_M, nan=0.0, posinf=0.0, neginf=0.0)
    depth = frozen(np.rint(np.clip(counts, 0, np.iinfo(np.uint16).max)))
    if colour is None or colour.itemsize != 4:
        return Cloud(depth, None)
    bytes_of = np.ascontiguousarray(colour).view(np.uint8).reshape(height, width, 4)
    return Cloud(depth, frozen_image(bytes_of[..., 2::-1]))


def _columns(kind: bytes, body: bytes, dtype: np.dtype[Any], points: int) -> Callable[[str], np.ndarray]:
    """Field -> (points,) its values."""
    if kind == b"binary":
        rows = np.frombuffer(body, dtype, points)
        return lambda field: rows[field]
    if kind != b"binary_compressed":
        raise ValueError(f"DATA {kind.decode(errors='replace')}")
    packed, size = (int(n) for n in np.frombuffer(body, "<u4", 2))
    if size != points * dtype.itemsize or len(body) < 8 + packed:
        raise ValueError("the file is cut off")
    flat = _lzf(np.frombuffer(body, np.uint8, packed, 8), size)
    fields: Any = dtype.fields

    def column(field: str) -> np.ndarray:
        start = points * fields[field][1]  # compressed clouds are stored field by field
        return flat[start : start + points * dtype[field].itemsize].view(dtype[field])

    return column


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
