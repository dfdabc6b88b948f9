"""May the frames of this camera be believed? The same judgement for every backend, a pure function of the frames.

A camera that shows the same picture for ever, counts backwards, lies about the time or sees nothing is worse than none:
everybody it does not see would be taken for absent.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag

import numpy as np

from drivers.cameras.base import CameraInfo, Depth, DepthFrame


class CameraFault(IntFlag):
    """Also the `health_bits` of human messages."""

    SILENT = 1  # no frame for `silence_periods`
    FROZEN = 2  # the same picture twice: a live sensor's noise never repeats
    CLOCK = 4  # stamps run backwards, lie in the future, are younger than the device can be, or jump
    COVERED = 8  # too few pixels with a measurement
    MOVED = 16  # it sees through what stood there when the cell was commissioned


@dataclass(frozen=True, slots=True)
class Limits:
    """ASSUMED: from the simulated camera and one real Kinect frame (6 % of its pixels have no measurement)."""

    silence_periods: float = 3.0
    invalid_ratio: float = 0.4
    clock_slack_ns: int = 2_000_000  # a stamp may be so much younger than the least latency
    oldest_ns: int = 500_000_000  # and no frame can take longer than this to arrive
    clock_step: float = 0.02  # capture and device clock agree on the time between frames to this share ...
    clock_step_ns: int = 5_000_000  # ... and this much
    same_frames: int = 1  # repetitions that make a picture frozen


class Watch:
    """`look` at each frame; `silent` when none came."""

    def __init__(self, info: CameraInfo, limits: Limits | None = None) -> None:
        self._info, self._limits = info, limits or Limits()
        self._last: DepthFrame | None = None
        self._same = 0
        self.lost = 0  # frames that the device counted and we never had

    def look(self, frame: DepthFrame) -> CameraFault:
        """What is wrong with this frame, after those before it."""
        limits, fault = self._limits, CameraFault(0)
        if not self._is_new(frame):
            fault |= CameraFault.CLOCK
        if self._same >= limits.same_frames:
            fault |= CameraFault.FROZEN
        age_ns = frame.t_arrival_ns - frame.t_capture_ns
        if not self._info.latency_ns - limits.clock_slack_ns <= age_ns <= limits.oldest_ns:
            fault |= CameraFault.CLOCK
        if frame.invalid_ratio > limits.invalid_ratio:
            fault |= CameraFault.COVERED
        return fault

    def silent(self, now_ns: int) -> CameraFault:
        """SILENT if the newest frame is older than it may be."""
        late = self._last is None or now_ns - self._last.t_arrival_ns > self.longest_silence_ns
        return CameraFault.SILENT if late else CameraFault(0)

    @property
    def longest_silence_ns(self) -> int:
        return round(self._limits.silence_periods * self._info.period_ns) + self._info.latency_ns

    def _is_new(self, frame: DepthFrame) -> bool:
        """Number and stamps go on, and both clocks tell the same time between frames."""
        last, self._last = self._last, frame
        if last is None:
            return True
        self.lost += max(frame.seq - last.seq - 1, 0)
        self._same = self._same + 1 if np.array_equal(frame.depth, last.depth) else 0
        device, capture = frame.t_device_ns - last.t_device_ns, frame.t_capture_ns - last.t_capture_ns
        allowed = self._limits.clock_step * abs(device) + self._limits.clock_step_ns
        return frame.seq > last.seq and device > 0 and capture > 0 and abs(capture - device) <= allowed


def moved(depth: Depth, background: Depth, step: float = 0.04, ratio: float = 0.06) -> bool:
    """True: it looks *through* the background at more than `ratio` of the pixels that have both.

    People and the robot stand before the background, so only a camera that was moved (or furniture that was taken away)
    sees farther than it. `step`: share of the distance, ASSUMED: four times the noise of a structured-light sensor.
    """
    both = (depth > 0) & (background > 0)
    beyond = depth.astype(np.float32) > background * np.float32(1.0 + step)
    return int(np.count_nonzero(beyond & both)) > ratio * max(int(np.count_nonzero(both)), 1)
