"""The Remote Motion Interface on TCP: a port to ask at, and one to talk at. Polled once a cycle, never waits.

One session: a second client is let in at the first port and sent on, and then nobody answers it. MEASURED so.
"""

from __future__ import annotations

import socket
from contextlib import suppress

from sim_hil.fanuc.controller_b import ControllerB
from sim_hil.fanuc.rmi import RmiServer

END = b"\r\n"
LONGEST = 1 << 16  # bytes of an unfinished line


class _Client:
    def __init__(self, link: socket.socket) -> None:
        link.setblocking(False)
        self.link = link
        self.buffer = b""
        self.gone = False

    def lines(self) -> list[bytes]:
        try:
            data = self.link.recv(4096)
        except BlockingIOError:
            return []
        except OSError:
            data = b""
        self.buffer += data
        self.gone = not data or len(self.buffer) > LONGEST
        *lines, self.buffer = self.buffer.split(END)
        return lines


class RmiSockets:
    """Listens on `port` and, for the session, on the one after it. OSError: it cannot."""

    def __init__(self, controller: ControllerB, host: str, port: int) -> None:
        self._server = RmiServer(controller, port + 1)
        self._door = _listen(host, port)
        try:
            self._room = _listen(host, port + 1)
        except OSError:
            self._door.close()
            raise
        self._asking: list[_Client] = []
        self._session: _Client | None = None

    def poll(self) -> None:
        self._asking += [_Client(link) for link in _accepted(self._door)]
        if self._session is None:
            self._session = next((_Client(link) for link in _accepted(self._room)), None)
        for client in [*self._asking, *([self._session] if self._session else [])]:
            for line in client.lines():
                for reply in self._server.handle(line):
                    with suppress(OSError):
                        client.link.send(reply + END)
            if client.gone:
                client.link.close()
        self._asking = [client for client in self._asking if not client.gone]
        if self._session is not None and self._session.gone:
            self._session = None

    def close(self) -> None:
        for client in [*self._asking, *([self._session] if self._session else [])]:
            client.link.close()
        self._door.close()
        self._room.close()


def _listen(host: str, port: int) -> socket.socket:
    link = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    link.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    link.setblocking(False)
    try:
        link.bind((host, port))
        link.listen(4)
    except OSError:
        link.close()
        raise
    return link


def _accepted(door: socket.socket) -> list[socket.socket]:
    try:
        return [door.accept()[0]]
    except OSError:
        return []
