"""The message bus between our processes: the only file that knows zenoh.

The supervisor is the router, every other process a client of it. Nobody scouts: the address is the cell's
`bus.endpoint`. Readers are polled channels, never Python callbacks, so that no foreign thread takes the interpreter
from the control loop.
"""

from __future__ import annotations

import json
import time
from types import TracebackType
from typing import Any, Self

import zenoh

QUEUE_CAPACITY = 4096  # at 125 Hz half a minute of a reader that does not read; then the oldest are dropped


class BusError(Exception):
    """The bus cannot be opened. `hint` tells the operator what to do, in one line."""

    def __init__(self, message: str, hint: str) -> None:
        super().__init__(message)
        self.hint = hint


class _Inbox:
    def __init__(self, subscriber: Any) -> None:
        self._subscriber = subscriber

    def take(self) -> bytes | None:
        """The next message that was not yet taken, or None. Never waits."""
        sample = self._subscriber.try_recv()
        return None if sample is None else bytes(sample.payload.to_bytes())


class Latest(_Inbox):
    """Newest message of a key; older ones are forgotten."""


class Queue(_Inbox):
    """All messages of a key, in order."""


class Publisher:
    def __init__(self, publisher: Any) -> None:
        self._publisher = publisher

    def put(self, data: bytes) -> None:
        self._publisher.put(data)

    def put_json(self, value: Any) -> None:
        self.put(json.dumps(value).encode())


class Bus:
    """One session. Close it, or use it in a `with`."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session

    def latest(self, key: str) -> Latest:
        return Latest(self._session.declare_subscriber(key, zenoh.handlers.RingChannel(1)))

    def queue(self, key: str) -> Queue:
        return Queue(self._session.declare_subscriber(key, zenoh.handlers.RingChannel(QUEUE_CAPACITY)))

    def publisher(self, key: str) -> Publisher:
        return Publisher(self._session.declare_publisher(key, congestion_control=zenoh.CongestionControl.DROP))

    def event_publisher(self, key: str) -> Publisher:
        """For messages that must not be dropped: put() waits when the line is full. Never inside a cycle."""
        return Publisher(self._session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK))

    def close(self) -> None:
        self._session.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def open_router(endpoint: str) -> Bus:
    """Listen on `endpoint` ("tcp/HOST:PORT"). BusError: the port is in use."""
    try:
        return Bus(zenoh.open(_config("router", "listen", endpoint)))
    except zenoh.ZError as error:
        raise BusError(
            f"cannot listen on bus.endpoint {endpoint}",
            "another session is running, or another program has the port: end it, or set another bus.endpoint",
        ) from error


def open_client(endpoint: str, timeout_s: float = 5.0) -> Bus:
    """Join the router on `endpoint`. BusError: nobody listens there within `timeout_s`."""
    deadline = time.monotonic() + timeout_s
    while True:
        try:
            return Bus(zenoh.open(_config("client", "connect", endpoint)))
        except zenoh.ZError as error:
            if time.monotonic() >= deadline:
                raise BusError(f"nobody listens on bus.endpoint {endpoint}", "start it with `asc run`") from error
            time.sleep(0.05)


def _config(mode: str, role: str, endpoint: str) -> zenoh.Config:
    config = zenoh.Config()
    settings = {
        "mode": mode,
        "listen/endpoints": [],
        "connect/endpoints": [],
        f"{role}/endpoints": [endpoint],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,  # slower for small messages, and leaves files behind
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config
