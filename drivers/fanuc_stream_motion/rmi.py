"""Remote Motion Interface: JSON lines over TCP, by which the PC starts the streaming program. Never inside a cycle."""

from __future__ import annotations

import json
import socket
import time
from contextlib import suppress
from typing import Any, Protocol

from drivers.base import DriverError, HandshakeError, LinkError, ProtocolError, RobotFaulted

PORT = 16001
TIMEOUT_NS = 2_000_000_000
END = b"\r\n"
_LONGEST = 1 << 16

# ErrorID -> what to do. M: from users' reports, the numbers are stable over the versions seen.
HINTS = {
    2556934: "the robot cannot run the program: AUTO, pendant off, no alarm, program STREAM_MOTN installed",
    2556935: "servo power is off: release the emergency stop, press RESET",
    2556936: "the robot cannot run the program: AUTO, pendant off, no alarm, program STREAM_MOTN installed",
    2556941: "the controller's software is too old for Stream Motion over RMI (FRC_Connect_STMO)",
    2556943: "abort all programs at the pendant, press RESET",
    2556954: "another PC is connected: stop it, or switch the controller off and on",
    2556955: "servo power is off: release the emergency stop, press RESET",
    7004: "the program is in use: abort all programs at the pendant",
    7015: "deselect the program RMI_MOVE at the pendant",
}
NOT_PAUSED = 2556938


class Line(Protocol):
    """One connection that carries lines."""

    def open(self, port: int) -> None:
        """Anew, to `port`. LinkError: nobody there."""

    def now_ns(self) -> int: ...

    def send(self, line: bytes) -> None: ...

    def receive(self, deadline_ns: int) -> bytes | None:
        """The next line without its end; None: not by then."""

    def close(self) -> None: ...


class TcpLine:
    def __init__(self, host: str) -> None:
        self._host = host
        self._socket: socket.socket | None = None
        self._buffer = b""

    def open(self, port: int) -> None:
        self.close()
        try:
            self._socket = socket.create_connection((self._host, port), timeout=TIMEOUT_NS * 1e-9)
        except OSError as error:
            raise LinkError(
                f"no RMI connection to {self._host}:{port}: {error.strerror or error}",
                hint="check address and firewall (TCP), and that the controller has option R912",
            ) from error

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def send(self, line: bytes) -> None:
        try:
            self._open_socket().sendall(line + END)
        except OSError as error:
            raise _broken(error) from error

    def receive(self, deadline_ns: int) -> bytes | None:
        link = self._open_socket()
        while END not in self._buffer:
            link.settimeout(max(1e-6, (deadline_ns - time.monotonic_ns()) * 1e-9))
            try:
                data = link.recv(4096)
            except (BlockingIOError, TimeoutError):
                return None
            except OSError as error:
                raise _broken(error) from error
            if not data or len(self._buffer) > _LONGEST:
                raise LinkError("the robot closed the RMI connection", hint="check the pendant; one PC at a time")
            self._buffer += data
        line, _, self._buffer = self._buffer.partition(END)
        return line

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
        self._socket, self._buffer = None, b""

    def _open_socket(self) -> socket.socket:
        if self._socket is None:
            raise LinkError("the RMI connection is closed", hint="configure() comes first")
        return self._socket


class Rmi:
    """One RMI session. Errors: LinkError, HandshakeError, ProtocolError, RobotFaulted."""

    def __init__(self, line: Line, port: int) -> None:
        self._line, self._port = line, port
        self._connected = False

    def connect(self) -> None:
        """Ask for a session and follow to the port that the robot names. Idempotent."""
        if self._connected:
            return
        self._line.open(self._port)
        reply = self._ask("Communication", "FRC_Connect_STMO")
        port = reply.get("PortNumber")
        if type(port) is not int or not 1 <= port <= 65535:
            raise ProtocolError(f"RMI names no port to connect to: {reply}")
        self._line.open(port)
        self._connected = True

    def start(self, program: str) -> None:
        """Make the robot ready and let it run `program`."""
        status = self.status()
        if status.get("TPMode"):
            raise RobotFaulted("the teach pendant is enabled", hint="switch the pendant off, mode AUTO, press RESET")
        if status.get("Override", 100) != 100:
            raise HandshakeError(
                f"the speed override is {status['Override']} %, not 100 %",
                hint="set the override to 100 % at the pendant",
            )
        self._ask("Command", "FRC_Abort")
        self._ask("Command", "FRC_Reset")
        self._ask("Command", "FRC_Initialize", GroupMask=1)
        number = self.status().get("NextSequenceID")
        if type(number) is not int:
            raise ProtocolError("RMI tells no NextSequenceID")
        self._send({"Instruction": "FRC_Call", "SequenceID": number, "ProgramName": program})
        self.status()  # a call need not be answered; once this is, the call has been taken

    def status(self) -> dict[str, Any]:
        return self._ask("Command", "FRC_GetStatus")

    def alarms(self, count: int = 5) -> list[str]:
        """The newest alarms as the pendant shows them."""
        reply = self._ask("Command", "FRC_ReadError", Count=count)
        return [str(reply[key]) for key in sorted(reply) if key.startswith("ErrorData")]

    def abort(self) -> None:
        self._ask("Command", "FRC_Abort")

    def close(self) -> None:
        """Idempotent, never raises."""
        if self._connected:
            with suppress(DriverError):
                self._ask("Communication", "FRC_Disconnect")
        self._connected = False
        self._line.close()

    def _ask(self, kind: str, name: str, **fields: Any) -> dict[str, Any]:
        """The reply to one request; what the robot says in between is passed over, unless it is an error."""
        self._send({kind: name, **fields})
        deadline_ns = self._line.now_ns() + TIMEOUT_NS
        while (line := self._line.receive(deadline_ns)) is not None:
            reply = _parse(line)
            _check(reply)
            if reply.get(kind) == name:
                return reply
        raise LinkError(f"RMI does not answer {name}", hint="one PC at a time; switch the controller off and on")

    def _send(self, message: dict[str, Any]) -> None:
        self._line.send(json.dumps(message).encode())


def _broken(error: OSError) -> LinkError:
    return LinkError(f"the RMI connection broke: {error.strerror or error}", hint="check cable and robot")


def _check(reply: dict[str, Any]) -> None:
    error = reply.get("ErrorID", 0)
    if error in (0, NOT_PAUSED):
        return
    what = reply.get("Instruction") or reply.get("Command") or reply.get("Communication") or "the request"
    raise HandshakeError(
        f"RMI refuses {what}: error {error}", hint=HINTS.get(error, "look the error up at the pendant (menu ALARM)")
    )


def _parse(line: bytes) -> dict[str, Any]:
    try:
        reply = json.loads(line)
    except ValueError as error:
        raise ProtocolError(f"RMI line that is no JSON: {line[:80]!r}") from error
    if not isinstance(reply, dict):
        raise ProtocolError(f"RMI line that is no object: {line[:80]!r}")
    return reply
