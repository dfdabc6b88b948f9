"""What every simulated controller has, whichever wire it speaks: arm, servos, signals, alarms, pendant, E-stop."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sim_hil.fanuc import alarms
from sim_hil.fanuc.alarms import Alarm
from sim_hil.fanuc.arm import ARMS, Array, Plant, Servo, from_wire
from sim_hil.fanuc.settings import Settings
from sim_hil.fanuc.signals import Signals
from sim_hil.fanuc.tables import LimitCheck

Peer = tuple[str, int]

READY, COMMANDED, SERVO_ON, MOVING = 1, 2, 4, 8
LAST_AT_REST = 1e-4  # rad: a last command farther from the one before it is not at rest
_AT_REST = 1e-3  # rad/s


@dataclass(frozen=True, slots=True)
class Offence:
    rule: str
    data: bytes


class Device(Protocol):
    """What lockstep and server drive: a controller, or one with faults."""

    settings: Settings

    def cycle(self, packets: Iterable[tuple[Peer, bytes]]) -> list[tuple[Peer, bytes]]: ...


class Cabinet:
    def __init__(self, plant: Plant, settings: Settings | None = None) -> None:
        self.settings = s = settings or Settings()
        self.arm = ARMS[s.arm]
        self.signals = Signals(s.tool)
        self.alarms: list[Alarm] = []
        self.offences: list[Offence] = []
        self.pendant_enabled = False
        self._plant = plant
        self.couple(s.tool)
        brake = np.full(len(plant.q), math.radians(s.brake_deg_s2))
        self._servo = Servo(plant.q, s.period, s.filter_cycles, s.lag_ms * 1e-3, brake)
        self._limits = LimitCheck(self.arm.tables, s.payload_share, s.period, self._flange_mm)
        self._peer: Peer | None = None  # the PC of the session
        self._version = 0  # that it speaks
        self._cycles = 0
        self._sequence = 0
        self._clock_jump_ms = 0
        self._stop_pressed = False

    def cycle(self, packets: Iterable[tuple[Peer, bytes]]) -> list[tuple[Peer, bytes]]:
        """One period: what came in since the last -> what goes out."""
        out = [(peer, reply) for peer, data in packets if (reply := self._take(peer, data)) is not None]
        self._move()
        self._plant.set_target(self._servo.q)
        self._plant.step()
        self._cycles += 1
        if self._peer is not None:
            self._sequence = (self._sequence + 1) % 2**32
            if self._cycles % self._every == 0:
                out.append((self._peer, self._status()))
        return out

    # --- what the wires differ in --------------------------------------------------------------------------------

    def _take(self, peer: Peer, data: bytes) -> bytes | None:
        """Obey one packet; its reply, if it has one of its own."""
        raise NotImplementedError

    def _move(self) -> None:
        """What the servos do in this cycle."""
        raise NotImplementedError

    def _status(self) -> bytes:
        raise NotImplementedError

    @property
    def _every(self) -> int:
        """Of how many cycles one is told."""
        return 1

    def greeting(self, name: str) -> bytes:
        """A "start" or "stop" as a PC would send it."""
        raise NotImplementedError

    # --- pendant and machine -------------------------------------------------------------------------------------

    def press_emergency_stop(self) -> None:
        if not self._stop_pressed:
            self._stop_pressed = True
            self._alarm(alarms.EMERGENCY_STOP)

    def run_program(self) -> None:
        """START at the pendant."""
        raise NotImplementedError

    def release_emergency_stop(self) -> None:
        self._stop_pressed = False

    def enable_pendant(self, on: bool = True) -> None:
        """The switch of the teach pendant: while it is on, no program of AUTO runs."""
        self.pendant_enabled = on
        if on:
            self._alarm(alarms.PENDANT)

    def reset(self) -> None:
        """RESET: alarms off whose cause is gone; the program has to be started again."""
        self.alarms = [
            alarm
            for alarm, lasts in ((alarms.EMERGENCY_STOP, self._stop_pressed), (alarms.PENDANT, self.pendant_enabled))
            if lasts
        ]

    def jump_clock(self, milliseconds: int) -> None:
        """Somebody set the controller's clock."""
        self._clock_jump_ms += milliseconds

    def jump_sequence(self, number: int) -> None:
        """The next status carries `number`."""
        self._sequence = (number - 1) % 2**32

    # --- state ---------------------------------------------------------------------------------------------------

    @property
    def sequence(self) -> int:
        """Number of the status sent last."""
        return self._sequence

    @property
    def servo_on(self) -> bool:
        return alarms.EMERGENCY_STOP not in self.alarms

    @property
    def moving(self) -> bool:
        return bool(np.max(np.abs(self._plant.dq)) > _AT_REST)

    @property
    def time_stamp(self) -> int:
        return (int(self._cycles * self.settings.period_ms) + self._clock_jump_ms) // 2 * 2 % 2**32

    def couple(self, tool: int) -> None:
        """Another tool in the changer (0: none): its number on the signals, its body on the flange."""
        self.signals.couple(tool)
        if (carry := getattr(self._plant, "carry", None)) is not None:
            carry(tool)

    @property
    def currents(self) -> Array:
        """Nine motor currents [A], proportional to the joint torques; zero for a plant without mass."""
        torque = getattr(self._plant, "torque", None)
        amperes = np.zeros(9)
        if torque is not None:
            amperes[: len(torque)] = np.abs(torque) * self.arm.ampere_per_nm
        return amperes

    # --- for the controllers -------------------------------------------------------------------------------------

    def _alarm(self, alarm: Alarm, data: bytes | None = None) -> None:
        """Latch an alarm; with `data` (also b"": a silence) it is the PC that broke a rule."""
        self.alarms.append(alarm)
        if data is not None:
            self._offend(str(alarm), data)

    def _offend(self, rule: str, data: bytes) -> None:
        self.offences.append(Offence(rule, data))

    def _flange_mm(self, pendant: Array) -> Array:
        return 1e3 * self.arm.place(from_wire(pendant, len(pendant)))
