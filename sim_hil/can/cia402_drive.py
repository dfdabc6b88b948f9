"""A simulated CiA 402 drive on CANopen, with a brake: service data, PDOs by their mapping, heartbeats, EMCY.

Its codec is its own. Commands act at the SYNC after them, and what they did is told at the SYNC after that. A loss of
the master's heartbeat or of RPDOs is answered, in operation, by a quick stop with hold, then brake and fault; the
nasty personality lets go at once and leaves the arm to its brake.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

from sim_hil.can import lss
from sim_hil.can.frames import Frame

NOT_READY, DISABLED, READY, ON, ENABLED, QUICK_STOP, FAULT = 0x00, 0x40, 0x21, 0x23, 0x27, 0x07, 0x08
VOLTAGE, WARNING, REMOTE, FOLLOWS = 1 << 4, 1 << 7, 1 << 9, 1 << 12
BOOT, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0x00, 0x04, 0x05, 0x7F
POSITION, VELOCITY, TORQUE = 8, 9, 10
WARM_C, TRIP_C = 85.0, 110.0  # deg C, ASSUMED
RAMP_S = 0.2  # s of a quick stop, ASSUMED
BRAKE_NS = 50_000_000  # from the order to its contact, ASSUMED
BRAKE_OUTPUT, BRAKE_CONTACT = 1 << 0, 1 << 16  # of the digital outputs and inputs
EMCY = {"heartbeat": 0x8130, "rpdo": 0x8250, "current": 0x2310, "hot": 0x4310, "follow": 0x8611}
NO_OBJECT, READ_ONLY = 0x0602_0000, 0x0601_0002

_FORMATS = {
    0x1001: "<B", 0x1017: "<H", 0x6007: "<h", 0x603F: "<H", 0x6040: "<H", 0x6041: "<H", 0x605A: "<h", 0x6060: "<b",
    0x6061: "<b", 0x6064: "<i", 0x6071: "<h", 0x6077: "<h", 0x607A: "<i", 0x60B2: "<h", 0x60FF: "<i",
}  # fmt: skip
_WRITABLE = {0x1016, 0x1017, 0x6007, 0x6040, 0x605A, 0x6060, 0x6071, 0x607A, 0x60B2, 0x60C2, 0x60FE, 0x60FF}


@dataclass(slots=True)
class Data:
    """Of one joint. Stiffness of the position loop: ASSUMED, matched to what the joint carries."""

    rated: float  # Nm at the joint
    kp: float  # Nm/rad
    kd: float  # Nms/rad
    resolution: int = 1 << 17
    gear: tuple[int, int] = (100, 1)
    limits_deg: tuple[float, float] = (-360.0, 360.0)  # it lets no position target go beyond
    serial: int = 1
    revision: int = 0x0002_0001
    holds: bool = True


class Cia402Drive:
    def __init__(self, node: int, data: Data) -> None:
        self.node, self.data = node, data
        self.state, self.nmt = DISABLED, PRE_OPERATIONAL
        self.coil_c, self.age = 30.0, 0.0
        self.offset = self.drift = 0.0  # rad that the encoder is off; rad/s
        self.is_silent = self.heart_stopped = self.is_deaf = False
        self.voltage = True
        self.brake_stuck: bool | None = None  # closed or open, whatever it is told
        self.contact_stuck: bool | None = None  # what its contact tells, whatever it does
        self.q = self.dq = self.tau = 0.0
        self._od = _objects(node, data)
        vendor, product, revision, serial = (self._od[0x1018, k] for k in (1, 2, 3, 4))
        self.lss = lss.Lss((vendor, product, revision, serial), node)
        self._staged: dict[int, bytes] = {}
        self._say: list[Frame] = []
        self._master_ns = self._beat_ns = self._settled_ns = 0
        self._contact = True
        self._rpdo_ns = [0] * 4
        self._ramp: tuple[float, float, float] | None = None  # q, dq, seconds of a quick stop
        self._last_target = 0.0
        self._word = 0
        self._needs_new_communication = False  # after a loss of it, before a fault can be reset

    @property
    def is_enabled(self) -> bool:
        return self.state == ENABLED

    @property
    def brake_closed(self) -> bool:
        if self.brake_stuck is not None:
            return self.brake_stuck
        ordered = self._od[0x60FE, 1] & self._od[0x60FE, 2] & BRAKE_OUTPUT
        return self.state not in (ENABLED, QUICK_STOP) or bool(ordered)

    # --- the wire ------------------------------------------------------------------------------------------------

    def hear(self, frame: Frame) -> list[Frame]:
        data = frame.data
        if frame.id == lss.MASTER_ID and len(data) == 8:
            return self._out(self._number(data))
        if self.node == lss.NO_NUMBER:
            return []
        if frame.id == 0x000 and len(data) == 2 and data[1] in (0, self.node):
            self._manage(data[0])
        elif frame.id == 0x080 and self.nmt == OPERATIONAL:
            return self._out(self._sync())
        elif frame.id == 0x600 + self.node and len(data) == 8:
            return self._out([Frame(0x580 + self.node, self._serve(data))])
        elif self._od[0x1016, 1] and frame.id == 0x700 + (self._od[0x1016, 1] >> 16 & 0x7F):
            self._master_ns = 0
        elif self.nmt == OPERATIONAL:
            for k in range(4):
                if frame.id == self._od[0x1400 + k, 1]:  # bit 31: not valid, and no identifier
                    self._staged[0x1600 + k] = data
                    self._rpdo_ns[k] = 0
        return []

    def _number(self, data: bytes) -> list[Frame]:
        answer = self.lss.hear(data)
        if self.lss.number != self.node:
            self.be(self.lss.number)
        return [] if answer is None else [Frame(lss.NODE_ID, answer)]

    def be(self, number: int) -> None:
        """Begin anew as this node."""
        self.node, self.lss.number, self.nmt = number, number, PRE_OPERATIONAL
        self._od = _objects(number, self.data)
        if number != lss.NO_NUMBER:
            self._say.append(Frame(0x700 + number, bytes([BOOT])))

    def speak(self, elapsed_ns: int) -> list[Frame]:
        self._beat_ns += elapsed_ns
        period_ns = self._od[0x1017, 0] * 1_000_000
        if period_ns and self._beat_ns >= period_ns:
            self._beat_ns = 0
            if not self.heart_stopped:
                self._say.append(Frame(0x700 + self.node, bytes([self.nmt])))
        said, self._say = self._say, []
        return self._out(said)

    def _out(self, frames: list[Frame]) -> list[Frame]:
        return [] if self.is_silent else frames

    def _manage(self, command: int) -> None:
        change = {0x01: OPERATIONAL, 0x02: STOPPED, 0x80: PRE_OPERATIONAL, 0x82: PRE_OPERATIONAL}
        self.nmt = change.get(command, self.nmt)
        self._master_ns, self._rpdo_ns = 0, [0] * 4
        if command == 0x82:
            self._needs_new_communication = False
            self._say.append(Frame(0x700 + self.node, bytes([BOOT])))

    def _sync(self) -> list[Frame]:
        answer = []
        if not self._od[0x1800, 1] >> 31:
            self._refresh()
            answer = [Frame(self._od[0x1800, 1], self._gather(0x1A00))]
        for mapping, data in sorted(self._staged.items()):
            if not self.is_deaf:
                self._scatter(mapping, data)
        self._staged.clear()
        self._control(self._od[0x6040, 0])
        return answer

    def _refresh(self) -> None:
        q = self.q + self.dq * self.age + self.offset
        self._od[0x6064, 0] = _wrap(round(q * self._counts()), 32)
        self._od[0x6077, 0] = _wrap(round(self.tau / self.data.rated * 1000), 16)
        hears = self._od[0x6060, 0] in (POSITION, VELOCITY, TORQUE) and not self.is_deaf
        follows = FOLLOWS if self.state == ENABLED and hears else 0
        warm = WARNING if self.coil_c >= WARM_C else 0
        self._od[0x6041, 0] = self.state | REMOTE | follows | warm | (VOLTAGE if self.voltage else 0)
        self._od[0x6061, 0] = self._od[0x6060, 0]
        contact = self._contact if self.contact_stuck is None else self.contact_stuck
        self._od[0x60FD, 0] = BRAKE_CONTACT if contact else 0

    def _entries(self, mapping: int) -> list[tuple[int, int, int]]:
        """(index, sub, bytes) of what is mapped."""
        words = [self._od[mapping, k + 1] for k in range(self._od[mapping, 0])]
        return [(word >> 16, word >> 8 & 0xFF, (word & 0xFF) // 8) for word in words]

    def _gather(self, mapping: int) -> bytes:
        return b"".join(self._od[i, s].to_bytes(n, "little", signed=_signed(i)) for i, s, n in self._entries(mapping))

    def _scatter(self, mapping: int, data: bytes) -> None:
        entries = self._entries(mapping)
        if sum(size for _, _, size in entries) != len(data):
            self._emergency(0x8210)
            return
        for index, sub, size in entries:
            self._od[index, sub] = int.from_bytes(data[:size], "little", signed=_signed(index))
            data = data[size:]

    # --- service data: expedited transfers only ------------------------------------------------------------------

    def _serve(self, data: bytes) -> bytes:
        command, index, sub = struct.unpack_from("<BHB", data)
        key = (index, sub)
        if key not in self._od:
            return struct.pack("<BHBI", 0x80, index, sub, NO_OBJECT)
        if command >> 5 == 2:
            self._refresh()
            return self._read(index, sub)
        if not self._may_write(index):
            return struct.pack("<BHBI", 0x80, index, sub, READ_ONLY)
        size = 4 - (command >> 2 & 3) if command & 1 else 4
        self._od[key] = int.from_bytes(data[4 : 4 + size], "little", signed=_signed(index, sub))
        if index == 0x6040:
            self._control(self._od[key])
        return struct.pack("<BHB4x", 0x60, index, sub)

    def _read(self, index: int, sub: int) -> bytes:
        value = self._od[index, sub]
        size = _size(index, sub)
        raw = value.to_bytes(size, "little", signed=_signed(index, sub)).ljust(4, b"\0")
        return struct.pack("<BHB4s", 0x43 | (4 - size) << 2, index, sub, raw)

    def _may_write(self, index: int) -> bool:
        is_pdo = index >> 8 in (0x14, 0x16, 0x18, 0x1A)
        return index in _WRITABLE or (is_pdo and self.nmt == PRE_OPERATIONAL) or index in (0x1400, 0x1401, 0x1402)

    # --- power ---------------------------------------------------------------------------------------------------

    def _control(self, word: int) -> None:
        reset = word & 0x80 and not self._word & 0x80
        self._word = word
        if self.state == FAULT:
            if reset and self.voltage and not self._needs_new_communication and self.coil_c < TRIP_C:
                self.state, self._od[0x603F, 0] = DISABLED, 0
        elif not word & 0x02:
            self.state = DISABLED
        elif not word & 0x04:
            if self.state == ENABLED:
                self._begin_stop()
        elif self.state == DISABLED and word & 0x07 == 0x06 and self.voltage:
            self.state = READY
        elif self.state in (READY, ON) and word & 0x0F == 0x0F:
            self.state = ENABLED
            self._ramp, self._master_ns, self._rpdo_ns = None, 0, [0] * 4
            self._last_target = self.q
        elif self.state in (READY, ON, ENABLED):
            self.state = {0x06: READY, 0x07: ON}.get(word & 0x0F, self.state)

    def _begin_stop(self) -> None:
        self.state = QUICK_STOP
        self._ramp = self.q, self.dq, 0.0

    def _emergency(self, code: int) -> None:
        self._od[0x603F, 0], self._od[0x1001, 0] = code, 1
        self._say.append(Frame(0x080 + self.node, struct.pack("<HB5x", code, 1)))

    def _fail(self, code: int) -> None:
        self._emergency(code)
        self.state = FAULT

    def cut_power(self) -> None:
        self.voltage, self.state = False, DISABLED

    def restore_power(self) -> None:
        self.voltage, self.is_silent = True, False

    def trip_over_current(self) -> None:
        self._fail(EMCY["current"])

    def say_emergency(self, code: int) -> None:
        self._emergency(code)

    def stop_by_itself(self) -> None:
        self._begin_stop()

    def jam_brake(self, closed: bool, contact: bool) -> None:
        if contact:
            self.contact_stuck = closed
        else:
            self.brake_stuck = closed

    def forget_number(self) -> None:
        self.be(lss.NO_NUMBER)

    def ignore_targets(self) -> None:
        self.is_deaf = True

    def switch_off(self) -> None:
        self.state = DISABLED

    def tick(self, q: float, dq: float, elapsed_ns: int) -> float:
        self.q, self.dq = q, dq
        self.offset += self.drift * elapsed_ns * 1e-9
        self._settled_ns = self._settled_ns + elapsed_ns if self.brake_closed != self._contact else 0
        self._contact ^= self._settled_ns >= BRAKE_NS
        self._master_ns += elapsed_ns
        self._rpdo_ns = [age_ns + elapsed_ns for age_ns in self._rpdo_ns]
        if self.state == ENABLED and self.nmt == OPERATIONAL:
            self._watch()
        if self.state == ENABLED and self.coil_c >= TRIP_C:
            self._fail(EMCY["hot"])
        wanted = self._torque(elapsed_ns * 1e-9)
        self.tau = max(-self.data.rated, min(self.data.rated, wanted))
        return self.tau

    def _watch(self) -> None:
        watched = [(0x8130, self._od[0x1016, 1] & 0xFFFF, self._master_ns)]
        watched += [(0x8250, self._od[0x1400 + k, 5], age_ns) for k, age_ns in enumerate(self._rpdo_ns)]
        for code, limit_ms, age_ns in watched:
            if limit_ms and age_ns > limit_ms * 1_000_000 and self.state == ENABLED:
                self._needs_new_communication = True
                if self.data.holds:
                    self._emergency(code)
                    self._begin_stop()
                else:
                    self._fail(code)

    def _torque(self, elapsed: float) -> float:
        d, offset = self.data, self._od[0x60B2, 0] / 1000 * self.data.rated
        if self.state == ENABLED and self._od[0x6060, 0] == TORQUE:
            self._last_target = self.q
            return self._od[0x6071, 0] / 1000 * d.rated + offset
        if self.state == ENABLED and self._od[0x6060, 0] == POSITION:
            counts = min(max(self._od[0x607A, 0], self._od[0x607D, 1]), self._od[0x607D, 2])
            target = counts / self._counts() - self.offset
            return d.kp * (target - self.q) - d.kd * self.dq + offset
        if self.state == ENABLED and self._od[0x6060, 0] == VELOCITY:
            self._last_target = self.q
            return d.kd * (self._od[0x60FF, 0] / self._counts() - self.dq) + offset
        if self.state == QUICK_STOP and self._ramp is not None:
            q0, dq0, t = self._ramp
            t = min(t + elapsed, RAMP_S)
            self._ramp = q0, dq0, t
            q, dq = q0 + dq0 * t * (1 - t / RAMP_S / 2), dq0 * (1 - t / RAMP_S)
            if t >= RAMP_S and abs(self.dq) < 0.02 and self._od[0x603F, 0]:
                self.state = FAULT  # stopped because of a loss: brake, then power
            return d.kp * (q - self.q) + d.kd * (dq - self.dq) + offset
        return 0.0

    def _counts(self) -> float:
        turns, shaft = self.data.gear
        return self.data.resolution * turns / shaft / (2 * math.pi)


def _objects(node: int, d: Data) -> dict[tuple[int, int], int]:
    od = {(index, 0): 0 for index in _FORMATS}
    od |= {(0x60FD, 0): 0, (0x60FE, 0): 2, (0x60FE, 1): 0, (0x60FE, 2): 0}
    od |= {(0x1000, 0): 0x0002_0192, (0x6502, 0): 0x380, (0x6076, 0): round(d.rated * 1000)}
    od |= {(0x1016, 0): 1, (0x1016, 1): 0, (0x1018, 0): 4, (0x1018, 1): 0x1234, (0x1018, 2): 7}
    od |= {(0x1018, 3): d.revision, (0x1018, 4): d.serial, (0x605A, 0): 2, (0x6007, 0): 1}
    od |= {(0x608F, 0): 2, (0x608F, 1): d.resolution, (0x608F, 2): 1, (0x6091, 0): 2}
    least, greatest = (round(deg / 360 * d.resolution * d.gear[0] / d.gear[1]) for deg in d.limits_deg)
    od |= {(0x607D, 0): 2, (0x607D, 1): least, (0x607D, 2): greatest}
    od |= {(0x6091, 1): d.gear[0], (0x6091, 2): d.gear[1], (0x60C2, 0): 2, (0x60C2, 1): 1, (0x60C2, 2): -3}
    for k in range(4):  # as they come from the factory: the spare ones are on
        od |= {(0x1400 + k, 0): 5, (0x1400 + k, 1): 0x200 + 0x100 * k + node, (0x1400 + k, 2): 255}
        od |= {(0x1400 + k, 3): 0, (0x1400 + k, 4): 0, (0x1400 + k, 5): 0, (0x1600 + k, 0): 0}
    for k in range(2):
        od |= {(0x1800 + k, 0): 2, (0x1800 + k, 1): 0x180 + 0x100 * k + node, (0x1800 + k, 2): 255, (0x1A00 + k, 0): 0}
    for mapping in (0x1600, 0x1601, 0x1602, 0x1603, 0x1A00, 0x1A01):
        od |= {(mapping, s): 0 for s in range(1, 5)}
    return od


def _size(index: int, sub: int) -> int:
    if index in _FORMATS:
        return struct.calcsize(_FORMATS[index])
    if sub == 0 and index not in (0x1000, 0x6502, 0x6076, 0x60FD):
        return 1
    if index == 0x60C2 or (index >> 8 in (0x14, 0x18) and sub in (2, 4)):
        return 1
    return 2 if index >> 8 in (0x14, 0x18) and sub in (3, 5) else 4


def _signed(index: int, sub: int = 0) -> bool:
    return _FORMATS.get(index, "<I")[1].islower() or (index == 0x60C2 and sub == 2) or (index == 0x607D and sub > 0)


def _wrap(value: int, bits: int) -> int:
    half = 1 << bits - 1
    return (value + half) % (1 << bits) - half
