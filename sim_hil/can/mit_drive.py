"""A simulated Damiao drive: answers each command, closes its own loop, watches the bus, and trips.

Its codec is its own. Two personalities for a silent bus: `holds` decelerates and holds the pose; the other goes limp,
as every trip of these drives does: on an arm without brakes a link falls.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from sim_hil.can.frames import Frame

REGISTER_ID = 0x7FF
DISABLED, ENABLED, UNDER_VOLTAGE, OVER_CURRENT, COIL_HOT, SILENCE = 0x0, 0x1, 0x9, 0xA, 0xC, 0xD
KP_SPAN, KD_SPAN = 500.0, 5.0
TRIP_C = 110.0  # deg C, ASSUMED
RAMP_S = 0.2  # s, from the speed at the silence to standstill, ASSUMED


@dataclass(slots=True)
class Settings:
    """What a drive is set to; the first three are its ranges."""

    position: float = 12.5
    velocity: float = 30.0
    torque: float = 10.0
    timeout: int = 0  # 50 us units; 0: it never notices silence
    serial: int = 1
    firmware: int = 5013
    mode: int = 1  # MIT
    holds: bool = True
    hold_kp: float = 10.0  # Nm/rad and Nms/rad of the hold that follows silence, ASSUMED
    hold_kd: float = 0.2


class MitDrive:
    """`hear` frames, then `tick`. The mechanics are elsewhere: q and dq are told to it."""

    def __init__(self, command_id: int, answer_id: int, settings: Settings | None = None) -> None:
        self.settings = settings or Settings()
        self.command_id, self.answer_id = command_id, answer_id
        self.state = DISABLED
        self.coil_c, self.age = 30.0, 0.0  # deg C; s since the tick
        self.offset = self.drift = 0.0  # rad that the encoder is off; rad/s
        self.voltage = True
        self.is_silent = self.heart_stopped = False  # this kind of drive has no heartbeat
        self.q = self.dq = self.tau = 0.0
        self._target: tuple[float, float, float, float, float] | None = None  # q dq kp kd tau
        self._quiet_ns = 0
        self._hold: tuple[float, float, float, float] | None = None  # q, dq and torque at the silence, seconds since

    @property
    def brake_closed(self) -> bool:
        """There is none."""
        return False

    @property
    def is_enabled(self) -> bool:
        return self.state == ENABLED

    # --- the wire ------------------------------------------------------------------------------------------------

    def hear(self, frame: Frame) -> list[Frame]:
        answer = None
        if frame.id == REGISTER_ID and len(frame.data) == 8:
            answer = self._register(frame.data)
        elif frame.id == self.command_id and len(frame.data) == 8:
            answer = self._command(frame.data)
        if answer is None or self.is_silent:
            return []
        return [Frame(self.answer_id, answer, frame.is_fd, frame.switches_rate)]

    def speak(self, elapsed_ns: int) -> list[Frame]:
        """It never speaks unasked."""
        return []

    def _command(self, data: bytes) -> bytes:
        self._quiet_ns = 0
        if data[:7] == b"\xff" * 7 and data[7] in (0xFB, 0xFC, 0xFD, 0xFE):
            self._special(data[7])
        elif self.state == ENABLED:
            self._target = self._parse(data)
        return self._answer()

    def _special(self, kind: int) -> None:
        if kind == 0xFB and self.state > ENABLED and self.voltage and self.coil_c < TRIP_C:
            self.state, self._target, self._hold = DISABLED, None, None
        elif kind == 0xFC and self.state == DISABLED:
            self.state, self._target = ENABLED, None
        elif kind == 0xFD and self.state == ENABLED:
            self.state, self._target = DISABLED, None
        elif kind == 0xFE:
            self.offset = -self.q

    def _parse(self, data: bytes) -> tuple[float, float, float, float, float]:
        s = self.settings
        p, v = struct.unpack_from(">H", data)[0], data[2] << 4 | data[3] >> 4
        kp, kd, t = (data[3] & 0xF) << 8 | data[4], data[5] << 4 | data[6] >> 4, (data[6] & 0xF) << 8 | data[7]
        return (
            (p / 65535 * 2 - 1) * s.position,
            (v / 4095 * 2 - 1) * s.velocity,
            kp / 4095 * KP_SPAN,
            kd / 4095 * KD_SPAN,
            (t / 4095 * 2 - 1) * s.torque,
        )

    def _answer(self) -> bytes:
        s = self.settings
        p = _level(self.q + self.dq * self.age + self.offset, s.position, 65535)
        v, t = _level(self.dq, s.velocity, 4095), _level(self.tau, s.torque, 4095)
        packed = bytes([p >> 8, p & 0xFF, v >> 4, (v & 0xF) << 4 | t >> 8, t & 0xFF])
        return bytes([self.state << 4 | self.command_id & 0xF]) + packed + bytes([30, int(self.coil_c)])

    def _register(self, data: bytes) -> bytes | None:
        node, order, number = struct.unpack_from("<HBB", data)
        if node != self.command_id or order not in (0x33, 0x55, 0xCC):
            return None
        if order == 0xCC:
            return self._answer()
        s = self.settings
        if order == 0x55 and number == 9:
            s.timeout = struct.unpack_from("<I", data, 4)[0]
        spans = {21: s.position, 22: s.velocity, 23: s.torque}
        if number in spans:
            return data[:4] + struct.pack("<f", spans[number])
        told = {7: self.answer_id, 8: node, 9: s.timeout, 10: s.mode, 13: 1, 14: s.firmware, 15: s.serial}
        return data[:4] + struct.pack("<I", told.get(number, 0))

    # --- the power stage -----------------------------------------------------------------------------------------

    def cut_power(self) -> None:
        """Safe torque off: the voltage is gone; the electronics live on."""
        self.voltage = False
        self.trip(UNDER_VOLTAGE)

    def restore_power(self) -> None:
        """It is told of as before, until somebody clears it."""
        self.voltage, self.is_silent = True, False

    def trip_over_current(self) -> None:
        self.trip(OVER_CURRENT)

    def say_emergency(self, code: int) -> None:
        """This kind of drive has no such message."""

    def stop_by_itself(self) -> None:
        """It has no such state."""

    def jam_brake(self, closed: bool, contact: bool) -> None:
        """There is none."""

    def forget_number(self) -> None:
        """It has always one."""

    def ignore_targets(self) -> None:
        """It has no such flag."""

    def switch_off(self) -> None:
        self.trip(DISABLED)

    def trip(self, state: int) -> None:
        """The power stage goes off: limp."""
        self.state, self._target, self._hold = state, None, None

    def tick(self, q: float, dq: float, elapsed_ns: int) -> float:
        """Torque of the coming tick, Nm, at the joint's true q and dq."""
        self.q, self.dq = q, dq
        self.offset += self.drift * elapsed_ns * 1e-9
        self._quiet_ns += elapsed_ns
        limit_ns = self.settings.timeout * 50_000
        if self.state == ENABLED and limit_ns and self._quiet_ns > limit_ns:
            held = (q, dq, self.tau, 0.0) if self.settings.holds else None
            self.trip(SILENCE)
            self._hold = held
        if self.state == ENABLED and self.coil_c >= TRIP_C:
            self.trip(COIL_HOT)
        wanted = self._torque(elapsed_ns * 1e-9)
        self.tau = max(-self.settings.torque, min(self.settings.torque, wanted))
        return self.tau

    def _torque(self, elapsed: float) -> float:
        if self.state == ENABLED and self._target is not None:
            q, dq, kp, kd, tau = self._target
            return kp * (q - self.q - self.offset) + kd * (dq - self.dq) + tau
        if self.state == SILENCE and self._hold is not None:
            q0, dq0, tau, t = self._hold
            t = min(t + elapsed, RAMP_S)
            self._hold = q0, dq0, tau, t
            q, dq = q0 + dq0 * t * (1 - t / RAMP_S / 2), dq0 * (1 - t / RAMP_S)
            return self.settings.hold_kp * (q - self.q) + self.settings.hold_kd * (dq - self.dq) + tau
        return 0.0


def _level(value: float, span: float, top: int) -> int:
    return round(max(0.0, min(1.0, (value / span + 1) / 2)) * top)
