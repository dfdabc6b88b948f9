"""A streaming session with a FANUC controller, whichever wire it speaks.

The controller sends one numbered status each cycle, and every number wants exactly one command with that number. So one
`read()` stands for one number: queued statuses come out one by one, and the sample after a gap comes out once for each
number that was lost, so that the core decides a set-point for every one of them. Only `stop()` in motion makes
set-points of its own: a jerk-limited stop from what was sent.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from contextlib import suppress

import numpy as np

from asc_rt.core.types import CommandKind, JointCommand, JointState, RobotFlag, StopRequest, Vector, vector
from drivers.base import (
    DriverCaps,
    DriverError,
    Finding,
    HandshakeError,
    LinkError,
    Pacing,
    RobotFaulted,
    WireTap,
    WriteReceipt,
)
from drivers.fanuc_stream_motion import examine
from drivers.fanuc_stream_motion.braking import stop_way
from drivers.fanuc_stream_motion.guard import Guard
from drivers.fanuc_stream_motion.intake import Intake
from drivers.fanuc_stream_motion.options import Options
from drivers.fanuc_stream_motion.packets import (
    DOF,
    QUEUE_CAPACITY,
    SEQUENCE_SPAN,
    Command,
    Status,
    sequence_distance,
)
from drivers.fanuc_stream_motion.progress import Counters, Phase
from drivers.fanuc_stream_motion.transport import Transport

SECOND_NS = 1_000_000_000
NOMINAL_PERIOD_NS = 8_000_000  # DATASHEET R-30iB; the true one is measured in activate()
ANSWER_TIMEOUT_NS = 1 * SECOND_NS
LEAVE_TIMEOUT_NS = 1 * SECOND_NS  # to drain ten commands and to come to rest
PERIOD_SAMPLES = 25  # 0.2 s: one late wake-up at either end stays far below PERIOD_TOLERANCE
PERIOD_TOLERANCE = 0.25  # the possible periods (2, 4, 8 ms) are a factor of two apart
REST_STEP = 1e-6  # rad a cycle
TOOL_UNKNOWN = -1  # the classic wire tells signals only after the first command has asked for them


class Session:
    """Errors: LinkError, HandshakeError, ProtocolError, RobotFaulted, OwnershipError."""

    def __init__(self, options: Options, tap: WireTap | None, transport: Transport) -> None:
        self._common = options
        self._tap = tap
        self._wire = transport
        self._phase = Phase.CLOSED
        self._period_ns = NOMINAL_PERIOD_NS
        self._guard = Guard(options)
        self._forget()

    def _forget(self) -> None:
        """As before any status or command."""
        self.counters = Counters()
        self.fault: RobotFaulted | None = None  # why the session was lost, as far as the robot tells
        self._intake = Intake(self._receive, self.counters)
        self._joint: JointState | None = None  # the newest status as last given to the core
        self._sent: deque[Command] = deque(maxlen=3)
        self._sent_ns = 0
        self._sent_at_read: Command | None = None

    @property
    def foreign(self) -> int:
        """Datagrams of other peers, skipped."""
        return self._wire.foreign

    # --- what the wires differ in --------------------------------------------------------------------------------

    def _identify(self) -> str:
        """Is there a controller that speaks our wire? Its identity; reads the tables if asked for."""
        raise NotImplementedError

    def _listen(self, on: bool) -> None:
        """Statuses flow, or stop; nothing else happens at the robot."""
        raise NotImplementedError

    def _begin(self) -> None:
        """Have the robot's program wait for set-points, as far as that is ours to do, and statuses flow."""
        self._listen(True)

    def _await_ready(self) -> tuple[int, Status]:
        """The first status at which commands are welcome."""
        raise NotImplementedError

    def _leave(self) -> None:
        self._listen(False)

    def _question(self) -> bytes:
        """A request that every controller of this wire answers."""
        raise NotImplementedError

    def findings(self) -> Iterator[Finding]:
        """What else this wire can tell to an examination."""
        raise NotImplementedError

    def _has_left(self, status: Status) -> bool:
        """After the last command: the robot has drained it."""
        return not status.ready and not status.moving

    @property
    def _rounding(self) -> float:
        """By how much the wire rounds an angle, rad."""
        return 0.0

    def _encode(self, seq: int, q: np.ndarray, last: bool) -> bytes:
        raise NotImplementedError

    def _decode(self, data: bytes) -> object:
        raise NotImplementedError

    def _decode_command(self, data: bytes) -> Command:
        raise NotImplementedError

    def _diagnose(self, status: Status) -> RobotFaulted:
        """Why this status is no longer one of a session."""
        raise NotImplementedError

    # --- life ----------------------------------------------------------------------------------------------------

    def configure(self) -> DriverCaps:
        if self._phase is Phase.CLOSED:
            try:
                self._wire.open()
                self._identity = self._identify()
            except DriverError:
                self.close()
                raise
            self._phase = Phase.CONFIGURED
        return DriverCaps(
            dof=DOF,
            pacing=Pacing.DEVICE,
            kinds=frozenset({CommandKind.POSITION}),
            period_ns=NOMINAL_PERIOD_NS,
            identity=self._identity,
            limits=self._guard.joint_limits(self._rounding, NOMINAL_PERIOD_NS * 1e-9),
            tells_tool=self._common.window is not None,
        )

    def activate(self, period_ns: int) -> JointState:
        if self._phase is not Phase.CONFIGURED:
            raise LinkError("the link is not configured", hint="configure() comes before activate()")
        self._forget()
        self._period_ns = period_ns
        self._guard.begin(period_ns * 1e-9)
        try:
            self._drain()
            self._phase = Phase.MONITORING
            self._begin()
            self._measure_period(period_ns)
            t_ns, status = self._await_ready()
            self._guard.check_pose(status)
        except DriverError:
            self.stop()
            raise
        return self._accept(t_ns, status)

    def read(self, deadline_ns: int) -> JointState | None:
        if self._phase in (Phase.CLOSED, Phase.CONFIGURED):
            raise LinkError("no session", hint="activate() comes before read()")
        if self._phase is Phase.MONITORING:
            arrived = self._intake.await_newest(deadline_ns)
            return self._accept(*arrived) if arrived else None
        return self._read_next(deadline_ns)

    def write(self, command: JointCommand) -> WriteReceipt:
        if command.kind is not CommandKind.POSITION:
            raise ValueError(f"a Stream Motion robot takes positions, not {command.kind.name}")
        if self._intake.newest is None or self._phase in (Phase.CLOSED, Phase.CONFIGURED):
            raise LinkError("no session", hint="activate() comes before write()")
        data = self._encode(self._next_number(), command.q, command.is_last)
        told = self._decode_command(data)
        if not self._is_asked_for(told.seq):
            return WriteReceipt(self._wire.now_ns(), told.seq, told.q, ok=False)
        self._guard.refuse(told, self._sent, self._told())
        return WriteReceipt(self._command(data, told), told.seq, told.q, ok=True)

    def stop(self, request: StopRequest | None = None) -> None:
        if self._phase in (Phase.CLOSED, Phase.CONFIGURED):
            return
        # Every way out of the loop ends here: a stop that fails must not hide why it was asked for.
        with suppress(Exception):
            self._finish()
        with suppress(Exception):
            self._leave()
        self._phase = Phase.CONFIGURED

    def close(self) -> None:
        self.stop()
        self._wire.close()
        self._phase = Phase.CLOSED

    # --- examination ---------------------------------------------------------------------------------------------

    def examine(self, period_ns: int) -> Iterator[Finding]:
        """See `drivers.base.Examinable`."""
        yield from examine.examine(self, period_ns)

    @property
    def host(self) -> str:
        return self._common.host

    def watch(self, count: int) -> list[tuple[int, Status]]:
        """So many statuses as they come, without any command. LinkError: none comes."""
        self._forget()
        self._drain()
        self._listen(True)
        try:
            return [self._await_status() for _ in range(count)]
        finally:
            self._listen(False)

    def ask(self) -> int | None:
        """ns until a question is answered; None: it is not."""
        asked_ns = self._send(self._question())
        packet = self._receive(asked_ns + ANSWER_TIMEOUT_NS)
        while packet is not None and isinstance(packet[1], Status):
            packet = self._receive(asked_ns + ANSWER_TIMEOUT_NS)
        return None if packet is None else packet[0] - asked_ns

    def check_pose(self, status: Status) -> None:
        """HandshakeError: the robot is another arm, or means other angles."""
        self._guard.check_pose(status)

    # --- handshake -----------------------------------------------------------------------------------------------

    def _measure_period(self, period_ns: int) -> None:
        """Mean over a growing window, so that a busy PC needs a longer look instead of failing."""
        first: tuple[int, Status] | None = None
        measured = 0.0
        for _ in range(4 * PERIOD_SAMPLES):
            t_ns, status = self._await_status()
            if first is None or sequence_distance(status.seq, first[1].seq) <= 0:
                first = (t_ns, status)
                continue
            cycles = sequence_distance(status.seq, first[1].seq)
            measured = (t_ns - first[0]) / cycles
            if cycles >= PERIOD_SAMPLES and abs(measured - period_ns) <= PERIOD_TOLERANCE * period_ns:
                return
        raise HandshakeError(
            f"the robot's cycle is {measured * 1e-6:.2f} ms, the cell's {period_ns * 1e-6:g} ms",
            hint="set the cell's period to the robot's cycle (8, 4 or 2 ms)",
        )

    def _await_status(self) -> tuple[int, Status]:
        deadline_ns = self._wire.now_ns() + ANSWER_TIMEOUT_NS
        arrived = self._intake.await_one(deadline_ns)
        if arrived is None:
            raise LinkError(
                f"{self._common.address} sends no status",
                hint="check the pendant for MOTN-607 (version) and whether another PC stopped the stream",
            )
        self._intake.newest = arrived[1]
        return arrived

    # --- statuses ------------------------------------------------------------------------------------------------

    def _told(self) -> Status:
        """The newest status; there is one in a session."""
        assert self._intake.newest is not None
        return self._intake.newest

    def _read_next(self, deadline_ns: int) -> JointState | None:
        before, self._sent_at_read = self._sent_at_read, self._sent[-1]
        lost = sequence_distance(self._told().seq, self._sent[-1].seq)
        if self._sent[-1] is not before and 0 < lost <= QUEUE_CAPACITY:
            return self._joint  # once more, for a number that came between it and the sample before
        arrived = self._intake.await_next(deadline_ns, self._sent[-1].seq)
        return self._accept(*arrived) if arrived else None

    def _accept(self, t_ns: int, status: Status) -> JointState:
        before, ahead = self._intake.newest, self._intake.take(status)
        self.fault = self.fault or self._intake.fault
        lost = not (status.ready and status.servo_on) or status.emergency_stop or bool(status.trouble)
        if lost and self._phase is Phase.STREAMING:
            self.fault = self.fault or self._diagnose(status)  # what happens after a lost session does not continue it
        return self._sample(t_ns, status, before, ahead)

    def _sample(self, t_ns: int, status: Status, before: Status | None, ahead: int) -> JointState:
        """`status` for the core, `ahead` numbers after the one `before` it."""
        still = np.zeros(DOF)
        dq = vector((status.q - before.q) / (ahead * self._period_ns * 1e-9) if before and ahead else still)
        self._joint = JointState(
            t_rx_ns=t_ns,
            t_device_ns=status.t_ms * 1_000_000,
            seq=status.seq,
            q=status.q,
            dq=dq,
            current=status.current,
            flags=status.flags | (RobotFlag.FAULTED if self.fault else RobotFlag(0)),
            tool_id=self._tool(status),
            dq_is_estimated=True,
        )
        return self._joint

    def _tool(self, status: Status) -> int:
        window = self._common.window
        if window is None:
            return 0
        return TOOL_UNKNOWN if status.inputs is None else status.inputs & window.mask

    # --- commands ------------------------------------------------------------------------------------------------

    def _next_number(self) -> int:
        return (self._sent[-1].seq + 1) % SEQUENCE_SPAN if self._sent else self._told().seq

    def _is_asked_for(self, seq: int) -> bool:
        newest = self._told()
        due = sequence_distance(newest.seq, seq) >= 0
        return due and newest.ready and self.fault is None and self._phase is not Phase.FINISHED

    def _command(self, data: bytes, told: Command) -> int:
        t_ns = self._send(data)
        self.counters.pauses += bool(self._sent) and t_ns - self._sent_ns > 2 * self._period_ns
        self._sent_ns = t_ns
        self._sent.append(told)
        self._guard.sent(told)
        self._phase = Phase.FINISHED if told.last else Phase.STREAMING
        return t_ns

    # --- leaving -------------------------------------------------------------------------------------------------

    def _finish(self) -> None:
        """To rest, the last command, and let the controller drain. A session that is lost ends by our silence."""
        if self._phase is Phase.STREAMING and self.fault is None and self._brake():
            self._make(self._sent[-1].q, last=True)
        if self._sent:
            deadline_ns = self._wire.now_ns() + LEAVE_TIMEOUT_NS
            while (packet := self._intake.await_one(deadline_ns)) is not None:
                if self._has_left(packet[1]):
                    break

    def _brake(self) -> bool:
        """Stream the stop; False: the robot does not listen any more."""
        past = [told.q for told in self._sent]
        past = [past[0]] * (3 - len(past)) + past
        if max(np.abs(past[2] - past[1]).max(), np.abs(past[1] - past[0]).max()) < REST_STEP:
            return True
        way = stop_way(past, self._guard.limits, self._period_ns * 1e-9)
        return all(self._make(q, last=False) for q in way)

    def _make(self, q: np.ndarray, last: bool) -> bool:
        """Send a set-point of our own for the next number, once that is asked for."""
        data = self._encode(self._next_number(), q, last)
        told = self._decode_command(data)
        for _ in range(2):
            if self._is_asked_for(told.seq):
                self._command(data, told)
                return True
            if self._read_next(self._wire.now_ns() + ANSWER_TIMEOUT_NS // 10) is None:
                return False
        return False

    # --- packets -------------------------------------------------------------------------------------------------

    def _send(self, data: bytes) -> int:
        t_ns = self._wire.send(data)
        if self._tap is not None:
            self._tap("tx", t_ns, data)
        return t_ns

    def _receive(self, deadline_ns: int) -> tuple[int, object] | None:
        packet = self._wire.receive(deadline_ns)
        if packet is None:
            return None
        if self._tap is not None:
            self._tap("rx", *packet)
        return packet[0], self._decode(packet[1])

    def decode_sample(self, data: bytes) -> tuple[int, Vector, Vector] | None:
        """See `drivers.base.ReplayCodec`."""
        packet = self._decode(data)
        return (packet.seq, packet.q, packet.current) if isinstance(packet, Status) else None

    def encode_command(self, seq: int, command: JointCommand) -> bytes:
        return self._encode(seq, command.q, command.is_last)

    def _drain(self) -> None:
        """Throw away what an earlier session left in the socket."""
        while self._wire.receive(0) is not None:
            pass
