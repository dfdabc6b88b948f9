"""The camera channel of a recording, played as a depth camera: frames in their order, at their recorded distances.

Lives here because only this package knows recordings; `drivers.registry` names it as the backend `recording`.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np

from drivers.base import HandshakeError, LinkError
from drivers.cameras.base import CameraInfo, DepthFrame, Intrinsics, check_options, frozen
from logs.recording import open_recording
from logs.schema import CAMERAS, CompressedImage


class RecordedCamera:
    """Options: `file`, `camera` (its name in the recording), `fx`, `fy`, `cx`, `cy` px, `unit_m`, `speed` (1)."""

    def __init__(self, options: dict[str, Any]) -> None:
        number = (int, float)
        known: dict[str, Any] = {"file": str, "camera": str, **dict.fromkeys(("fx", "fy", "cx", "cy"), number)}
        check_options("recording", options, known | {"unit_m": number, "speed": number})
        if missing := known.keys() - options.keys():
            raise ValueError(f"recording: {', '.join(sorted(missing))}: missing")
        self._options = options
        self._speed = float(options.get("speed", 1.0))
        self._frames: Iterator[tuple[int, np.ndarray]] | None = None
        self._next: tuple[int, np.ndarray] | None = None

    def open(self) -> CameraInfo:
        first = list(_head(self._images(), 2))
        if len(first) < 2:
            name = self._options["camera"]
            raise HandshakeError(f"recording: fewer than two images of {name!r}", hint="see `asc view` for its cameras")
        height, width = first[0][1].shape
        fx, fy, cx, cy = (float(self._options[key]) for key in ("fx", "fy", "cx", "cy"))
        lens = Intrinsics(width, height, fx, fy, cx, cy)
        self._frames, self._next, self._seq = self._images(), None, 0
        self._start_ns, self._first_ns = time.monotonic_ns(), first[0][0]
        period_ns = round((first[1][0] - first[0][0]) / self._speed)
        unit = float(self._options.get("unit_m", 0.001))
        return CameraInfo("recording", self._options["camera"], "", lens, unit, period_ns, latency_ns=0)

    def read(self, deadline_ns: int) -> DepthFrame | None:
        if self._frames is None:
            raise LinkError("recording: not open", hint="open() comes before read()")
        if (found := self._take(deadline_ns)) is None:
            time.sleep(max(deadline_ns - time.monotonic_ns(), 0) * 1e-9)
            return None
        self._seq += 1
        t_device_ns, image = found
        due_ns = self._due_ns(t_device_ns)
        return DepthFrame(frozen(image), due_ns, 0, round(t_device_ns / self._speed), time.monotonic_ns(), self._seq)

    def close(self) -> None:
        self._frames = None

    def _take(self, deadline_ns: int) -> tuple[int, np.ndarray] | None:
        """The next image, once it is due."""
        assert self._frames is not None
        self._next = self._next or next(self._frames, None)
        if self._next is None or self._due_ns(self._next[0]) > deadline_ns:
            return None
        taken, self._next = self._next, None
        time.sleep(max(self._due_ns(taken[0]) - time.monotonic_ns(), 0) * 1e-9)
        return taken

    def _due_ns(self, t_device_ns: int) -> int:
        return self._start_ns + round((t_device_ns - self._first_ns) / self._speed)

    def _images(self) -> Iterator[tuple[int, np.ndarray]]:
        """(stamp of the device, counts) of each depth image."""
        try:
            recording = open_recording(self._options["file"])
        except OSError as error:
            raise LinkError(
                f"{self._options['file']}: cannot be read: {error.strerror}", hint="name a recording"
            ) from error
        for message in recording.messages(CAMERAS + self._options["camera"]):
            image = CompressedImage.FromString(message.data)
            counts = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_UNCHANGED)
            if counts is not None and counts.dtype == np.uint16 and counts.ndim == 2:
                yield image.timestamp.seconds * 1_000_000_000 + image.timestamp.nanos, counts


def _head(frames: Iterator[tuple[int, np.ndarray]], count: int) -> Iterator[tuple[int, np.ndarray]]:
    for _, frame in zip(range(count), frames, strict=False):
        yield frame
