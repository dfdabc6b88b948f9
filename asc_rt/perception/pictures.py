"""What the cameras see, for the session's recording: depth as PNG of 16 bits in mm, and the lens beside it.

Packing takes as long as detecting (640x480: 7 ms), so it has a thread of its own, and pictures it cannot keep up with
are left out: the recording then has a gap, the detection never waits. The backend `recording` plays them.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress

import cv2
import numpy as np

from asc_rt import topics
from drivers.cameras.base import CameraInfo, Depth, DepthFrame, Intrinsics
from logs.schema import CameraCalibration, CompressedImage

MM = 0.001  # m, of one count in the recording
WAITING = 2  # pictures of each camera
STUCK_S = 2.0  # then the process ends without the rest
LENS_NS = round(1e9 / topics.CAMERA_CALIBRATION.rate_hz)
FASTEST = [cv2.IMWRITE_PNG_COMPRESSION, 1]  # 114 kB in 7 ms instead of 90 kB in 19: a real Kinect frame. MEASURED
LENSES = {0: "", 5: "plumb_bob", 8: "rational_polynomial"}  # number of coefficients: Foxglove's name
Put = Callable[[bytes], None]


class Pictures:
    """`offer` takes frames and never waits; a thread packs them and puts them on the bus."""

    def __init__(self, cameras: Sequence[tuple[str, CameraInfo]], put_image: Put, put_lens: Put) -> None:
        self._cameras, self._put_image, self._put_lens = cameras, put_image, put_lens
        # Once for all: a step of the wall clock would be one of the camera's when it is played.
        self._wall_ns = time.time_ns() - time.monotonic_ns()
        self._lens_due_ns = [0] * len(cameras)
        self._waiting: queue.Queue[tuple[int, DepthFrame] | None] = queue.Queue(WAITING * len(cameras))
        self._thread = threading.Thread(target=self._run, name="pictures", daemon=True)
        self._thread.start()

    def offer(self, number: int, frame: DepthFrame) -> None:
        """`number`: of the camera. Where it is full the oldest picture is left out."""
        with suppress(queue.Empty):
            if self._waiting.full():
                self._waiting.get_nowait()
        self._waiting.put_nowait((number, frame))

    def close(self) -> None:
        """What is waiting is still put."""
        with suppress(queue.Full):
            self._waiting.put(None, timeout=STUCK_S)
        self._thread.join(STUCK_S)

    def _run(self) -> None:
        while (found := self._waiting.get()) is not None:
            number, frame = found
            name, info = self._cameras[number]
            t_ns = frame.t_capture_ns + self._wall_ns
            if frame.t_arrival_ns >= self._lens_due_ns[number]:
                self._lens_due_ns[number] = frame.t_arrival_ns + LENS_NS
                self._put_lens(lens_message(name, info.intrinsics, t_ns))
            self._put_image(image_message(name, frame.depth, info.unit_m, t_ns))


def image_message(name: str, depth: Depth, unit_m: float, wall_ns: int) -> bytes:
    """foxglove.CompressedImage of counts of `unit_m`: in mm, another unit rounded; beyond 65.5 m is nothing."""
    counts = depth
    if unit_m != MM:
        mm = np.rint(depth * (unit_m / MM))
        counts = np.where(mm > np.iinfo(np.uint16).max, 0, mm).astype(np.uint16)
    png = cv2.imencode(".png", counts, FASTEST)[1].tobytes()
    message = CompressedImage(frame_id=name, format="png", data=png)
    message.timestamp.FromNanoseconds(wall_ns)
    data: bytes = message.SerializeToString()
    return data


def lens_message(name: str, lens: Intrinsics, wall_ns: int) -> bytes:
    """foxglove.CameraCalibration. A lens that Foxglove has no name for is "opencv": no viewer takes it for another."""
    told = list(lens.distortion)
    D = told + [0.0] * (5 - len(told)) if 0 < len(told) < 5 else told
    message = CameraCalibration(
        frame_id=name, width=lens.width, height=lens.height, distortion_model=LENSES.get(len(D), "opencv"), D=D,
        K=[lens.fx, 0, lens.cx, 0, lens.fy, lens.cy, 0, 0, 1], R=np.eye(3).ravel(),
        P=[lens.fx, 0, lens.cx, 0, 0, lens.fy, lens.cy, 0, 0, 0, 1, 0],
    )  # fmt: skip
    message.timestamp.FromNanoseconds(wall_ns)
    data: bytes = message.SerializeToString()
    return data
