"""The wire side of a simulated depth camera: greets a client and sends it pictures, or does wrong as a test asks.

A wire format of its own hand (drivers/cameras/stream.py tells it; neither imports the other).
"""

from __future__ import annotations

import socket
import struct
import zlib
from dataclasses import dataclass, field
from typing import Any

from sim_hil.depth import UNIT, Optics
from sim_hil.human import clock_id


@dataclass(slots=True)
class Faults:
    """What a test makes the camera do wrong."""

    freeze: bool = False  # the same picture for ever
    silent: bool = False
    cover: bool = False  # something lies on the lens
    clock_ns: int = 0  # added to every stamp
    damage: bool = False  # one bit of the picture flips on the wire


@dataclass(slots=True)
class StreamServer:
    """One client; a frame nobody takes is dropped, as a camera does."""

    host: str  # where clients find it
    port: int
    optics: Optics
    serial: str
    period_ns: int
    latency_ns: int = 10_000_000
    faults: Faults = field(default_factory=Faults)
    seq: int = 0
    _listener: Any = None
    _client: socket.socket | None = None
    _frozen: bytes = b""

    def open(self) -> int:
        """Listen; the port (chosen by the system if it was 0)."""
        self._listener = socket.create_server((self.host, self.port))
        self._listener.setblocking(False)
        return int(self._listener.getsockname()[1])

    def send(self, depth: Any, t_mid_exposure_ns: int) -> None:
        """One picture, (height, width) counts of UNIT."""
        self.seq += 1
        self._greet()
        if self._client is None or self.faults.silent:
            return
        data = depth.astype("<u2").tobytes()
        if self.faults.cover:
            data = bytes(len(data))
        if self.faults.freeze:
            data = self._frozen = self._frozen or data
        crc = zlib.crc32(data)
        if self.faults.damage:
            data = bytes([data[0] ^ 1]) + data[1:]
        stamp = t_mid_exposure_ns + self.faults.clock_ns
        try:
            self._client.sendall(struct.pack("<4sQqII", b"FRAM", self.seq, stamp, len(data), crc) + data)
        except OSError:
            self._drop()

    def close(self) -> None:
        self._drop()
        self._listener.close()

    def _greet(self) -> None:
        """Take a new client; the one before is dropped."""
        try:
            client, _ = self._listener.accept()
        except BlockingIOError:
            return
        self._drop()
        o = self.optics
        texts = ("simulated", self.serial, "1", clock_id())
        hello = struct.pack(
            "<8sIII5dqq32s32s32s96s", b"ASCDEPTH", 1, o.width, o.height, o.fx, o.fy, o.cx, o.cy, UNIT,
            self.period_ns, self.latency_ns, *(text.encode() for text in texts),
        )  # fmt: skip
        client.settimeout(1.0)
        client.sendall(hello)
        self._client = client

    def _drop(self) -> None:
        if self._client is not None:
            self._client.close()
        self._client = None
