"""Recordings of an Azure Kinect (.mkv of k4arecorder) through PyAV (extra `azure`): for tests and replays.

Needs no k4a SDK, which is archived and does not build: the depth track holds raw big-endian millimetres. The lens is in
the device's factory calibration, which the recorder attaches.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np

from drivers.base import HandshakeError, LinkError, ProtocolError
from drivers.cameras.base import CameraInfo, DepthFrame, Intrinsics, check_options, frozen
from drivers.cameras.replay import Replay, Shot

UNIT_M = 0.001  # DATASHEET: K4A_IMAGE_FORMAT_DEPTH16
MODES = {  # DATASHEET (k4a SDK): side of the calibrated square, px; where the picture begins in it; size of the picture
    "NFOV_2X2BINNED": (512, (96, 90), (320, 288)),
    "NFOV_UNBINNED": (1024, (192, 180), (640, 576)),
    "WFOV_2X2BINNED": (512, (0, 0), (512, 512)),
    "WFOV_UNBINNED": (1024, (0, 0), (1024, 1024)),
}
BROWN = "CALIBRATION_LensDistortionModelBrownConrady"
MODE_TAG, ATTACHMENT_TAG = "K4A_DEPTH_MODE", "K4A_CALIBRATION_FILE"
HINT = "name an .mkv that k4arecorder wrote, with depth"


class AzureRecording:
    """Options: `file`; `calibration`, a JSON file, where another one counts than the attached."""

    def __init__(self, options: dict[str, Any]) -> None:
        check_options("azure-mkv", options, {"file": str, "calibration": str})
        if "file" not in options:
            raise ValueError("azure-mkv: file: missing")
        self._file, self._calibration = Path(options["file"]), options.get("calibration")
        self._data: IO[bytes] | None = None
        self._replay: Replay | None = None

    def open(self) -> CameraInfo:
        self.close()
        av = _pyav()
        self._data = _opened(self._file)
        try:
            # Only Matroska: PyAV would try each of its demuxers on whatever the file is.
            container = av.open(self._data, format="matroska", metadata_errors="replace")
            return self._told(av, container)
        except av.FFmpegError as error:
            self.close()
            raise HandshakeError(f"{self._file}: no Matroska file: {error.strerror}", HINT) from error
        except HandshakeError:
            self.close()
            raise

    def read(self, deadline_ns: int) -> DepthFrame | None:
        if self._replay is None:
            raise LinkError("azure-mkv: not open", hint="open() comes before read()")
        return self._replay.read(deadline_ns)

    def close(self) -> None:
        if self._data is not None:
            self._data.close()
        self._data, self._replay = None, None

    def _told(self, av: Any, container: Any) -> CameraInfo:
        stream = next((s for s in container.streams.video if MODE_TAG in s.metadata), None)
        if stream is None or stream.metadata[MODE_TAG] not in MODES or not stream.average_rate:
            raise HandshakeError(f"{self._file}: holds no depth of an Azure Kinect", HINT)
        tags = container.metadata
        serial = tags.get("K4A_DEVICE_SERIAL_NUMBER", "")
        lens = self._lens(container, stream.metadata[MODE_TAG], serial)
        period_ns = round(1e9 / stream.average_rate)
        try:
            start_ns = int(tags.get("K4A_START_OFFSET_NS", "0"))
        except ValueError as error:
            raise HandshakeError(f"{self._file}: K4A_START_OFFSET_NS is no number", HINT) from error
        self._replay = Replay(_shots(av, container, stream, lens, start_ns), period_ns)
        firmware = tags.get("K4A_DEPTH_FIRMWARE_VERSION", "")
        return CameraInfo("Azure Kinect", serial, firmware, lens, UNIT_M, period_ns, latency_ns=0)

    def _lens(self, container: Any, mode: str, serial: str) -> Intrinsics:
        attached = (s.data for s in container.streams if s.type == "attachment" and ATTACHMENT_TAG in s.metadata)
        where = self._calibration or f"{self._file}: the calibration attached"
        if self._calibration is None:
            data = next(attached, b"")
        else:
            with _opened(Path(self._calibration)) as file:
                data = file.read()
        try:
            told = json.loads(data.rstrip(b"\0"))["CalibrationInformation"]
            made = told["Metadata"]["SerialId"]
            lens = lens_of(told["Cameras"], mode)
        except (ValueError, KeyError, TypeError, IndexError, StopIteration) as error:
            raise HandshakeError(f"{where}: no calibration of an Azure Kinect", "name one as `calibration`") from error
        if made != serial:
            raise HandshakeError(f"{where}: of camera {made!r}; {serial!r} recorded", "name that one's calibration")
        return lens


def lens_of(cameras: list[dict[str, Any]], mode: str) -> Intrinsics:
    """The depth camera's lens in `mode`, from `Cameras` of the factory calibration: cx cy fx fy k1 ... k6, two zeros,
    p2 p1, of the whole square as 1 x 1, its corner being (0, 0). KeyError, ValueError, StopIteration: it is none."""
    inner = next(c for c in cameras if c["Purpose"] == "CALIBRATION_CameraPurposeDepth")["Intrinsics"]
    cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, _, _, p2, p1 = (float(v) for v in inner["ModelParameters"])
    side, (left, top), (width, height) = MODES[mode]
    distortion = (k1, k2, p1, p2, k3, k4, k5, k6)
    if inner["ModelType"] != BROWN or not all(map(math.isfinite, (cx, cy, *distortion))) or not min(fx, fy) > 0.0:
        raise ValueError("no Brown-Conrady lens")
    half = 0.5  # px, from the corner of the first pixel to its centre
    return Intrinsics(
        width, height, fx * side, fy * side, cx * side - left - half, cy * side - top - half, distortion
    )  # fmt: skip


def _shots(av: Any, container: Any, stream: Any, lens: Intrinsics, start_ns: int) -> Iterator[Shot]:
    try:
        for packet in container.demux(stream):
            if packet.pts is None:  # the end
                continue
            if packet.size != 2 * lens.width * lens.height:
                raise ProtocolError(f"azure-mkv: a picture of {packet.size} bytes in {lens.mode}", "record it again")
            counts = np.frombuffer(packet, ">u2").reshape(lens.height, lens.width)
            yield Shot(start_ns + round(packet.pts * stream.time_base * 1_000_000_000), frozen(counts))
    except av.FFmpegError as error:
        raise ProtocolError(f"azure-mkv: damaged: {error.strerror}", hint="record it again") from error


def _opened(path: Path) -> IO[bytes]:
    try:
        return path.open("rb")
    except OSError as error:
        raise LinkError(f"{path}: cannot be read: {error.strerror}", hint="name an existing file") from error


def _pyav() -> Any:
    try:
        import av
    except ImportError as error:
        raise LinkError(f"PyAV: {error}", hint="uv sync --extra azure") from error
    return av
