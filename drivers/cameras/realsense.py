"""Intel RealSense depth cameras through pyrealsense2 (extra `realsense`; on Debian it needs libusb-1.0-0).

Post-processing stays off: temporal and hole-filling filters invent depth. The stamp of a frame is the middle of the
exposure where the device tells it (sensor timestamp), else its frame timestamp less half the exposure; the SDK's own
mapping to the host clock is not used (it has produced stamps of the future), the one of `clock.py` is.

The picture, if asked for, is the left infrared one: depth is computed in its pixels, so nothing has to be registered.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from drivers.base import HandshakeError, LinkError
from drivers.cameras.base import CameraInfo, DepthFrame, Intrinsics, check_options, frozen, frozen_image
from drivers.cameras.clock import SIGMA_NS, ForeignClock

QUEUE = 2  # frames of each stream; older ones are dropped by the SDK
TOGETHER_MS = 5  # that depth waits for the infrared of its exposure, if asked for. ASSUMED: sent at once
LEFT = 1  # index of that imager


class RealSense:
    """Options: `serial` (needed with more than one), `width`, `height`, `rate_hz`, `latency_ms` (least, to arrival),
    `infrared` (a picture beside the depth)."""

    def __init__(self, options: dict[str, Any], device: Any = None) -> None:
        number = (int, float)
        known: dict[str, Any] = {"serial": str, "width": int, "height": int, "rate_hz": int, "latency_ms": number}
        check_options("realsense", options, known | {"infrared": bool})
        self._infrared: bool = options.get("infrared", False)
        self._serial = options.get("serial", "")
        self._mode = tuple(options.get(key, default) for key, default in (("width", 640), ("height", 480)))
        self._rate = options.get("rate_hz", 30)
        self._latency_ns = round(options.get("latency_ms", 10.0) * 1e6)  # ASSUMED: readout and USB
        self._device = device
        self._sensor: Any = None
        self._queue: Any = None
        self._clock = ForeignClock(self._latency_ns)

    def open(self) -> CameraInfo:
        self.close()
        rs = _sdk()
        self._sdk, device = rs, self._device or self._find(rs)
        try:
            sensor = device.first_depth_sensor()
            profile = self._profile(sensor, rs.stream.depth, rs.format.z16)
            profiles = [profile]
            if self._infrared:
                profiles.append(self._profile(sensor, rs.stream.infrared, rs.format.y8, LEFT))
            self._queue = rs.frame_queue(QUEUE * len(profiles))
            sensor.open(profiles)
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
            has_image=self._infrared,
        )

    def read(self, deadline_ns: int) -> DepthFrame | None:
        if self._queue is None:
            raise LinkError("RealSense: not open", hint="open() comes before read()")
        frame, picture, t_arrival_ns = self._newest(deadline_ns)
        if frame is None:
            return None
        depth = frozen(np.asanyarray(frame.get_data()))
        image = None if picture is None else frozen_image(np.asanyarray(picture.get_data()))
        t_device_ns = self._middle_of_exposure(frame)
        t_capture_ns = self._clock.capture_ns(t_device_ns, t_arrival_ns)
        return DepthFrame(depth, t_capture_ns, SIGMA_NS, t_device_ns, t_arrival_ns, frame.get_frame_number(), image)

    def close(self) -> None:
        sensor, self._sensor, self._queue = self._sensor, None, None
        if sensor is not None:
            sensor.stop()
            sensor.close()

    def _newest(self, deadline_ns: int) -> tuple[Any, Any, int]:
        """(depth or None at the deadline, infrared of the same exposure or None, when the depth came)."""
        depth, pictures, t_arrival_ns, until_ns = None, dict[int, Any](), 0, deadline_ns
        while frame := self._queue.poll_for_frame() or self._wait(until_ns):
            if frame.get_profile().stream_type() == self._sdk.stream.depth:
                depth, t_arrival_ns = frame, time.monotonic_ns()
                until_ns = t_arrival_ns + self._infrared * TOGETHER_MS * 1_000_000
            else:
                pictures[frame.get_frame_number()] = frame
            if depth is not None and depth.get_frame_number() in pictures:
                until_ns = 0  # only what is there already, which is newer
        return depth, None if depth is None else pictures.get(depth.get_frame_number()), t_arrival_ns

    def _wait(self, until_ns: int) -> Any:
        wait_ms = max((until_ns - time.monotonic_ns()) // 1_000_000, 0)
        found, frame = self._queue.try_wait_for_frame(int(wait_ms))
        return frame if found else None

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

    def _profile(self, sensor: Any, stream: Any, form: Any, index: int = -1) -> Any:
        """The stream of the asked mode; `index` -1: any. HandshakeError: the camera has none."""
        for profile in sensor.get_stream_profiles():
            video = profile.as_video_stream_profile()
            asked = (video.width(), video.height(), profile.fps()) == (*self._mode, self._rate)
            kind = (profile.stream_type(), profile.format(), profile.stream_index() if index >= 0 else index)
            if kind == (stream, form, index) and asked:
                return profile
        mode = f"{self._mode[0]}x{self._mode[1]} at {self._rate} Hz"
        name = str(stream).rpartition(".")[2]
        raise HandshakeError(f"RealSense: no {name} mode {mode}", hint="set width, height and rate_hz to one it has")


def _sdk() -> Any:
    try:
        import pyrealsense2
    except ImportError as error:
        raise LinkError(f"pyrealsense2: {error}", hint="uv sync --extra realsense; apt install libusb-1.0-0") from error
    return pyrealsense2


def _told(device: Any, item: Any) -> str:
    return device.get_info(item) if device.supports(item) else ""
