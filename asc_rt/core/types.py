"""The data that flows through one cycle: frozen, SI units, radians, int64 nanoseconds of the monotonic clock.

Names: `q` measured, `q_cmd` commanded (the set-point last sent). Arrays are float64, C-order and read-only once they
are in one of these types; `n` is the number of joints. Everything geometric is in the robot's base frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Any, Generic, TypeVar

import numpy as np
import numpy.typing as npt

Vector = npt.NDArray[np.float64]
Matrix = npt.NDArray[np.float64]
IntVector = npt.NDArray[np.int64]
IntMatrix = npt.NDArray[np.int64]
BoolVector = npt.NDArray[np.bool_]
Number = TypeVar("Number", np.int64, np.float64)

MAX_CAPSULES = 20  # of all people together, from all sensors; one more is a fault, never a silent cut
MAX_PAIRS = 32  # pairs written into one record: the nearest ones (the QP always takes all active pairs)
PAIR_ROWS = 12  # what is written of each of them, see Pairs


def vector(values: object) -> Vector:
    """A read-only float64 copy of `values`."""
    array = np.array(values, dtype=np.float64, order="C")
    array.setflags(write=False)
    return array


def frozen(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """`array` itself, read-only from now on; for arrays that nobody else holds."""
    array.setflags(write=False)
    return array


# --- what comes in ---------------------------------------------------------------------------------------------------


class RobotFlag(IntFlag):
    """State bits that every driver can tell; a driver maps its own bits to these."""

    READY = 1  # the robot accepts set-points now
    SERVO_ON = 2
    MOVING = 4
    EMERGENCY_STOP = 8
    FAULTED = 16
    WARM = 32  # it still does all that it is asked for, and had better be asked for less


@dataclass(frozen=True, slots=True)
class JointState:
    t_rx_ns: int  # when the sample reached this process
    t_device_ns: int  # the device's own clock; never compared with ours
    seq: int
    q: Vector  # (n,) rad, measured
    dq: Vector  # (n,) rad/s
    current: Vector  # (n,) A, motor currents (torque-controlled arms: Nm)
    flags: RobotFlag
    tool_id: int  # as the changer tells it (0: it is empty), -1: not told yet; 0 from a robot that tells of no tool
    dq_is_estimated: bool  # True: differenced from q by the driver


class Health(IntEnum):
    OK = 0
    DEGRADED = 1
    FAULT = 2


class Visibility(IntEnum):
    OBSERVED = 0
    PREDICTED = 1
    OCCLUDED = 2


@dataclass(frozen=True, slots=True)
class HumanState:
    """People as capsules: a segment p0-p1 swept by a sphere. m = number of capsules, up to MAX_CAPSULES."""

    t_capture_ns: int  # mid-exposure, monotonic clock of this machine
    seq: int
    sensor_id: int
    calibration_hash: int  # first 8 bytes of the calibration's SHA-256; 0 = ground truth, needs none
    health: Health
    coverage: float  # 0..1, share of the guarded volume that the sensor sees
    empty_certified: bool  # True: no capsules means that nobody is there; False: it means nothing
    p0: Matrix  # (m, 3) m
    p1: Matrix  # (m, 3) m
    v0: Matrix  # (m, 3) m/s
    v1: Matrix  # (m, 3) m/s
    radius: Vector  # (m,) m
    position_bound: Vector  # (m,) m, how far the surface may be off at capture
    velocity_bound: Vector  # (m,) m/s, how far v0, v1 may be off
    visibility: IntVector  # (m,) Visibility


class MessageFault(IntEnum):
    """Why a message of a sensor was refused; NONE again after some good ones. See human_ladder and sensor_mail."""

    NONE = 0
    UNREADABLE = 1  # no HumanState, or a number in it that cannot be
    ORDER = 2  # sequence or capture stamp did not increase: duplicated, reordered, or two publishers
    SENDER = 3  # of another sensor, or one that claims to be safety rated
    SCHEMA = 4  # of another version
    CLOCK = 5  # stamped by a clock that is not ours


@dataclass(frozen=True, slots=True)
class SensorReport:
    """What one expected sensor last said of itself, and how it came. Where its people are is in the HumanState."""

    id: int
    seq: int  # of its newest good message; 0: none has come yet
    age_ns: int  # of the capture; below 0: stamped ahead of us
    sigma_ns: int  # how far the capture stamp may be off our clock
    fault: MessageFault
    health: Health
    coverage: float
    calibration_hash: int
    says_nothing: bool  # no capsules, and not certified that nobody is there


@dataclass(frozen=True, slots=True)
class Goal:
    id: int  # increases; a goal with the id of the present one changes nothing
    q: Vector  # (n,) rad


class EventKind(IntEnum):
    ARM = 1
    STOP = 2
    END = 3  # end the session: brake, say goodbye to the robot, leave
    TOOL = 4  # a person says which tool is mounted; heard at rest, where the robot does not tell it


@dataclass(frozen=True, slots=True)
class OperatorEvent:
    id: int  # increases, so that a repeated message counts once
    kind: EventKind
    tool: int = 0  # TOOL: number of the mount


@dataclass(frozen=True, slots=True)
class CycleInputs:
    """Everything that one cycle may know, frozen by `asc_rt.inputs.freeze`. None is 'no data', never 'nothing
    there'."""

    tick: int
    t_ns: int
    period_ns: int
    joint: JointState | None
    human: HumanState | None  # what all sensors together see, newest messages; the same until a newer arrives
    human_age_ns: int  # t_ns - t_capture_ns; 0 without a message
    sensors: tuple[SensorReport, ...]  # every expected one, in the order of the parameters
    goal: Goal | None
    events: tuple[OperatorEvent, ...]
    missed_ticks: int  # samples of the robot lost since the last cycle
    late: bool  # the cycle began after its deadline


# --- what the core remembers -----------------------------------------------------------------------------------------


class Mode(IntEnum):
    IDLE = 0  # no joint state seen yet
    HOLD = 1  # set-point stands still, waits for a person to arm
    ACTIVE = 2
    STOPPING = 3  # braking on a planned profile
    STOPPED = 4  # at rest after a protective stop, waits for a person to arm
    FAULT = 5  # at rest or cut off; the session is over
    ENDED = 6  # at rest, session ended on request

    @property
    def is_over(self) -> bool:
        return self in (Mode.FAULT, Mode.ENDED)


class StopReason(IntEnum):
    """Why the robot was stopped. Ordered: a later (worse) reason replaces an earlier one, never the other way round."""

    NONE = 0
    SESSION_END = 1
    OPERATOR_STOP = 2
    HUMAN_MISSING = 3
    HUMAN_STALE = 4
    HUMAN_UNHEALTHY = 5
    HUMAN_COVERAGE = 6  # a sensor sees too little of the guarded volume
    HUMAN_UNSYNCED = 7  # how far a sensor's clock is off is not known well enough
    HUMAN_INVALID = 8
    TOOL_CHANGED = 9  # the tool was changed while the robot moved
    TOOL_UNKNOWN = 10  # the robot should tell which tool it carries, and has not yet
    TOOL_MISMATCH = 11  # it carries another tool than the cell knows, or a heavier or lighter one
    TOOL_UNCERTIFIED = 12  # no certificate covers the tool that it carries
    INFEASIBLE = 13
    START_INSIDE = 14  # armed while a person was already too close
    LATE = 15
    SEPARATION = 16  # contact cannot be excluded; or nearer than the protective distance, where the cell enforces it
    ROBOT_WARM = 17  # its drives ask for caution: a reason to go slowly only
    HUMAN_SCHEMA = 18  # a sensor speaks another version of the message
    HUMAN_CLOCK = 19  # a sensor stamps with another clock, or ahead of it
    HUMAN_CALIBRATION = 20  # a sensor is calibrated otherwise than the cell says
    TRACKING = 21  # the robot does not follow its set-points
    GATE = 22
    EXCEPTION = 23  # a defect of the controller itself
    ROBOT_NOT_READY = 24
    ROBOT_SILENT = 25
    ROBOT_FAULTED = 26

    @property
    def is_fault(self) -> bool:
        """Faults end the session; the other reasons wait for a person to arm again."""
        return self >= StopReason.HUMAN_SCHEMA

    @property
    def is_of_people(self) -> bool:
        """What is known of people is not good enough."""
        waits = StopReason.HUMAN_MISSING <= self <= StopReason.HUMAN_INVALID
        return waits or StopReason.HUMAN_SCHEMA <= self <= StopReason.HUMAN_CALIBRATION


@dataclass(frozen=True, slots=True)
class CoreState:
    """Plain numbers only: with CycleInputs and Params it determines the next cycle to the bit."""

    tick: int
    mode: Mode
    reason: StopReason
    slow: StopReason  # why the task runs at its slow speed; NONE: it does not
    q_cmd: Vector  # (n,) rad, set-point last sent
    dq_cmd: Vector  # (n,) rad/s
    ddq_cmd: Vector  # (n,) rad/s2
    goal: Goal
    reached_id: int  # id of the last goal that was reached
    event_id: int  # of the last operator event handled
    silent_cycles: int
    ending: bool  # the session ends once the robot is at rest
    tool: int  # index of the mount whose model, capsules and limits are decided with


# --- what is decided -------------------------------------------------------------------------------------------------


class Status(IntEnum):
    PASS = 0  # the reference kept every row
    FILTERED = 1
    INFEASIBLE = 2  # no control keeps every row: brake
    BAD_INPUT = 3
    STOPPED = 4  # not controlling: holding, braking or at rest


class Basis(IntEnum):
    """What a row's floor comes from; see safety_index."""

    INDEX = 0
    STANDSTILL = 1
    RAMP = 2  # the person comes faster than the robot can make good: brake as fast as the arm can
    M_FLOOR = 3  # the control hardly reaches this direction
    FREE = 4  # no control of this period can break the row, whatever M is: M and M_dot were not evaluated and are 0


class Outside(IntFlag):
    """Where a pair is outside the ranges that its index was certified on. Near the person the approach has to end."""

    NOTHING = 0
    DISTANCE = 1  # d < d_min
    SPEED = 2  # the approach is faster than v_max
    RADIUS = 4  # M at or under its floor


class _Row(Generic[Number]):
    """One row of `Pairs.table`, as far as it is used; whole numbers stand there by their bits."""

    def __init__(self, at: int, kind: type[Number]) -> None:
        self.at = at
        self._kind: type[Number] = kind

    def __get__(self, pairs: Pairs, owner: type) -> npt.NDArray[Number]:
        row: npt.NDArray[Number] = pairs.table[self.at, : pairs.count].view(self._kind)
        return row


@dataclass(frozen=True, slots=True)
class Pairs:
    """Active pairs (robot capsule, human capsule), nearest first. In one array: twelve would take the kernels and the
    record, that hand them over in every cycle, longer than to fill them."""

    count: int  # p
    table: Matrix  # (PAIR_ROWS, MAX_PAIRS), the rows below, 0 from p on

    robot = _Row(0, np.int64)  # (p,) robot capsule
    human = _Row(1, np.int64)  # (p,) human capsule
    d = _Row(2, np.float64)  # (p,) m, separation distance of the bounded surfaces
    d_dot = _Row(3, np.float64)  # (p,) m/s, worst case within the velocity bound
    M = _Row(4, np.float64)  # (p,) m/s2, one-sided radius of the realizable set
    M_dot = _Row(5, np.float64)  # (p,) m/s3, numeric
    phi = _Row(6, np.float64)  # (p,) max(phi0, phi*); M not evaluated: with M at its floor, no less than the true one
    phi_dot = _Row(7, np.float64)  # (p,) of the control that is sent
    floor = _Row(8, np.float64)  # (p,) m/s2, least C u that the row allows
    achieved = _Row(9, np.float64)  # (p,) m/s2, C u of the control that is sent
    basis = _Row(10, np.int64)  # (p,) Basis of the floor
    outside = _Row(11, np.int64)  # (p,) Outside


@dataclass(frozen=True, slots=True)
class Monitor:
    """Speed and separation monitoring in ISO's terms; see separation_monitor."""

    distance: float  # m, to where the person was seen; inf: nobody is there
    protective_distance: float  # m, S_p
    robot_speed: float  # m/s, v_r
    age: float  # s, T_a, of the oldest sensor, clock error included
    reaction_time: float  # s, T_r
    stopping_time: float  # s, T_s

    @property
    def is_kept(self) -> bool:
        return self.distance >= self.protective_distance


@dataclass(frozen=True, slots=True)
class SafetyDecision:
    status: Status
    reason: StopReason
    u_ref: Vector  # (n,) reference control, rad/s2
    u_safe: Vector  # (n,) after the QP
    pairs: Pairs
    pair_count: int  # active pairs, also those beyond MAX_PAIRS
    iterations: int  # of the solver
    share: float  # of the braking that was possible where rows conflict; 1 otherwise
    d_measured: float  # m, smallest separation distance of the *measured* robot; inf: no pair
    d_goal: float  # m, the same of the robot at its goal: under d_min it waits until the person makes way; inf: no pair
    monitor: Monitor | None  # None: no sample of the robot, or no data of people


class CommandKind(IntEnum):
    POSITION = 0
    VELOCITY = 1
    TORQUE = 2


@dataclass(frozen=True, slots=True)
class JointCommand:
    tick: int
    kind: CommandKind
    q: Vector
    dq: Vector
    tau: Vector
    is_last: bool  # the last set-point of the session, at rest


@dataclass(frozen=True, slots=True)
class StopRequest:
    """Nothing can be streamed any more: end the connection the way the driver's robot stops best."""

    reason: StopReason


@dataclass(frozen=True, slots=True)
class CycleOutputs:
    decision: SafetyDecision
    command: JointCommand | None
    stop: StopRequest | None
