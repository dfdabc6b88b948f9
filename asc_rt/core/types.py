"""The data that flows through one cycle: frozen, SI units, radians, int64 nanoseconds of the monotonic clock.

Names: `q` measured, `q_cmd` commanded (the set-point last sent). Arrays are float64, C-order and read-only once they
are in one of these types; `n` is the number of joints. Everything geometric is in the robot's base frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum, IntFlag

import numpy as np
import numpy.typing as npt

Vector = npt.NDArray[np.float64]
Matrix = npt.NDArray[np.float64]
IntVector = npt.NDArray[np.int64]

MAX_CAPSULES = 20  # of all people together, in one HumanState; one more is a fault, never a silent cut
MAX_PAIRS = 32  # pairs written into one record: the nearest ones (the QP always takes all active pairs)


def vector(values: object) -> Vector:
    """A read-only float64 copy of `values`."""
    array = np.array(values, dtype=np.float64, order="C")
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


@dataclass(frozen=True, slots=True)
class JointState:
    t_rx_ns: int  # when the sample reached this process
    t_device_ns: int  # the device's own clock; never compared with ours
    seq: int
    q: Vector  # (n,) rad, measured
    dq: Vector  # (n,) rad/s
    current: Vector  # (n,) A, motor currents (torque-controlled arms: Nm)
    flags: RobotFlag
    tool_id: int  # as the robot tells it; 0 = it tells none: the cell's tool; -1 = it should, and has not yet
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


@dataclass(frozen=True, slots=True)
class Goal:
    id: int  # increases; a goal with the id of the present one changes nothing
    q: Vector  # (n,) rad


class EventKind(IntEnum):
    ARM = 1
    STOP = 2
    END = 3  # end the session: brake, say goodbye to the robot, leave


@dataclass(frozen=True, slots=True)
class OperatorEvent:
    id: int  # increases, so that a repeated message counts once
    kind: EventKind


@dataclass(frozen=True, slots=True)
class CycleInputs:
    """Everything that one cycle may know, frozen by `asc_rt.inputs.freeze`. None is 'no data', never 'nothing
    there'."""

    tick: int
    t_ns: int
    period_ns: int
    joint: JointState | None
    human: HumanState | None  # newest message; the same one again until a newer arrives
    human_age_ns: int  # t_ns - t_capture_ns; 0 without a message
    human_fault: bool  # a message came that could not be decoded or ran backwards
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
    HUMAN_INVALID = 6
    INFEASIBLE = 7
    START_INSIDE = 8  # armed while a person was already too close
    LATE = 9
    TRACKING = 10  # the robot does not follow its set-points
    GATE = 11
    EXCEPTION = 12  # a defect of the controller itself
    ROBOT_NOT_READY = 13
    ROBOT_SILENT = 14
    ROBOT_FAULTED = 15

    @property
    def is_fault(self) -> bool:
        """Faults end the session; the other reasons wait for a person to arm again."""
        return self >= StopReason.TRACKING


@dataclass(frozen=True, slots=True)
class CoreState:
    """Plain numbers only: with CycleInputs and Params it determines the next cycle to the bit."""

    tick: int
    mode: Mode
    reason: StopReason
    q_cmd: Vector  # (n,) rad, set-point last sent
    dq_cmd: Vector  # (n,) rad/s
    ddq_cmd: Vector  # (n,) rad/s2
    goal: Goal
    reached_id: int  # id of the last goal that was reached
    event_id: int  # of the last operator event handled
    silent_cycles: int
    ending: bool  # the session ends once the robot is at rest


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


@dataclass(frozen=True, slots=True)
class Pairs:
    """Active pairs (robot capsule, human capsule), nearest first; p of them."""

    robot: IntVector  # (p,) robot capsule
    human: IntVector  # (p,) human capsule
    d: Vector  # (p,) m, separation distance of the bounded surfaces
    d_dot: Vector  # (p,) m/s, worst case within the velocity bound
    M: Vector  # (p,) m/s2, one-sided radius of the realizable set
    M_dot: Vector  # (p,) m/s3, numeric
    phi: Vector  # (p,) max(phi0, phi*)
    phi_dot: Vector  # (p,) of the control that is sent
    floor: Vector  # (p,) m/s2, least C u that the row allows
    achieved: Vector  # (p,) m/s2, C u of the control that is sent
    basis: IntVector  # (p,) Basis of the floor


@dataclass(frozen=True, slots=True)
class SafetyDecision:
    status: Status
    reason: StopReason
    u_ref: Vector  # (n,) reference control, rad/s2
    u_safe: Vector  # (n,) after the QP
    pairs: Pairs
    pair_count: int  # active pairs, also those beyond MAX_PAIRS
    iterations: int  # of the solver
    share: float  # of the ramp that was possible where rows conflict; 1 otherwise
    d_measured: float  # m, smallest separation distance of the *measured* robot; inf: no pair


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
