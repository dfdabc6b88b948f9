"""The camera channel of a recording, played as a depth camera.

Lives here because only this package knows recordings; `drivers.registry` names it as the backend `recording`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from google.protobuf.message import DecodeError

from drivers.base import HandshakeError, LinkError, ProtocolError
from drivers.cameras.base import CameraInfo, Depth, DepthFrame, Intrinsics, check_options, frozen
from drivers.cameras.replay import Replay, Shot
from logs.reader import CorruptLog, ForeignFile, LogError
from logs.recording import Recording, open_recording
from logs.schema import CALIBRATION, CAMERAS, CameraCalibration, CompressedImage

UNIT_M = 0.001  # ASSUMED: an image has no unit in it; the channel is for millimetres (logs/README.md)
HEAD = 32  # frames from whose stamps the period is told
LENSES = {"": 0, "plumb_bob": 5, "rational_polynomial": 8}  # Foxglove's names for lenses of OpenCV: length of D
PINHOLE = ("fx", "fy", "cx", "cy")


class RecordedCamera:
    """Options: `file`, `camera` (its name in the recording); `fx`, `fy`, `cx`, `cy` px where the recording has no
    calibration of it, or another lens counts; `unit_m` (0.001); `serial`, by which its calibration results name it
    (`camera`)."""

    def __init__(self, options: dict[str, Any]) -> None:
        number = (int, float)
        known: dict[str, Any] = {"file": str, "camera": str, **dict.fromkeys(PINHOLE, number)}
        check_options("recording", options, known | {"unit_m": number, "serial": str})
        self._pinhole = {key: float(options[key]) for key in PINHOLE if key in options}
        if missing := [key for key in known if key not in options and (self._pinhole or key not in PINHOLE)]:
            raise ValueError(f"recording: {', '.join(missing)}: missing")
        self._file, self._name = options["file"], options["camera"]
        self._unit_m = float(options.get("unit_m", UNIT_M))
        self._serial = options.get("serial", self._name)
        self._replay: Replay | None = None

    def open(self) -> CameraInfo:
        self.close()
        try:
            recording = open_recording(self._file)
            shots = self._shots(recording)
            head = list(itertools.islice(shots, HEAD))
            if len(head) < 2:
                hint = "name another camera, or a recording of it: `asc view` shows what there is"
                raise HandshakeError(f"{self._file}: fewer than two depth images of camera {self._name!r}", hint)
            lens = self._lens(recording, head[0].depth)
        except (CorruptLog, ForeignFile) as error:
            raise HandshakeError(f"{error}", hint="name a recording of a session, undamaged") from error
        except DecodeError as error:
            raise HandshakeError(f"{self._file}: camera {self._name!r}: {error}", hint="record it again") from error
        except LogError as error:
            raise LinkError(f"{error}", hint="name an existing recording") from error
        period_ns = round(float(np.median(np.diff([shot.t_device_ns for shot in head]))))
        if period_ns <= 0:
            raise HandshakeError(f"{self._file}: the stamps of camera {self._name!r} stand still", hint="record again")
        self._replay = Replay(self._checked(itertools.chain(head, shots), head[0].depth.shape), period_ns)
        return CameraInfo("recording", self._serial, "", lens, self._unit_m, period_ns, latency_ns=0)

    def read(self, deadline_ns: int) -> DepthFrame | None:
        if self._replay is None:
            raise LinkError("recording: not open", hint="open() comes before read()")
        return self._replay.read(deadline_ns)

    def close(self) -> None:
        self._replay = None

    def _shots(self, recording: Recording) -> Iterator[Shot]:
        """Colour images of the same name, and damaged ones, are passed over: a gap, as if they had been lost."""
        for message in recording.messages(CAMERAS + self._name):
            image = CompressedImage.FromString(message.data)
            counts = _counts(image.data)
            if counts is not None:
                yield Shot(image.timestamp.ToNanoseconds(), counts)

    def _checked(self, shots: Iterator[Shot], shape: tuple[int, ...]) -> Iterator[Shot]:
        try:
            for shot in shots:
                if shot.depth.shape != shape:
                    raise ProtocolError(f"{self._file}: camera {self._name!r} changes its size", hint="record one mode")
                yield shot
        except (LogError, DecodeError) as error:
            raise ProtocolError(f"{self._file}: camera {self._name!r}: {error}", hint="record it again") from error

    def _lens(self, recording: Recording, depth: Depth) -> Intrinsics:
        height, width = depth.shape
        if self._pinhole:
            fx, fy, cx, cy = (self._pinhole[key] for key in PINHOLE)
            return Intrinsics(width, height, fx, fy, cx, cy)
        message = next(recording.messages(CAMERAS + self._name + CALIBRATION), None)
        where, hint = f"{self._file}: camera {self._name!r}", "tell fx, fy, cx and cy"
        if message is None:
            raise HandshakeError(f"{where}: its lens is not recorded", hint)
        told = CameraCalibration.FromString(message.data)
        if (told.width, told.height) != (width, height):
            raise HandshakeError(f"{where}: {width}x{height}; its lens is for {told.width}x{told.height}", hint)
        known = LENSES.get(told.distortion_model) in (len(told.D), 0) and len(told.K) == 9
        if not (known and all(map(math.isfinite, (*told.K, *told.D))) and min(told.K[0], told.K[4]) > 0.0):
            raise HandshakeError(f"{where}: its lens ({told.distortion_model or 'no model'}) is not understood", hint)
        return Intrinsics(width, height, told.K[0], told.K[4], told.K[2], told.K[5], tuple(told.D))


def _counts(data: bytes) -> Depth | None:
    """Of a PNG of 16 bits; None: another image, or none."""
    if not data:
        return None  # OpenCV raises for it
    counts = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if counts is None or counts.dtype != np.uint16 or counts.ndim != 2:
        return None
    return frozen(counts)
