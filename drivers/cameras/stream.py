"""A depth camera at the end of a TCP connection: a bridge on another PC, or the simulated camera.

All numbers little-endian. The camera greets with one HELLO, then sends a FRAME for each picture:

    HELLO  "ASCDEPTH" u32 version (1)  u32 width  u32 height  f64 fx fy cx cy  f64 unit_m  i64 period_ns  i64 latency_ns
           char[32] model  char[32] serial  char[32] firmware
           char[96] clock (its name as asc_rt.human_codec tells it; "" if its own)
    FRAME  "FRAM" u64 seq  i64 t_mid_exposure_ns (its clock)  u32 length  u32 crc32 of the depth  depth as u16 rows

If it runs on the clock of this machine its stamps are used as they are; a foreign clock is mapped (`clock.py`).
"""

from __future__ import annotations

import socket
import struct
import time
import zlib
from typing import Any

import numpy as np

from asc_rt.human_codec import clock_id
from drivers.base import HandshakeError, LinkError, ProtocolError
from drivers.cameras.base import CameraInfo, DepthFrame, Intrinsics, check_options, frozen
from drivers.cameras.clock import SIGMA_NS, ForeignClock

HELLO = struct.Struct("<8sIII5dqq32s32s32s96s")
FRAME = struct.Struct("<4sQqII")
MAGIC, VERSION, FRAME_MAGIC = b"ASCDEPTH", 1, b"FRAM"
LARGEST = 4096  # px on one side
CONNECT_S = 5.0


class DepthStream:
    """Options: `host`, `port`."""

    def __init__(self, options: dict[str, Any]) -> None:
        check_options("depth-stream", options, {"host": str, "port": int})
        self._address = (options.get("host", "127.0.0.1"), options.get("port", 0))
        if not 0 < self._address[1] < 65536:
            raise ValueError(f"depth-stream: port: {self._address[1]} is not within 1..65535")
        self._socket: socket.socket | None = None
        self._buffer = bytearray()
        self._clock: ForeignClock | None = None  # None: the camera runs on our clock

    def open(self) -> CameraInfo:
        self.close()
        hint = "start the camera or its bridge, and compare host and port with the cell's"
        try:
            self._socket = socket.create_connection(self._address, CONNECT_S)
            self._socket.settimeout(CONNECT_S)
            while len(self._buffer) < HELLO.size:
                self._receive(HELLO.size - len(self._buffer))
        except OSError as error:
            self.close()
            raise LinkError(f"no depth stream at {self._address[0]}:{self._address[1]}: {error}", hint) from error
        self._info = self._greeted(bytes(self._buffer[: HELLO.size]))
        del self._buffer[: HELLO.size]
        return self._info

    def read(self, deadline_ns: int) -> DepthFrame | None:
        if self._socket is None:
            raise LinkError("the depth stream is not open", hint="open() comes before read()")
        newest = None
        while True:
            frame = self._parse()
            if frame is not None:
                newest = frame
                continue
            left = (deadline_ns - time.monotonic_ns()) * 1e-9 if newest is None else 0.0
            if not self._fill(max(left, 0.0)):
                return newest

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
        self._socket = None
        self._buffer.clear()

    def _fill(self, wait_s: float) -> bool:
        """More bytes within `wait_s`; False: none came. LinkError: the other end is gone."""
        assert self._socket is not None
        self._socket.settimeout(wait_s)
        try:
            self._receive(1 << 20)
        except (TimeoutError, BlockingIOError):
            return False
        except OSError as error:
            raise LinkError(f"the depth stream broke: {error}", hint="is the camera plugged in and running?") from error
        return True

    def _receive(self, size: int) -> None:
        assert self._socket is not None
        data = self._socket.recv(size)
        if not data:
            raise ConnectionResetError("the camera has closed the connection")
        self._buffer += data

    def _greeted(self, data: bytes) -> CameraInfo:
        magic, version, width, height, fx, fy, cx, cy, unit, period, latency, *texts = HELLO.unpack(data)
        model, serial, firmware, clock = (text.rstrip(b"\0").decode("ascii", "replace") for text in texts)
        if magic != MAGIC or version != VERSION:
            raise HandshakeError("the other end is no depth stream of version 1", hint="is the port the camera's?")
        numbers = np.array([fx, fy, unit, period, width, height], float)
        if not (np.isfinite(numbers).all() and (numbers > 0).all() and max(width, height) <= LARGEST and latency >= 0):
            raise HandshakeError("the camera greets with impossible numbers", hint="update the camera's bridge")
        self._clock = None if clock == clock_id() else ForeignClock(latency)
        lens = Intrinsics(width, height, fx, fy, cx, cy)
        return CameraInfo(model, serial, firmware, lens, unit, period, latency)

    def _parse(self) -> DepthFrame | None:
        """The next whole frame in the buffer."""
        if len(self._buffer) < FRAME.size:
            return None
        magic, seq, t_device_ns, length, crc = FRAME.unpack_from(self._buffer)
        lens = self._info.intrinsics
        if magic != FRAME_MAGIC or length != 2 * lens.width * lens.height:
            raise ProtocolError("the depth stream lost its frame boundaries", hint="restart the camera")
        if len(self._buffer) < FRAME.size + length:
            return None
        data = bytes(self._buffer[FRAME.size : FRAME.size + length])
        del self._buffer[: FRAME.size + length]
        if zlib.crc32(data) != crc:
            raise ProtocolError(f"frame {seq} arrived damaged (CRC)", hint="check the camera's cable")
        t_arrival_ns = time.monotonic_ns()
        depth = frozen(np.frombuffer(data, "<u2").reshape(lens.height, lens.width))
        if self._clock is None:
            return DepthFrame(depth, t_device_ns, 0, t_device_ns, t_arrival_ns, seq)
        t_capture_ns, sigma_ns = self._clock.capture_ns(t_device_ns, t_arrival_ns), SIGMA_NS
        return DepthFrame(depth, t_capture_ns, sigma_ns, t_device_ns, t_arrival_ns, seq)
