"""A FANUC robot over Stream Motion, classic wire, versions 1-3. Driver `fanuc-j519`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from asc_rt.core.types import JointState, Vector
from drivers.base import Finding, HandshakeError, LinkError, RobotFaulted, WireTap
from drivers.fanuc_stream_motion import alarms, codec
from drivers.fanuc_stream_motion.limits import FLOAT32_STEP
from drivers.fanuc_stream_motion.options import ClassicOptions
from drivers.fanuc_stream_motion.packets import DOF, Command, Commanded, Status, Thresholds, VersionReply
from drivers.fanuc_stream_motion.session import NOMINAL_PERIOD_NS, SECOND_NS, Session
from drivers.fanuc_stream_motion.transport import Transport, UdpTransport

IDENTITY_TIMEOUT_NS = SECOND_NS // 2
TABLE_TIMEOUT_NS = SECOND_NS // 5


class StreamMotion(Session):
    """Options: see `ClassicOptions`. Errors: see `Session`."""

    def __init__(self, options: dict[str, Any], tap: WireTap | None = None, transport: Transport | None = None) -> None:
        self._options = o = ClassicOptions.parse(options)
        super().__init__(o, tap, transport or UdpTransport(o.host, o.port, o.lock_dir))

    def activate(self, period_ns: int) -> JointState:
        if self._options.version == 1 and self._options.limits and period_ns < NOMINAL_PERIOD_NS:
            raise HandshakeError(
                f"version 1 rounds set-points too coarsely for a cycle of {period_ns * 1e-6:g} ms",
                hint="set driver.version = 2 or 3 in the cell file",
            )
        return super().activate(period_ns)

    def commanded(self, deadline_ns: int) -> Vector | None:
        """Where the controller wants the arm to be, (6,) rad. Before the first command; ten times a second at most."""
        self._send(codec.encode_commanded_request(self._options.version))
        while (packet := self._receive(deadline_ns)) is not None:
            if isinstance(packet[1], Commanded):
                return packet[1].q
        return None

    # --- handshake -----------------------------------------------------------------------------------------------

    def _identify(self) -> str:
        """Asked before any Start, which raises an alarm if the version is wrong. Known clients ask after one, so try
        that too. Version 1 has no version request: a status has to do.
        """
        wanted = self._options.version
        for started in (False, True) if wanted > 1 else (True,):
            if started:
                self._begin()
            if wanted > 1:
                self._send(codec.encode_version_request(wanted))
            answer = self._await_identity(wanted)
            if started:
                self._leave()
            if isinstance(answer, VersionReply) and answer.version < wanted:
                raise HandshakeError(
                    f"the robot speaks Stream Motion up to version {answer.version}, not {wanted}",
                    hint=f"set driver.version = {answer.version} in the cell file",
                )
            if answer is not None:
                if self._options.limits:
                    self._read_tables()
                return f"FANUC Stream Motion v{wanted} at {self._options.address}"
        raise LinkError(
            f"no answer from {self._options.address}",
            hint="check robot power, cable, address and firewall (UDP), and that the controller has option J519",
        )

    def _await_identity(self, wanted: int) -> object | None:
        deadline_ns = self._wire.now_ns() + IDENTITY_TIMEOUT_NS
        while (packet := self._receive(deadline_ns)) is not None:
            if isinstance(packet[1], VersionReply) or wanted == 1:
                return packet[1]
        return None

    def _read_tables(self) -> None:
        """Some controllers answer only while statuses flow, some only while no program waits: without, then with."""
        for started in (False, True):
            if started:
                self._begin()
            told = self._ask_tables()
            if started:
                self._leave()
            if told:
                self._guard.take(told)
                return
        raise HandshakeError(
            "the robot does not tell its limit tables",
            hint="end the TP program, start this, then the program; or set driver.limits = false",
        )

    def _ask_tables(self) -> list[Thresholds]:
        """All 18 tables; none if one request has no answer."""
        told: list[Thresholds] = []
        for kind in range(3):
            for axis in range(1, DOF + 1):
                self._send(codec.encode_threshold_request(self._options.version, axis, kind))
                answer = self._await_table(axis, kind)
                if answer is None:
                    return []
                told.append(answer)
        return told

    def _await_table(self, axis: int, kind: int) -> Thresholds | None:
        deadline_ns = self._wire.now_ns() + TABLE_TIMEOUT_NS
        while (packet := self._receive(deadline_ns)) is not None:
            if isinstance(packet[1], Thresholds) and (packet[1].axis, packet[1].kind) == (axis, kind):
                return packet[1]
        return None

    def _listen(self, on: bool) -> None:
        self._send((codec.encode_start if on else codec.encode_stop)(self._options.version))

    def _question(self) -> bytes:
        """Version 1 has no version request."""
        version = self._options.version
        return codec.encode_version_request(version) if version > 1 else codec.encode_threshold_request(1, 1, 0)

    def findings(self) -> Iterator[Finding]:
        yield Finding("robot override", True, "this wire does not tell it: it has to be 100 % at the pendant")

    def _await_ready(self) -> tuple[int, Status]:
        deadline_ns = self._wire.now_ns() + round(self._options.ready_timeout * SECOND_NS)
        while True:
            t_ns, status = self._await_status()
            if status.ready and status.servo_on:
                return t_ns, status
            if t_ns > deadline_ns and not status.servo_on:
                raise RobotFaulted("servo power is off", hint="release the emergency stop, press RESET at the pendant")
            if t_ns > deadline_ns:
                raise RobotFaulted(
                    "no program on the robot waits for set-points",
                    hint="clear alarms with RESET, then start the TP program with IBGN start[] in AUTO",
                )

    # --- packets -------------------------------------------------------------------------------------------------

    @property
    def _rounding(self) -> float:
        return FLOAT32_STEP if self._options.version == 1 else 0.0

    def _encode(self, seq: int, q: np.ndarray, last: bool) -> bytes:
        return codec.encode_command(self._options.version, seq, q, last, self._options.window)

    def _decode(self, data: bytes) -> object:
        return codec.decode(data, self._options.version)

    def _decode_command(self, data: bytes) -> Command:
        return codec.decode_command(data)

    def _diagnose(self, status: Status) -> RobotFaulted:
        """This wire tells no alarm number: what is seen from here."""
        if not status.servo_on:
            return RobotFaulted("servo power went off", hint="release the emergency stop, press RESET at the pendant")
        if self.counters.missing or self.counters.pauses:
            meaning = alarms.MEANINGS[alarms.LATE_ALARM]
            return RobotFaulted(
                f"the robot left the session; probably {alarms.LATE_ALARM}: {meaning.meaning}", hint=meaning.do
            )
        return RobotFaulted(
            "the robot left the session", hint="read the alarm at the pendant, RESET, start the program"
        )
