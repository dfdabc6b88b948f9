"""A FANUC robot over Stream Motion, ROS 2 wire, versions 3 and 4. Driver `fanuc-stream-motion-b`.

The program STREAM_MOTN, which comes with the controller's option, is started over RMI. On this wire silence is
dangerous: the arm coasts at its last speed for about a tenth of a second and then stops hard, without an alarm.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from asc_rt.core.types import Vector
from drivers.base import DriverError, Finding, HandshakeError, LinkError, RobotFaulted, WireTap
from drivers.fanuc_stream_motion import alarms, codec_b
from drivers.fanuc_stream_motion.options import Check, Options, is_number, is_port
from drivers.fanuc_stream_motion.packets import DOF, Command, Status, Thresholds
from drivers.fanuc_stream_motion.rmi import PORT as RMI_PORT
from drivers.fanuc_stream_motion.rmi import Line, Rmi, TcpLine
from drivers.fanuc_stream_motion.session import SECOND_NS, Session
from drivers.fanuc_stream_motion.transport import Transport, UdpTransport

PROGRAM = "STREAM_MOTN"
ASKED_VERSION = 3  # of the capability request: every controller of this wire speaks it
ANSWER_NS = SECOND_NS // 2


@dataclass(frozen=True, slots=True)
class RosOptions(Options):
    NAME: ClassVar[str] = "fanuc-stream-motion-b"
    CHECKS: ClassVar[dict[str, Check]] = {
        "rmi_port": (is_port, "a TCP port, 1 to 65535"),
        "start_move": (lambda v: type(v) is int and 0 <= v <= 9, "commands, 0 to 9"),
        "force_sensor": (lambda v: v in codec_b.FORCE_SENSORS, f"one of {tuple(codec_b.FORCE_SENSORS)}"),
        "settle": (lambda v: is_number(v, 0, 60), "seconds, 0 to 60"),
    }

    rmi_port: int = RMI_PORT
    start_move: int | None = None  # commands that the robot buffers before it moves; None: as it is set
    force_sensor: str = ""  # whose forces the statuses carry; "": none
    settle: float = 2.0  # s that the robot must stay ready: a second after a repeated call it is not, briefly. MEASURED


class StreamMotionB(Session):
    """Options: see `RosOptions`. Errors: see `Session`."""

    def __init__(
        self,
        options: dict[str, Any],
        tap: WireTap | None = None,
        transport: Transport | None = None,
        line: Line | None = None,
    ) -> None:
        self._options = o = RosOptions.parse(options)
        super().__init__(o, tap, transport or UdpTransport(o.host, o.port, o.lock_dir))
        self._rmi = Rmi(line or TcpLine(o.host), o.rmi_port)
        self._version = ASKED_VERSION
        self._buffered = 0  # commands before motion, as the robot says

    def close(self) -> None:
        super().close()
        self._rmi.close()

    @property
    def force(self) -> Vector | None:
        """(6,) N and Nm of the chosen sensor, as the newest status tells; None: it tells none."""
        return None if self._intake.newest is None else self._intake.newest.force

    # --- handshake -----------------------------------------------------------------------------------------------

    def _identify(self) -> str:
        self._rmi.connect()
        self._version = ASKED_VERSION
        self._send(codec_b.encode_stop(self._version))  # of whoever was here before and left no goodbye
        self._send(codec_b.encode_capability_request(self._version))
        capability = self._await(codec_b.Capability)
        if capability is None:
            raise LinkError(
                f"no answer from {self._options.address}",
                hint="check firewall (UDP), and that the controller has options J519 and R912 (or S636)",
            )
        if capability.version < min(codec_b.VERSIONS):
            raise HandshakeError(
                f"the robot speaks this wire up to version {capability.version} only",
                hint="use the driver fanuc-j519 for this controller",
            )
        self._version = min(capability.version, max(codec_b.VERSIONS))
        self._buffered = capability.start_move
        self._configure()
        if self._options.limits:
            self._guard.take(self._ask_tables())
        if self._options.window is not None:
            self._ask_signals()
        return f"FANUC Stream Motion (ROS 2 wire) v{self._version} at {self._options.address}"

    def _configure(self) -> None:
        """What the cell wants of the controller. HandshakeError: it cannot."""
        wanted = self._options.start_move
        if self._options.force_sensor and self._version < 4:
            raise HandshakeError(
                f"the robot speaks version {self._version}, which has no force data",
                hint="take driver.force_sensor out of the cell file, or have the controller's software updated",
            )
        if wanted is None:
            return
        self._send(codec_b.encode_start_move(self._version, wanted))
        told = self._await(codec_b.Capability)
        if told is None or told.start_move != wanted:
            raise HandshakeError(
                f"the robot does not take start_move = {wanted}",
                hint="take driver.start_move out of the cell file, and set it at the pendant",
            )
        self._buffered = wanted

    def _ask_tables(self) -> list[Thresholds]:
        told: list[Thresholds] = []
        for kind in range(3):
            for axis in range(1, DOF + 1):
                self._send(codec_b.encode_threshold_request(self._version, axis, kind))
                answer = self._await(Thresholds)
                if answer is None:
                    return told
                told.append(answer)
        return told

    def _ask_signals(self) -> None:
        assert self._options.window is not None
        self._send(codec_b.encode_gpio(self._version, self._options.window))
        result = self._await(codec_b.GpioResult)
        if result is None or not result.ok:
            raise HandshakeError(
                f"the robot does not tell the signals {self._options.tool_input}",
                hint="correct driver.tool_input, or assign the signals at the pendant",
            )

    def _await(self, kind: type[Any]) -> Any:
        deadline_ns = self._wire.now_ns() + ANSWER_NS
        while (packet := self._receive(deadline_ns)) is not None:
            if isinstance(packet[1], kind):
                return packet[1]
        return None

    def _listen(self, on: bool) -> None:
        self._send((codec_b.encode_start if on else codec_b.encode_stop)(self._version))

    def _question(self) -> bytes:
        return codec_b.encode_capability_request(self._version)

    def findings(self) -> Iterator[Finding]:
        told = self._rmi.status()
        override, pendant = told.get("Override", 100), bool(told.get("TPMode"))
        fix = "set the override to 100 % at the pendant"
        yield Finding("robot override", override == 100, f"{override} %", fix)
        off = "switch the pendant off, mode AUTO"
        yield Finding("robot pendant", not pendant, "enabled" if pendant else "off, as it has to be", off)
        buffered = f"{self._buffered} commands are buffered before the arm moves"
        yield Finding("robot buffer", True, buffered)

    def _begin(self) -> None:
        """The call comes before Start: the other way round the robot never gets ready."""
        self._rmi.start(PROGRAM)
        self._listen(True)
        if self._options.force_sensor:
            self._send(codec_b.encode_force_sensor(self._version, self._options.force_sensor))

    def _await_ready(self) -> tuple[int, Status]:
        settle_ns = round(self._options.settle * SECOND_NS)
        deadline_ns = self._wire.now_ns() + round(self._options.ready_timeout * SECOND_NS) + settle_ns
        since_ns: int | None = None
        while True:
            t_ns, status = self._await_status()
            good = status.ready and not status.trouble and not status.emergency_stop
            since_ns = (t_ns if since_ns is None else since_ns) if good else None
            if since_ns is not None and t_ns - since_ns >= settle_ns:
                return t_ns, status
            if t_ns > deadline_ns:
                raise self._with_alarm(self._diagnose(status))

    def _leave(self) -> None:
        self._listen(False)
        with suppress(DriverError):
            self._rmi.abort()
        if self.fault is not None:
            self.fault = self._with_alarm(self.fault)

    def _has_left(self, status: Status) -> bool:
        return not status.moving

    # --- packets -------------------------------------------------------------------------------------------------

    def _encode(self, seq: int, q: np.ndarray, last: bool) -> bytes:
        return codec_b.encode_command(self._version, seq, q, last)

    def _decode(self, data: bytes) -> object:
        return codec_b.decode(data, self._version)

    def _decode_command(self, data: bytes) -> Command:
        return codec_b.decode_command(data)

    def _diagnose(self, status: Status) -> RobotFaulted:
        if status.emergency_stop:
            return RobotFaulted("emergency stop", hint="release the emergency stop, press RESET")
        if status.trouble:
            return RobotFaulted(f"the robot is not ready: {status.trouble}", hint="clear it at the pendant, RESET")
        return RobotFaulted("the robot takes no motion", hint="AUTO, pendant off, RESET; one PC at a time")

    def _with_alarm(self, fault: RobotFaulted) -> RobotFaulted:
        """What RMI knows about it, told as the pendant shows it."""
        try:
            told = self._rmi.alarms()
        except DriverError:
            return fault
        known = [(text, meaning) for text in told if (meaning := alarms.explain(text))]
        if not known:
            return fault
        text, meaning = known[0]
        return RobotFaulted(f"{fault}; {text}: {meaning.meaning}", hint=meaning.do)
