"""The message bus between our processes: the only file that knows zenoh.

The supervisor is the router, every other process a client of it. Nobody scouts: the address is the cell's
`bus.endpoint`, on loopback. Other machines come in by a door of their own: mutual TLS, and rights for each name.
Readers are polled channels, never Python callbacks, so that no foreign thread takes the interpreter from the control
loop.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import zenoh

from asc_rt.topics import Rights

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
        self._queryables: list[Any] = []  # undeclared when they are forgotten

    def latest(self, key: str) -> Latest:
        return Latest(self._session.declare_subscriber(key, zenoh.handlers.RingChannel(1)))

    def queue(self, key: str) -> Queue:
        return Queue(self._session.declare_subscriber(key, zenoh.handlers.RingChannel(QUEUE_CAPACITY)))

    def publisher(self, key: str) -> Publisher:
        return Publisher(self._session.declare_publisher(key, congestion_control=zenoh.CongestionControl.DROP))

    def event_publisher(self, key: str) -> Publisher:
        """For messages that must not be dropped: put() waits when the line is full. Never inside a cycle."""
        return Publisher(self._session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK))

    def answer(self, key: str, reply: Callable[[], bytes]) -> None:
        """Answer every question at `key`, on a foreign thread: not in the control process."""
        self._queryables.append(
            self._session.declare_queryable(key, lambda query: query.reply(query.key_expr, reply()))
        )

    def ask(self, key: str, timeout_s: float) -> bytes | None:
        """The first answer at `key`; waits for it. None: nobody answered."""
        for reply in self._session.get(key, timeout=timeout_s):
            if reply.ok is not None:
                return bytes(reply.ok.payload.to_bytes())
        return None

    def close(self) -> None:
        self._session.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


@dataclass(frozen=True, slots=True)
class Keys:
    """Files in PEM: who is trusted, who we are, and our private key."""

    authority: Path
    certificate: Path
    key: Path

    @classmethod
    def of(cls, folder: Path, name: str) -> Keys:
        return cls(folder / "authority.pem", folder / f"{name}.pem", folder / f"{name}.key")


@dataclass(frozen=True, slots=True)
class Remote:
    """The way in for other machines: TLS, both sides with a certificate of the cell's authority, and for each name in a
    certificate the keys that it may use."""

    endpoint: str  # "tls/HOST:PORT"
    keys: Keys
    rights: Mapping[str, Rights]  # by the certificate's common name


def open_router(endpoint: str, remote: Remote | None = None) -> Bus:
    """Listen on `endpoint` ("tcp/HOST:PORT"), and for other machines where `remote` says so. BusError: the port is in
    use, or a file of the keys cannot be used."""
    endpoints, more = [endpoint], {}
    if remote is not None:
        endpoints.append(remote.endpoint)
        more = {"transport/link/tls": _tls("listen", remote.keys), "access_control": _access(remote.rights)}
    try:
        return Bus(zenoh.open(_config("router", "listen", endpoints, more)))
    except zenoh.ZError as error:
        raise BusError(
            f"cannot listen on bus.endpoint {' and '.join(endpoints)}",
            "another session is running, or another program has the port: end it, or set another bus.endpoint"
            + ("; or see that the files of bus.remote.keys are there (asc keys CELL makes them)" if remote else ""),
        ) from error


def open_client(endpoint: str, timeout_s: float = 5.0, keys: Keys | None = None) -> Bus:
    """Join the router on `endpoint`; `keys`: for one on another machine. BusError: nobody listens there within
    `timeout_s`, or it does not know us."""
    more = {} if keys is None else {"transport/link/tls": _tls("connect", keys)}
    deadline = time.monotonic() + timeout_s
    while True:
        try:
            return Bus(zenoh.open(_config("client", "connect", [endpoint], more)))
        except zenoh.ZError as error:
            if time.monotonic() >= deadline:
                hint = "start it with `asc run`" + ("; or see whose authority signed our certificate" if keys else "")
                raise BusError(f"nobody listens on bus.endpoint {endpoint}", hint) from error
            time.sleep(0.05)


def _config(mode: str, role: str, endpoints: list[str], more: dict[str, Any]) -> zenoh.Config:
    config = zenoh.Config()
    settings = {
        "mode": mode,
        "listen/endpoints": [],
        "connect/endpoints": [],
        f"{role}/endpoints": endpoints,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,  # slower for small messages, and leaves files behind
        **more,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _tls(role: str, keys: Keys) -> dict[str, Any]:
    return {
        "root_ca_certificate": str(keys.authority),
        f"{role}_certificate": str(keys.certificate),
        f"{role}_private_key": str(keys.key),
        "enable_mtls": True,
        "verify_name_on_connect": True,
    }


def _access(rights: Mapping[str, Rights]) -> dict[str, Any]:
    """Deny by default; this machine's own processes everything, each certificate its keys."""
    every = ["put", "delete", "declare_subscriber", "query", "reply", "declare_queryable"]
    rules = [_rule("everything", "both", every, ["**"])]
    policies = [{"rules": ["everything"], "subjects": ["here"]}]
    subjects: list[dict[str, Any]] = [{"id": "here", "interfaces": ["lo"], "link_protocols": ["tcp"]}]
    for name, keys in rights.items():
        own = [
            _rule(f"{name} says", "ingress", ["put"], keys.says),
            _rule(f"{name} is heard", "egress", ["declare_subscriber"], keys.says),  # else it does not send at all
            _rule(f"{name} listens", "ingress", ["declare_subscriber"], keys.hears),
            _rule(f"{name} hears", "egress", ["put"], keys.hears),
            _rule(f"{name} asks", "ingress", ["query"], keys.asks),
            _rule(f"{name} is answered", "egress", ["reply", "declare_queryable"], keys.asks),
        ]
        rules += [rule for rule in own if rule["key_exprs"]]
        subjects.append({"id": name, "cert_common_names": [name], "link_protocols": ["tls"]})
        policies.append({"rules": [rule["id"] for rule in own if rule["key_exprs"]], "subjects": [name]})
    return {"enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies}


def _rule(name: str, flow: str, messages: list[str], keys: Sequence[str]) -> dict[str, Any]:
    flows = ["ingress", "egress"] if flow == "both" else [flow]
    return {"id": name, "permission": "allow", "flows": flows, "messages": messages, "key_exprs": list(keys)}
