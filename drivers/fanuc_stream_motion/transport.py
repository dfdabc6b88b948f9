"""Where the packets go. The link knows only this Protocol, so that it runs against a controller in its own thread."""

from __future__ import annotations

import socket
import time
from typing import Protocol

from drivers.base import LinkError
from drivers.owner import OwnerLock

_RECEIVE_BUFFER = 1 << 18  # bytes: seconds of status packets, so that a stall of ours loses none
_MAX_DATAGRAM = 2048


class Transport(Protocol):
    foreign: int  # datagrams of other peers, skipped

    def open(self) -> None:
        """Idempotent. LinkError: it cannot be opened. OwnershipError: another process commands this robot."""

    def now_ns(self) -> int:
        """The clock of the deadlines."""

    def send(self, data: bytes) -> int:
        """Send one datagram; when it left [ns]. LinkError: it did not."""

    def receive(self, deadline_ns: int) -> tuple[int, bytes] | None:
        """The next datagram of the controller; after the deadline only what is already here, then None."""

    def close(self) -> None:
        """Idempotent."""


class UdpTransport:
    """One socket of ours, one robot at `host`:`port`, and the lock that keeps it so among the processes of this PC."""

    def __init__(self, host: str, port: int, lock_dir: str | None = None) -> None:
        self.foreign = 0
        self._host, self._port = host, port
        self._peer = (host, port)
        self._lock_dir = lock_dir
        self._lock: OwnerLock | None = None
        self._socket: socket.socket | None = None

    def open(self) -> None:
        if self._socket is not None:
            return
        try:
            self._peer = (socket.gethostbyname(self._host), self._port)
            local = local_address(self._peer)
        except OSError as error:
            raise LinkError(
                f"no way to {self._host}: {error.strerror or error}",
                hint="check the robot's address in the cell file and this PC's network",
            ) from error
        lock = OwnerLock("j519-{}-{}".format(*self._peer), self._lock_dir)
        lock.acquire()
        self._lock = lock
        # Left unconnected: packets of other peers can then be counted, and an absent robot is silence, not an error.
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
        self._socket.bind((local, 0))

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def send(self, data: bytes) -> int:
        try:
            self._open_socket().sendto(data, self._peer)
        except OSError as error:
            raise LinkError(
                f"cannot send to {self._host}:{self._port}: {error.strerror or error}",
                hint="check the cable and this PC's address on the robot's network",
            ) from error
        return time.monotonic_ns()

    def receive(self, deadline_ns: int) -> tuple[int, bytes] | None:
        link = self._open_socket()
        while True:
            link.settimeout(max(0.0, (deadline_ns - time.monotonic_ns()) * 1e-9))
            try:
                data, peer = link.recvfrom(_MAX_DATAGRAM)
            except (BlockingIOError, TimeoutError):
                return None
            except OSError as error:
                raise LinkError(
                    f"cannot receive from {self._host}:{self._port}: {error.strerror or error}",
                    hint="check the cable and this PC's network",
                ) from error
            if peer == self._peer:
                return time.monotonic_ns(), data
            self.foreign += 1

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def _open_socket(self) -> socket.socket:
        if self._socket is None:
            raise LinkError("the link is closed", hint="configure() comes first")
        return self._socket


def local_address(peer: tuple[str, int]) -> str:
    """This PC's address on the way to `peer`, so that no other network reaches our socket. Sends nothing."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(peer)
        return str(probe.getsockname()[0])
