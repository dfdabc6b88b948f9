"""The simulated FANUC controller, classic Stream Motion: a state machine without clock and socket.

Each cycle: take what came in, pop one command if motion has started, servo and plant, sequence + 1, send the status.
An alarm is latched, takes the ready bit away and brakes the arm; only `reset` at the pendant and a new start of the
program take it back. Every breach of the protocol is kept with its bytes.
"""

from __future__ import annotations

import math
from collections import deque
from enum import Enum
from typing import NamedTuple

import numpy as np

from sim_hil.fanuc import alarms, wire
from sim_hil.fanuc.alarms import Alarm
from sim_hil.fanuc.arm import Array, Plant, from_wire, to_wire
from sim_hil.fanuc.cabinet import COMMANDED, LAST_AT_REST, MOVING, READY, SERVO_ON, Cabinet, Peer
from sim_hil.fanuc.settings import Settings, thresholds
from sim_hil.fanuc.signals import Unassigned

_COMMANDED_EVERY_S = 0.1  # the commanded position is told at most this often


class Program(Enum):
    """The TP program with IBGN start and IBGN end."""

    STOPPED = 0
    WAITING = 1  # in IBGN start: takes positions
    LOOPING = 2  # past IBGN end, on its way back to IBGN start


class Command(NamedTuple):
    """In the buffer."""

    last: bool
    q: Array  # rad
    pendant: Array  # deg
    data: bytes


class Controller(Cabinet):
    def __init__(self, plant: Plant, settings: Settings | None = None) -> None:
        super().__init__(plant, settings)
        s = self.settings
        self.ignored = 0  # commands that came while an alarm was on
        self.program = Program.WAITING if s.program_starts else Program.STOPPED
        self._loop_left = 0
        self._told_commanded = -math.inf
        self._window = (0, 0, 0)  # of signals, that the status tells
        self._queue: deque[Command] = deque()
        self._enter_ibgn()

    # --- pendant -------------------------------------------------------------------------------------------------

    def run_program(self) -> None:
        """START at the pendant: the program reaches IBGN start. Nothing happens while an alarm is on."""
        if not self.alarms:
            self.program = Program.WAITING
            self._enter_ibgn()

    # --- cycle ---------------------------------------------------------------------------------------------------

    @property
    def depth(self) -> int:
        """Commands in the buffer."""
        return len(self._queue)

    @property
    def ready(self) -> bool:
        return self.program is Program.WAITING and not self.alarms

    @property
    def _every(self) -> int:
        """Version 3: of how many cycles one is told while the controller brakes by itself."""
        return self.settings.thinning if self._version == 3 and self.alarms and self.moving else 1

    def _move(self) -> None:
        if self._queue and (len(self._queue) >= self.settings.start_move or self._queue[-1][0]):
            self._draining = True
        if self._draining and not self._queue:
            self._alarm(alarms.DRY, b"")
        if self.alarms:
            self._servo.brake()
        elif self._draining:
            self._follow(self._queue.popleft())
        else:
            self._servo.hold()
        if self.program is Program.LOOPING:
            self._loop_left -= 1
            if self._loop_left <= 0:
                self.run_program()

    def _follow(self, command: Command) -> None:
        excess = self._limits.excess(command.pendant) if self.settings.limits else None
        if excess is not None:
            alarm = alarms.LIMITS[self.settings.limit_alarms][excess.kind]
            self._alarm(alarm.about(str(excess)), command.data)
            self._servo.brake()
            return
        self._servo.follow(command.q)
        if command.last:
            self._pass_ibgn_end()

    def _enter_ibgn(self) -> None:
        self._queue.clear()
        self._limits.restart()
        self._draining = False
        self._finished = False
        self._expected: int | None = None
        self._newest: Array | None = None
        self._style = wire.JOINT
        self._configuration = self.arm.configuration(self._plant.q)  # which poses must keep

    def _pass_ibgn_end(self) -> None:
        self._enter_ibgn()
        self.program = Program.LOOPING if self.settings.program_loops else Program.STOPPED
        self._loop_left = self.settings.loop_cycles

    # --- packets in ----------------------------------------------------------------------------------------------

    def _take(self, peer: Peer, data: bytes) -> bytes | None:
        """Obey one packet; its reply, if it has one of its own."""
        try:
            packet = wire.read_request(data)
        except wire.Malformed as error:
            self._offend(f"malformed packet: {error}", data)
            return None
        if packet.name == "version":
            return wire.write_reply("version", self.settings.version)
        if packet.version > self.settings.version:
            versions = f"PC {packet.version}, Rob {self.settings.version}"
            self._alarm(alarms.VERSION.about(versions), data)
        elif packet.name == "start":
            self._start(peer, packet)
        elif packet.name == "stop":
            self._stop()
        elif packet.name == "thresholds":
            return self._thresholds(packet)
        elif (rule := self._not_of_session(peer, packet)) is not None:
            self._offend(rule, data)
        elif packet.name == "commanded":
            return self._commanded()
        elif self.alarms:
            self.ignored += 1
        else:
            self._command(packet, data)
        return None

    def greeting(self, name: str) -> bytes:
        return wire.write_request(name, self.settings.version)

    def _not_of_session(self, peer: Peer, packet: wire.Packet) -> str | None:
        if self._peer is None:
            return f"{packet.name} without start"
        if peer != self._peer:
            return f"{packet.name} of another PC"
        if packet.version != self._version:
            return f"version {packet.version} in a session of version {self._version}"
        return None

    def _start(self, peer: Peer, packet: wire.Packet) -> None:
        """Motion that was under way has lost its commands: the empty buffer stops it in this very cycle."""
        self._stop()
        self._peer, self._version, self._sequence = peer, packet.version, 0

    def _stop(self) -> None:
        self._peer, self._window = None, (0, 0, 0)
        draining = self._draining
        self._enter_ibgn()
        self._draining = draining

    def _command(self, packet: wire.Packet, data: bytes) -> None:
        q = self._joints(packet)
        if (rule := self._not_acceptable(packet)) is not None:
            self._offend(rule, data)
        elif q is None:
            self._alarm(alarms.UNREACHABLE, data)
        elif packet["data_style"] != wire.JOINT and np.any(self._configuration * self.arm.configuration(q) < 0.0):
            self._alarm(alarms.CONFIGURATION, data)
        elif (alarm := self._check(packet, q)) is not None:
            self._alarm(alarm, data)
        else:
            self._style = packet["data_style"]
            if packet["last_data"] and self._newest is not None and np.max(np.abs(q - self._newest)) > LAST_AT_REST:
                self._offend("last_data while moving", data)
            self._expected = (packet["sequence"] + 1) % 2**32
            self._newest = q
            self._finished = bool(packet["last_data"])
            self._queue.append(Command(self._finished, q, to_wire(q)[: len(q)], data))
            self._signals(packet, data)

    def _joints(self, packet: wire.Packet) -> Array | None:
        """Of a command; a pose keeps the arm's configuration. None: it cannot be reached so."""
        position = packet.axes("position")
        if packet["data_style"] == wire.JOINT:
            return from_wire(position, len(self._plant.q))
        return self.arm.inverse(position, self._plant.q if self._newest is None else self._newest)

    def _signals(self, packet: wire.Packet, data: bytes) -> None:
        """The read window stays for the statuses to come; a write takes effect at once."""
        kind, index, mask = self._window = (packet["read_type"], packet["read_index"], packet["read_mask"])
        try:
            if kind:
                self.signals.read(kind, index, mask)
            if packet["write_type"]:
                self.signals.write(*(packet[f"write_{field}"] for field in ("type", "index", "mask", "value")))
        except Unassigned as error:
            self._window = (0, 0, 0)
            self._alarm(alarms.NOT_ASSIGNED.about(str(error)), data)

    def _not_acceptable(self, packet: wire.Packet) -> str | None:
        if self.program is not Program.WAITING:
            return "command while no program waits for it"
        if self._finished:
            return "command after last_data"
        return None

    def _check(self, packet: wire.Packet, q: Array) -> Alarm | None:
        """The alarm that this command raises. Any number may come first; from then on they are consecutive."""
        if self._expected is None:
            far = np.max(np.abs(q - self._plant.q)) > math.radians(self.settings.start_threshold_deg)
            return alarms.ABNORMAL if far else None
        ahead = (packet["sequence"] - self._expected) % 2**32
        if ahead and not (self.settings.lenient and ahead < 2**31):
            return alarms.SEQUENCE
        if packet["data_style"] != self._style:  # the real one sees the numbers jump
            return alarms.LIMITS[self.settings.limit_alarms][0].about("joints and poses in one session")
        return alarms.OVERFLOW if len(self._queue) >= self.settings.capacity else None

    def _alarm(self, alarm: Alarm, data: bytes | None = None) -> None:
        super()._alarm(alarm, data)
        self.program = Program.STOPPED
        self._enter_ibgn()

    # --- packets out ---------------------------------------------------------------------------------------------

    def _status(self) -> bytes:
        bits = (READY if self.ready else 0) | (COMMANDED if self._expected is not None else 0)
        bits |= (SERVO_ON if self.servo_on else 0) | (MOVING if self.moving else 0)
        if self._every > 1:
            bits |= self._every << 4
        kind, index, mask = self._window
        return wire.write_reply(
            "status",
            self._version,
            sequence=self._sequence,
            status=bits,
            read_type=kind,
            read_index=index,
            read_mask=mask,
            read_value=self.signals.read(kind, index, mask) if kind else 0,
            time_stamp=self.time_stamp,
            pose=self.arm.pose(self._plant.q),
            joints=to_wire(self._plant.q),
            current=self.currents,
        )

    def _thresholds(self, packet: wire.Packet) -> bytes | None:
        if self.program is Program.WAITING and not self.settings.thresholds_while_waiting:
            return None
        reply = thresholds(self.arm.tables, packet["axis"], packet["kind"])
        return wire.write_reply("thresholds", packet.version, **reply)

    def _commanded(self) -> bytes | None:
        now = self._cycles * self.settings.period
        if now - self._told_commanded < _COMMANDED_EVERY_S:
            return None
        self._told_commanded = now
        q = self._servo.q
        return wire.write_reply(
            "commanded", self._version, time_stamp=self.time_stamp, pose=self.arm.pose(q), joints=to_wire(q)
        )
