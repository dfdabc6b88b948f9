"""What the packets of both wires say, in SI and URDF joints; and the helpers that both codecs share."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from asc_rt.core.types import RobotFlag, Vector, vector
from drivers.base import ProtocolError

PORT = 60015
DOF = 6
AXES = 9
QUEUE_CAPACITY = 10  # commands that the controller buffers ($PKT_STACK, default and maximum)
SEQUENCE_SPAN = 1 << 32
STAGES = 20  # of a limit table
_PLAUSIBLE = 1e6  # deg, mm, A; no axis turns this far: such a number is a byte-order or unit error


@dataclass(frozen=True, slots=True)
class Status:
    """One status packet: where the arm is (servo position) and whether set-points are taken."""

    seq: int
    ready: bool  # a program on the robot accepts set-points
    servo_on: bool
    moving: bool
    t_ms: int  # controller clock, steps of 2 ms: never differentiate it
    q: Vector  # (6,) rad, URDF
    place: Vector  # (3,) m, the flange in the world frame
    current: Vector  # (6,) A
    every: int = 1  # the robot tells one status of so many (only while it brakes by itself)
    inputs: int | None = None  # the signals asked for, lowest bit first; None: it tells none (yet)
    force: Vector | None = None  # (6,) N and Nm at the flange's sensor; None: there is none, or it is not chosen
    emergency_stop: bool = False
    trouble: str = ""  # what else the robot says is wrong

    @property
    def flags(self) -> RobotFlag:
        told = {
            RobotFlag.READY: self.ready,
            RobotFlag.SERVO_ON: self.servo_on,
            RobotFlag.MOVING: self.moving,
            RobotFlag.EMERGENCY_STOP: self.emergency_stop,
        }
        return RobotFlag(sum(flag for flag, on in told.items() if on))


@dataclass(frozen=True, slots=True)
class VersionReply:
    version: int  # the highest that the controller speaks


@dataclass(frozen=True, slots=True)
class Thresholds:
    """Limits of one axis at 20 stages of flange speed."""

    axis: int  # 1-9
    kind: int  # 0 velocity [rad/s], 1 acceleration [rad/s2], 2 jerk [rad/s3]
    max_speed: float  # m/s, the last stage
    no_payload: Vector  # (20,)
    full_payload: Vector  # (20,)


@dataclass(frozen=True, slots=True)
class Commanded:
    """Where the controller wants the arm to be."""

    t_ms: int
    q: Vector  # (6,) rad, URDF


@dataclass(frozen=True, slots=True)
class Command:
    """What a command packet says to the robot."""

    seq: int
    last: bool
    q: Vector  # (6,) rad, URDF, rounded as the wire rounds


SIGNAL_TYPES = {"DI": 1, "DO": 2, "RI": 8, "RO": 9}


@dataclass(frozen=True, slots=True)
class Window:
    """A row of up to 16 signals to read, written like RI[3:6] in a cell file."""

    name: str  # of SIGNAL_TYPES
    first: int
    count: int

    @property
    def mask(self) -> int:
        return (1 << self.count) - 1

    @classmethod
    def parse(cls, text: str) -> Window:
        """ValueError: not of the form RI[3:6]."""
        found = re.fullmatch(r"(DI|DO|RI|RO)\[(\d{1,5}):(\d{1,5})\]", text)
        if found is None:
            raise ValueError(f"{text!r} is not a row of signals like 'RI[3:6]'")
        window = cls(found[1], int(found[2]), int(found[3]) - int(found[2]) + 1)
        if not (window.first > 0 and 1 <= window.count <= 16):
            raise ValueError(f"{text!r} is not a row of 1 to 16 signals")
        return window


def sequence_distance(later: int, earlier: int) -> int:
    """Signed steps from `earlier` to `later` on the 32-bit circle."""
    half = SEQUENCE_SPAN // 2
    return (later - earlier + half) % SEQUENCE_SPAN - half


def plausible(values: tuple[float, ...], what: str) -> Vector:
    """`values` as an array. ProtocolError: not numbers to go by."""
    array = np.array(values)
    if not (abs(array) <= _PLAUSIBLE).all():  # false for NaN too
        raise ProtocolError(f"{what} is not a plausible number: {values}")
    return array


def place_from_wire(pose: tuple[float, ...]) -> Vector:
    """X, Y, Z of the nine numbers of a pose, mm -> m. ProtocolError: not numbers to go by."""
    return vector(plausible(pose, "pose")[:3] * 1e-3)


def set_point_degrees(axes: Vector) -> list[float]:
    """Nine axes of a set-point as plain numbers. ValueError: the wire cannot say them."""
    if abs(axes).max() > _PLAUSIBLE:
        raise ValueError(f"set-point {axes[:DOF]} deg is not an angle that the wire can say")
    return [float(axis) for axis in axes]


def check_set_point(q: Vector) -> None:
    """ValueError: not six finite angles."""
    if q.shape != (DOF,) or not np.isfinite(q).all():
        raise ValueError(f"a set-point is {DOF} finite angles, not {q}")
