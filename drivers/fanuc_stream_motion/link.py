"""A FANUC robot over Stream Motion: the session. Driver `fanuc-j519`, classic wire, versions 1-3.

The controller sends one numbered status each cycle, and every number wants exactly one command with that number. So one
`read()` stands for one number: queued statuses come out one by one, and the sample after a gap comes out once for each
number that was lost, so that the core decides a set-point for every one of them. No set-point is ever made up here.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np

from asc_rt.core.types import CommandKind, JointCommand, JointState, RobotFlag, StopRequest, Vector, vector
from drivers.base import (
    DriverCaps,
    DriverError,
    HandshakeError,
    LinkError,
    Pacing,
    RobotFaulted,
    WireTap,
    WriteReceipt,
)
from drivers.fanuc_stream_motion import codec
from drivers.fanuc_stream_motion.codec import Status, VersionReply
from drivers.fanuc_stream_motion.options import Options
from drivers.fanuc_stream_motion.transport import Transport, UdpTransport

_SECOND = 1_000_000_000
NOMINAL_PERIOD_NS = 8_000_000  # DATASHEET R-30iB; the true one is measured in activate()
IDENTITY_TIMEOUT_NS = _SECOND // 2
ANSWER_TIMEOUT_NS = 1 * _SECOND
LEAVE_TIMEOUT_NS = 1 * _SECOND  # to drain ten commands and to come to rest
PERIOD_SAMPLES = 25  # 0.2 s: one late wake-up at either end stays far below PERIOD_TOLERANCE
PERIOD_TOLERANCE = 0.25  # the possible periods (2, 4, 8 ms) are a factor of two apart


class _Phase(Enum):
    CLOSED = 0
    CONFIGURED = 1  # link open, no session
    MONITORING = 2  # statuses flow, nothing was commanded
    STREAMING = 3
    FINISHED = 4  # last_data sent


@dataclass(slots=True)
class Counters:
    """What came in since configure()."""

    new: int = 0
    stale: int = 0  # repeated or reordered: their number was answered before
    missing: int = 0  # numbers that did not come in their turn


class StreamMotion:
    """Options: see `Options`. Errors: LinkError, HandshakeError, ProtocolError, RobotFaulted, OwnershipError."""

    def __init__(self, options: dict[str, Any], tap: WireTap | None = None, transport: Transport | None = None) -> None:
        self._options = Options.parse(options)
        self._tap = tap
        o = self._options
        self._wire = transport or UdpTransport(o.host, o.port, o.lock_dir)
        self._phase = _Phase.CLOSED
        self._period_ns = NOMINAL_PERIOD_NS
        self._forget()

    def _forget(self) -> None:
        """As before any status or command."""
        self.counters = Counters()
        self._newest: Status | None = None
        self._joint: JointState | None = None  # the newest status as last given to the core
        self._sent: codec.Command | None = None
        self._sent_before: codec.Command | None = None
        self._sent_at_read: codec.Command | None = None
        self._faulted = False

    @property
    def foreign(self) -> int:
        """Datagrams of other peers, skipped."""
        return self._wire.foreign

    # --- life ----------------------------------------------------------------------------------------------------

    def configure(self) -> DriverCaps:
        if self._phase is _Phase.CLOSED:
            try:
                self._wire.open()
                self._identify()
            except DriverError:
                self.close()
                raise
            self._phase = _Phase.CONFIGURED
        return DriverCaps(
            dof=codec.DOF,
            pacing=Pacing.DEVICE,
            kinds=frozenset({CommandKind.POSITION}),
            period_ns=NOMINAL_PERIOD_NS,
            identity=f"FANUC Stream Motion v{self._options.version} at {self._options.address}",
        )

    def activate(self, period_ns: int) -> JointState:
        if self._phase is not _Phase.CONFIGURED:
            raise LinkError("the link is not configured", hint="configure() comes before activate()")
        self._forget()
        self._period_ns = period_ns
        try:
            self._drain()
            self._phase = _Phase.MONITORING
            self._send(codec.encode_start(self._options.version))
            self._measure_period(period_ns)
            t_ns, status = self._await_ready()
        except DriverError:
            self.stop()
            raise
        return self._sample(t_ns, status)

    def read(self, deadline_ns: int) -> JointState | None:
        if self._phase in (_Phase.CLOSED, _Phase.CONFIGURED):
            raise LinkError("no session", hint="activate() comes before read()")
        if self._phase is _Phase.MONITORING:
            return self._read_newest(deadline_ns)
        return self._read_next(deadline_ns)

    def write(self, command: JointCommand) -> WriteReceipt:
        if command.kind is not CommandKind.POSITION:
            raise ValueError(f"a Stream Motion robot takes positions, not {command.kind.name}")
        newest, sent = self._newest, self._sent
        if newest is None or self._phase in (_Phase.CLOSED, _Phase.CONFIGURED):
            raise LinkError("no session", hint="activate() comes before write()")
        seq = newest.seq if sent is None else (sent.seq + 1) % codec.SEQUENCE_SPAN
        data = codec.encode_command(self._options.version, seq, command.q, command.is_last)
        told = codec.decode_command(data)
        asked_for = codec.sequence_distance(newest.seq, seq) >= 0
        if not (asked_for and newest.ready) or self._faulted or self._phase is _Phase.FINISHED:
            return WriteReceipt(self._wire.now_ns(), seq, told.q, ok=False)
        t_ns = self._send(data)
        self._sent_before, self._sent = sent, told
        self._phase = _Phase.FINISHED if told.last else _Phase.STREAMING
        return WriteReceipt(t_ns, seq, told.q, ok=True)

    def stop(self, request: StopRequest | None = None) -> None:
        if self._phase in (_Phase.CLOSED, _Phase.CONFIGURED):
            return
        # Every way out of the loop ends here: a stop that fails must not hide why it was asked for.
        with suppress(Exception):
            self._finish()
        with suppress(Exception):
            self._send(codec.encode_stop(self._options.version))
        self._phase = _Phase.CONFIGURED

    def close(self) -> None:
        self.stop()
        self._wire.close()
        self._phase = _Phase.CLOSED

    # --- handshake -----------------------------------------------------------------------------------------------

    def _identify(self) -> None:
        """Is there a controller that speaks our version?

        Asked before any Start, which raises an alarm if the version is wrong. Known clients ask after one, so try that
        too. Version 1 has no version request: a status has to do.
        """
        wanted = self._options.version
        for started in (False, True) if wanted > 1 else (True,):
            if started:
                self._send(codec.encode_start(wanted))
            if wanted > 1:
                self._send(codec.encode_version_request(wanted))
            answer = self._await_identity(wanted)
            if started:
                self._send(codec.encode_stop(wanted))
            if isinstance(answer, VersionReply) and answer.version < wanted:
                raise HandshakeError(f"the robot speaks Stream Motion up to version {answer.version}, not {wanted}",
                                     hint=f"set driver.version = {answer.version} in the cell file")
            if answer is not None:
                return
        raise LinkError(
            f"no answer from {self._options.address}",
            hint="check robot power, cable, address and firewall (UDP), and that the controller has option J519",
        )

    def _await_identity(self, wanted: int) -> Status | VersionReply | None:
        deadline_ns = self._wire.now_ns() + IDENTITY_TIMEOUT_NS
        while (packet := self._receive(deadline_ns)) is not None:
            if isinstance(packet[1], VersionReply) or wanted == 1:
                return packet[1]
        return None

    def _measure_period(self, period_ns: int) -> None:
        """Mean over a growing window, so that a busy PC needs a longer look instead of failing."""
        first: tuple[int, Status] | None = None
        measured = 0.0
        for _ in range(4 * PERIOD_SAMPLES):
            t_ns, status = self._await_status()
            if first is None or codec.sequence_distance(status.seq, first[1].seq) <= 0:
                first = (t_ns, status)
                continue
            cycles = codec.sequence_distance(status.seq, first[1].seq)
            measured = (t_ns - first[0]) / cycles
            if cycles >= PERIOD_SAMPLES and abs(measured - period_ns) <= PERIOD_TOLERANCE * period_ns:
                return
        raise HandshakeError(f"the robot's cycle is {measured * 1e-6:.2f} ms, the cell's {period_ns * 1e-6:g} ms",
                             hint="set the cell's period to the robot's cycle (8, 4 or 2 ms)")

    def _await_ready(self) -> tuple[int, Status]:
        deadline_ns = self._wire.now_ns() + round(self._options.ready_timeout * _SECOND)
        while True:
            t_ns, status = self._await_status()
            if status.ready and status.servo_on:
                return t_ns, status
            if t_ns > deadline_ns and not status.servo_on:
                raise RobotFaulted("servo power is off", hint="release the emergency stop, press RESET at the pendant")
            if t_ns > deadline_ns:
                raise RobotFaulted("no program on the robot waits for set-points",
                                   hint="clear alarms with RESET, then start the TP program with IBGN start[] in AUTO")

    def _await_status(self) -> tuple[int, Status]:
        deadline_ns = self._wire.now_ns() + ANSWER_TIMEOUT_NS
        while (packet := self._receive(deadline_ns)) is not None:
            if isinstance(packet[1], Status):
                self._newest = packet[1]
                return packet[0], packet[1]
        raise LinkError(f"{self._options.address} sends no status",
                        hint="check the pendant for MOTN-607 (version) and whether another PC stopped the stream")

    # --- statuses ------------------------------------------------------------------------------------------------

    def _read_newest(self, deadline_ns: int) -> JointState | None:
        """Before the first command no status wants an answer: the newest counts."""
        packet = self._receive_status(deadline_ns)
        while packet is not None and (later := self._receive_status(0)) is not None:
            packet = later
        return self._accept(*packet) if packet else None

    def _read_next(self, deadline_ns: int) -> JointState | None:
        sent, before = self._sent, self._sent_at_read
        self._sent_at_read = sent
        if sent is None or self._newest is None:
            return None
        lost = codec.sequence_distance(self._newest.seq, sent.seq)
        if sent is not before and 0 < lost <= codec.QUEUE_CAPACITY:
            return self._joint  # once more, for a number that came between it and the sample before
        while (packet := self._receive_status(deadline_ns)) is not None:
            if codec.sequence_distance(packet[1].seq, self._newest.seq) > 0:
                return self._accept(*packet)
            self.counters.stale += 1
        return None

    def _receive_status(self, deadline_ns: int) -> tuple[int, Status] | None:
        while (packet := self._receive(deadline_ns)) is not None:
            if isinstance(packet[1], Status):
                return packet[0], packet[1]
        return None

    def _accept(self, t_ns: int, status: Status) -> JointState:
        if self._phase is _Phase.STREAMING and not (status.ready and status.servo_on):
            self._faulted = True  # latched: what happens after a lost session is not a continuation of it
        return self._sample(t_ns, status)

    def _sample(self, t_ns: int, status: Status) -> JointState:
        dq = vector(np.zeros(codec.DOF))
        if self._newest is not None:
            cycles = codec.sequence_distance(status.seq, self._newest.seq)
            if cycles > 0:
                self.counters.missing += cycles - 1
                dq = vector((status.q - self._newest.q) / (cycles * self._period_ns * 1e-9))
        self.counters.new += 1
        self._newest = status
        self._joint = JointState(
            t_rx_ns=t_ns,
            t_device_ns=status.t_ms * 1_000_000,
            seq=status.seq,
            q=status.q,
            dq=dq,
            current=status.current,
            flags=self._flags(status),
            tool_id=0,
            dq_is_estimated=True,
        )
        return self._joint

    def _flags(self, status: Status) -> RobotFlag:
        flags = RobotFlag(0)
        if status.ready:
            flags |= RobotFlag.READY
        if status.servo_on:
            flags |= RobotFlag.SERVO_ON
        if status.moving:
            flags |= RobotFlag.MOVING
        if self._faulted:
            flags |= RobotFlag.FAULTED
        return flags

    # --- leaving -------------------------------------------------------------------------------------------------

    def _finish(self) -> None:
        """At rest: last_data, then let the controller drain. Moving: silence stops the robot best, by its own rule."""
        if self._phase is _Phase.STREAMING and self._is_at_rest() and self._sent is not None:
            seq = (self._sent.seq + 1) % codec.SEQUENCE_SPAN
            self._send(codec.encode_command(self._options.version, seq, self._sent.q, last=True))
        if self._sent is not None:
            deadline_ns = self._wire.now_ns() + LEAVE_TIMEOUT_NS
            while (packet := self._receive_status(deadline_ns)) is not None:
                if not packet[1].ready and not packet[1].moving:
                    break

    def _is_at_rest(self) -> bool:
        """The commanded set-point stands still. A single one does: it is where the arm was."""
        if self._sent is None or self._faulted:
            return False
        before: Vector = self._sent_before.q if self._sent_before else self._sent.q
        return bool(np.abs(self._sent.q - before).max() < 1e-6)

    # --- packets -------------------------------------------------------------------------------------------------

    def _send(self, data: bytes) -> int:
        t_ns = self._wire.send(data)
        if self._tap is not None:
            self._tap("tx", t_ns, data)
        return t_ns

    def _receive(self, deadline_ns: int) -> tuple[int, Status | VersionReply] | None:
        packet = self._wire.receive(deadline_ns)
        if packet is None:
            return None
        if self._tap is not None:
            self._tap("rx", *packet)
        return packet[0], codec.decode(packet[1], self._options.version)

    def _drain(self) -> None:
        """Throw away what an earlier session left in the socket."""
        while self._wire.receive(0) is not None:
            pass
