"""Intel RealSense depth cameras through pyrealsense2 (extra `realsense`; on Debian it needs libusb-1.0-0).

Post-processing stays off: temporal and hole-filling filters invent depth. The stamp of a frame is the middle of the
exposure where the device tells it (sensor timestamp), else its frame timestamp less half the exposure; the SDK's own
mapping to the host clock is not used (it has produced stamps of the future), the one of `clock.py` is.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from drivers.base import HandshakeError, LinkError
from drivers.cameras.base import CameraInfo, DepthFrame, Intrinsics, check_options, frozen
from drivers.cameras.clock import SIGMA_NS, ForeignClock

QUEUE = 2  # frames; older ones are dropped by the SDK


class RealSense:
    """Options: `serial` (needed with more than one), `width`, `height`, `rate_hz`, `latency_ms` (least, to arrival)."""

    def __init__(self, options: dict[str, Any], device: Any = None) -> None:
        number = (int, float)
        known: dict[str, Any] = {"serial": str, "width": int, "height": int, "rate_hz": int, "latency_ms": number}
        check_options("realsense", options, known)
        self._serial = options.get("serial", "")
        self._mode = tuple(options.get(key, default) for key, default in (("width", 640), ("height", 480)))
        self._rate = options.get("rate_hz", 30)
        self._latency_ns = round(options.get("latency_ms", 10.0) * 1e6)  # ASSUMED: readout and USB
        self._device, self._sensor, self._queue = device, None, None
        self._clock = ForeignClock(self._latency_ns)

    def open(self) -> CameraInfo:
        self.close()
        rs = _sdk()
        self._sdk, device = rs, self._device or self._find(rs)
        try:
            sensor = device.first_depth_sensor()
            profile = self._profile(rs, sensor)
            self._queue = rs.frame_queue(QUEUE)
            sensor.open(profile)
            self._sensor = sensor
            sensor.start(self._queue)
        except RuntimeError as error:
            self.close()
            raise LinkError(
                f"RealSense: cannot start: {error}", hint="replug it; is another program using it?"
            ) from error
        lens = profile.as_video_stream_profile().get_intrinsics()
        self._clock = ForeignClock(self._latency_ns)
        return CameraInfo(
            model=_told(device, rs.camera_info.name),
            serial=_told(device, rs.camera_info.serial_number),
            firmware=_told(device, rs.camera_info.firmware_version),
            intrinsics=Intrinsics(lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy, tuple(lens.coeffs)),
            unit_m=sensor.get_option(rs.option.depth_units),
            period_ns=round(1e9 / profile.fps()),
            latency_ns=self._latency_ns,
        )

    def read(self, deadline_ns: int) -> DepthFrame | None:
        if self._queue is None:
            raise LinkError("RealSense: not open", hint="open() comes before read()")
        wait_ms = max((deadline_ns - time.monotonic_ns()) // 1_000_000, 0)
        found, frame = self._queue.try_wait_for_frame(int(wait_ms))
        if not found:
            return None
        while newer := self._queue.poll_for_frame():
            frame = newer
        t_arrival_ns = time.monotonic_ns()
        depth = frozen(np.asanyarray(frame.get_data()))
        t_device_ns = self._middle_of_exposure(frame)
        t_capture_ns = self._clock.capture_ns(t_device_ns, t_arrival_ns)
        return DepthFrame(depth, t_capture_ns, SIGMA_NS, t_device_ns, t_arrival_ns, frame.get_frame_number())

    def close(self) -> None:
        sensor, self._sensor, self._queue = self._sensor, None, None
        if sensor is not None:
            sensor.stop()
            sensor.close()

    def _middle_of_exposure(self, frame: Any) -> int:
        value = self._sdk.frame_metadata_value
        if frame.supports_frame_metadata(value.sensor_timestamp):
            return int(frame.get_frame_metadata(value.sensor_timestamp)) * 1000
        exposure_us = 0
        if frame.supports_frame_metadata(value.actual_exposure):
            exposure_us = frame.get_frame_metadata(value.actual_exposure)
        return round(frame.get_timestamp() * 1e6) - exposure_us * 500

    def _find(self, rs: Any) -> Any:
        serials = {_told(device, rs.camera_info.serial_number): device for device in rs.context().query_devices()}
        if self._serial in serials:
            return serials[self._serial]
        if not self._serial and len(serials) == 1:
            return next(iter(serials.values()))
        found = ", ".join(sorted(serials)) or "none"
        raise LinkError(f"RealSense {self._serial or 'camera'}: found {found}", hint="plug it in and name its serial")

    def _profile(self, rs: Any, sensor: Any) -> Any:
        """The depth stream of the asked mode. HandshakeError: the camera has none."""
        for profile in sensor.get_stream_profiles():
            video = profile.as_video_stream_profile()
            asked = (video.width(), video.height(), profile.fps()) == (*self._mode, self._rate)
            if profile.stream_type() == rs.stream.depth and profile.format() == rs.format.z16 and asked:
                return profile
        mode = f"{self._mode[0]}x{self._mode[1]} at {self._rate} Hz"
        raise HandshakeError(f"RealSense: no depth mode {mode}", hint="set width, height and rate_hz to one it has")


def _sdk() -> Any:
    try:
        import pyrealsense2
    except ImportError as error:
        raise LinkError(f"pyrealsense2: {error}", hint="uv sync --extra realsense; apt install libusb-1.0-0") from error
    return pyrealsense2


def _told(device: Any, item: Any) -> str:
    return device.get_info(item) if device.supports(item) else ""
