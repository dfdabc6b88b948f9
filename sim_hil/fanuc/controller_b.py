"""The simulated controller on the ROS 2 wire: as forgiving as the measured one, which is not always kinder.

What exceeds the tables is smoothed, never an alarm. A silent PC lets the arm coast at its last commanded speed for
about a tenth of a second, then it stops hard, again without an alarm. Figures marked MEASURED are of a CRX-10iA/L.
"""

from __future__ import annotations

from collections import deque
from typing import Any, NamedTuple

import numpy as np

from sim_hil.fanuc import alarms, wire_b
from sim_hil.fanuc.alarms import Alarm
from sim_hil.fanuc.arm import Array, Plant, to_wire
from sim_hil.fanuc.cabinet import LAST_AT_REST, MOVING, READY, SERVO_ON, Cabinet, Peer
from sim_hil.fanuc.settings import Settings, thresholds
from sim_hil.fanuc.signals import DI, DO, RI, RO, Unassigned
from sim_hil.fanuc.wire import Malformed, Packet

IN_ERROR, PENDANT_ENABLED, STOP_PRESSED = 1, 2, 4
_READY_LASTS_S, _STOP_TOLD_S = 0.3, 0.5  # after the button, by when bit 0 goes and the e-stop bit comes. MEASURED
_DIP_AT_S, _DIP_S = 1.0, 0.6  # after a repeated call: not ready, for less than a second. MEASURED
# Silence is endured so long, depending on the speed: 121 ms at 15.3 deg/s, 71 ms at 49.9 deg/s. MEASURED
_ENDURED = ((15.3, 0.121), (49.9, 0.071))
_SIGNAL_TYPES = {0: DO, 1: DI, 2: RO, 3: RI}
MOST_BUFFERED = 9  # commands before motion. DATASHEET


class Command(NamedTuple):
    """In the buffer."""

    last: bool
    motion: bool
    q: Array  # rad


class ControllerB(Cabinet):
    def __init__(self, plant: Plant, settings: Settings | None = None) -> None:
        super().__init__(plant, settings)
        s = self.settings
        self.contact_stop = 0  # 0 none ... 4, as on the wire
        self.safety_scale = 1.0  # collaborative speed clamp
        self.over_limit = 0  # cycles that had to be smoothed
        self.silent_stops = 0  # times that the arm was stopped because nothing came
        self.force = np.zeros(6)  # N and Nm that the sensor feels
        self._force_sensor = 0  # not chosen
        self._start_move = s.start_move
        self._slots: list[tuple[int, int, int]] = []  # signals that the statuses tell: type, first, length
        self._calls = 0
        self._called_at: int | None = None  # cycle of the call of STREAM_MOTN that is running
        self._called_first = False  # before Start, as it has to be
        self._pressed_at = 0
        self._forget()

    def _forget(self) -> None:
        """No command has come yet."""
        self._queue: deque[Command] = deque()
        self._expected: int | None = None
        self._newest: Array | None = None
        self._target: Array | None = None
        self._speed = np.zeros(len(self._plant.q))  # rad/s, of the commands
        self._silent = 0  # cycles
        self._gave_up = False
        self._draining = False
        self._limits.restart()

    # --- what RMI asks for ---------------------------------------------------------------------------------------

    @property
    def now_s(self) -> float:
        return self._cycles * self.settings.period

    @property
    def program_runs(self) -> bool:
        return self._called_at is not None

    def call(self) -> None:
        """STREAM_MOTN starts."""
        self._calls += 1
        self._called_at = self._cycles
        self._called_first = self._peer is None or self._called_first
        self._forget()

    def abort(self) -> None:
        self._called_at = None
        self._forget()

    def run_program(self) -> None:
        """START at the pendant does nothing here: STREAM_MOTN is called over RMI."""

    @property
    def joints(self) -> Array:
        """Where the arm is, (6,) rad."""
        return self._plant.q

    # --- state ---------------------------------------------------------------------------------------------------

    @property
    def ready(self) -> bool:
        """Motion is possible."""
        wanted = self._peer is not None and self._called_at is not None and self._called_first
        stopped = self._gave_up or self.contact_stop or self.pendant_enabled
        return bool(wanted and not stopped and not self._dips and not self._faulted)

    @property
    def _dips(self) -> bool:
        if self._called_at is None or self._calls < 2:
            return False
        return _DIP_AT_S <= (self._cycles - self._called_at) * self.settings.period < _DIP_AT_S + _DIP_S

    @property
    def _faulted(self) -> bool:
        """An emergency stop takes bit 0 away a little later than it happens."""
        late = {alarms.EMERGENCY_STOP, alarms.EMERGENCY_COMPANION}
        return bool(set(self.alarms) - late) or (not self.servo_on and self._since_pressed >= _READY_LASTS_S)

    @property
    def _since_pressed(self) -> float:
        return (self._cycles - self._pressed_at) * self.settings.period

    def press_emergency_stop(self) -> None:
        super().press_emergency_stop()
        self._alarm(alarms.EMERGENCY_COMPANION)
        self._pressed_at = self._cycles

    # --- cycle ---------------------------------------------------------------------------------------------------

    def _move(self) -> None:
        if self._queue and (len(self._queue) > self._start_move or self._queue[-1].last):
            self._draining = True
        if self.alarms or self.contact_stop or self.pendant_enabled or self._gave_up:
            self._queue.clear()
            self._servo.brake()
        elif self._queue and self._draining:
            self._silent = 0
            self._follow(self._queue.popleft())
        elif self._draining and self._target is not None:
            self._coast()
        else:
            self._servo.hold()

    def _follow(self, command: Command) -> None:
        if not command.motion or not self.ready:
            self._servo.hold()
            return
        before = self._plant.q if self._target is None else self._target
        if self._limits.excess(to_wire(command.q)[: len(command.q)]) is not None:
            self.over_limit += 1
        fastest = np.radians(self.arm.tables.at(0.0, 1.0)[0]) * self.safety_scale * self.settings.period
        self._target = before + np.clip(command.q - before, -fastest, fastest)
        self._speed = (self._target - before) / self.settings.period
        self._servo.follow(self._target)
        if command.last:
            self._draining, self._target = False, None

    def _coast(self) -> None:
        assert self._target is not None
        self._silent += 1
        (slow, long), (fast, short) = _ENDURED
        speed = float(np.degrees(np.max(np.abs(self._speed))))
        endured = long + (short - long) * min(1.0, max(0.0, (speed - slow) / (fast - slow)))
        if self._silent * self.settings.period > endured:
            self._gave_up = True
            self.silent_stops += 1
            self._servo.brake()
            return
        self._target = self._target + self._speed * self.settings.period
        self._servo.follow(self._target)

    # --- packets in ----------------------------------------------------------------------------------------------

    def _take(self, peer: Peer, data: bytes) -> bytes | None:
        try:
            packet = wire_b.read_request(data)
        except Malformed as error:
            if len(data) >= 8 and int.from_bytes(data[:4], "big") not in wire_b.REQUESTS:
                self._alarm(alarms.UNKNOWN_PACKET, data)
            else:
                self._offend(f"malformed packet: {error}", data)
            return None
        answers: dict[str, Any] = {
            "get_capability": self._capability,
            "set_capability": self._set_capability,
            "thresholds": self._thresholds,
            "gpio": self._configure_signals,
        }
        if packet.name in answers:
            reply = answers[packet.name](packet)
            return bytes(reply)
        if packet.version > self.settings.version or (packet.name == "force" and self.settings.version < 4):
            self._alarm(alarms.UNKNOWN_PACKET, data)
        elif packet.name == "stop":
            self._peer = None
            self._forget()
        elif packet.name == "start":
            self._start(peer, packet, data)
        elif packet.name == "force":
            self._force_sensor = packet["force_sensor"]
            self.force[:] *= not packet["do_reset"]
        elif packet.name == "command":
            self._command(peer, packet, data)
        return None

    def greeting(self, name: str) -> bytes:
        return wire_b.write_request(name, self.settings.version)

    def _start(self, peer: Peer, packet: Packet, data: bytes) -> None:
        if self._peer not in (None, peer):
            self._alarm(alarms.FOREIGN_START, data)
            return
        self._peer, self._version, self._sequence = peer, packet.version, 0
        self._called_first = self._called_at is not None
        self._forget()

    def _command(self, peer: Peer, packet: Packet, data: bytes) -> None:
        if peer != self._peer or packet.version != self._version:
            self._offend("command that is not of the session", data)
        elif packet["word"] != wire_b.JOINT_DATA:
            self._offend(f"word {packet['word']:#06x} instead of 0xffff: the real arm takes this for a pose", data)
        elif self._expected is not None and packet["sequence"] != self._expected:
            repeated = (packet["sequence"] - self._expected) % 2**32 >= 2**31
            self._offend("number repeated" if repeated else "number left out", data)
            if not repeated:
                self._accept(packet, data)
        elif len(self._queue) >= self.settings.capacity:
            self._offend(str(alarms.OVERFLOW), data)
        elif self.ready:
            self._accept(packet, data)

    def _accept(self, packet: Packet, data: bytes) -> None:
        q = np.radians(packet.axes("position")[: len(self._plant.q)])
        if self._newest is None and np.max(np.abs(q - self._plant.q)) > np.radians(self.settings.start_threshold_deg):
            self._alarm(alarms.ABNORMAL, data)
            return
        if packet["last"] and self._newest is not None and np.max(np.abs(q - self._newest)) > LAST_AT_REST:
            self._offend("last command while moving", data)
        self._expected = (packet["sequence"] + 1) % 2**32
        self._newest = q
        self._queue.append(Command(bool(packet["last"]), bool(packet["motion"]), q))

    def _alarm(self, alarm: Alarm, data: bytes | None = None) -> None:
        super()._alarm(alarm, data)
        self._queue.clear()

    # --- packets out ---------------------------------------------------------------------------------------------

    def _capability(self, packet: Packet) -> bytes:
        s = self.settings
        return wire_b.write_reply(
            packet.name,
            packet.version,
            id=1,
            sampling_rate=int(s.period_ms),
            start_move=self._start_move,
            available_version=s.version,
        )

    def _set_capability(self, packet: Packet) -> bytes:
        self._start_move = min(packet["start_move"], MOST_BUFFERED)
        return self._capability(packet)

    def _thresholds(self, packet: Packet) -> bytes:
        reply = thresholds(self.arm.tables, packet["axis"], packet["kind"])
        return wire_b.write_reply("thresholds", packet.version, **reply)

    def _configure_signals(self, packet: Packet) -> bytes:
        slots = [tuple(int(x) for x in slot) for slot in np.asarray(packet.fields["slots"]).tolist()]
        wanted = [(_SIGNAL_TYPES.get(signal, 0), first, length) for kind, signal, first, length in slots if kind == 2]
        try:
            for kind, first, length in wanted:
                self.signals.read(kind, first, (1 << length) - 1)
        except Unassigned:
            return wire_b.write_reply("gpio", 0, result=1)
        self._slots = wanted
        return wire_b.write_reply("gpio", 0, result=0, ptf=1)

    def _status(self) -> bytes:
        bits = (READY if self.ready else 0) | (MOVING if self.moving else 0)
        bits |= SERVO_ON if self.servo_on or self._since_pressed < _READY_LASTS_S else 0
        pressed = not self.servo_on and self._since_pressed >= _STOP_TOLD_S
        robot = (IN_ERROR if self.alarms else 0) | (STOP_PRESSED if pressed else 0)
        robot |= PENDANT_ENABLED if self.pendant_enabled else 0
        told = b"".join(
            self.signals.read(kind, first, (1 << length) - 1).to_bytes(4, "little")
            for kind, first, length in self._slots
        )
        sensed: dict[str, object] = {}
        if self._version >= 4:
            force = self.force * (self._force_sensor in (1, 2))
            sensed = {"force": force[:3], "moment": force[3:], "force_sensor": self._force_sensor}
        return wire_b.write_reply(
            "status" if self._version < 4 else "status_force",
            self._version,
            sequence=self._sequence,
            status=bits,
            robot_status=robot,
            contact_stop=self.contact_stop,
            time_stamp=self.time_stamp,
            pose=self.arm.pose(self._plant.q),
            joints=[*np.degrees(self._plant.q), 0, 0, 0],
            current=self.currents,
            safety_scale=self.safety_scale,
            signals=np.frombuffer(told.ljust(wire_b.SIGNAL_BYTES, b"\0"), "u1"),
            **sensed,
        )
