"""Everything that the decision depends on besides state and inputs: frozen, with canonical bytes and a content hash.

Built by `asc_rt.config` from the cell's files, written into the record whole, rebuilt from there for replay.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import typing
from dataclasses import dataclass
from typing import Any

MAX_SENSORS = 4  # of people, in one cell

Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class CapsuleSpec:
    link: str  # name of a URDF link; tools: always the flange
    p0: Triple  # m, in the link's frame
    p1: Triple
    radius: float  # m


@dataclass(frozen=True, slots=True)
class RobotParams:
    name: str
    urdf: str  # the text itself, so that a record is complete
    joints: tuple[str, ...]  # from base to flange; these are the n controlled ones
    flange: str  # link that carries the tool
    q_min: tuple[float, ...]  # rad
    q_max: tuple[float, ...]
    dq_max: tuple[float, ...]  # rad/s
    ddq_max: tuple[float, ...]  # rad/s2
    dddq_max: tuple[float, ...]  # rad/s3
    effort: tuple[float, ...]  # Nm, torque limits of a torque-controlled arm; () if it takes positions
    command_latency_ns: int  # from sending a set-point to the arm being there
    capsules: tuple[CapsuleSpec, ...]


@dataclass(frozen=True, slots=True)
class ToolParams:
    name: str
    mass: float  # kg
    com: Triple  # m, flange frame
    inertia: tuple[float, float, float, float, float, float]  # kg m2 about the com: xx xy xz yy yz zz
    capsules: tuple[CapsuleSpec, ...]


STAND_IN = -1  # number of the mount that stands for every tool that no other mount has


@dataclass(frozen=True, slots=True)
class Mount:
    """A tool that the arm may carry, and what goes with it."""

    number: int  # as the changer tells it (JointState.tool_id) or a person names it; STAND_IN
    tool: ToolParams
    speed_share: float  # 0..1, of the arm's velocity limits
    covered: bool  # a certificate covers the arm with this tool and these limits


@dataclass(frozen=True, slots=True)
class ChangerParams:
    """Which tools there are, and how one knows which of them is mounted. No mounts: the cell's tool, always."""

    mounts: tuple[Mount, ...] = ()  # the cell's own tool first
    told_by_robot: bool = False  # by JointState.tool_id; False: by a person, at rest
    goes_on: bool = False  # a swap in motion may be gone on with where the new tool's rows all hold; False: it stops
    nm_per_ampere: tuple[float, ...] = ()  # joint torque per motor current, per joint; (): the weight is not checked
    torque_tolerance: float = 0.0  # Nm, of holding torques


@dataclass(frozen=True, slots=True)
class SafetyParams:
    d_min: float  # m, least separation distance
    activation_distance: float  # m, pairs farther apart get no row
    k: float  # of phi*, m2/s2... see safety_index
    eta: float  # 1/s: a positive phi has to fall by at least this share of itself
    M_floor: float  # m/s2, below it phi* is not evaluated
    human_acceleration: float  # m/s2, bound on the person's acceleration towards the robot
    rearm_distance: float  # m, least separation distance at which arming is accepted
    index: str = "phi-star"  # or "phi-b", the stopping-distance index
    brake: float = 1.0  # m/s2, deceleration that phi_b counts on
    v_max: float = 1.0  # m/s, approach speed up to which the index is certified; faster is flagged, see safety_index


@dataclass(frozen=True, slots=True)
class SensorParams:
    """A sensor of people that must be heard. Its id is what its messages carry."""

    name: str = "person"
    id: int = 1
    calibration_hash: int = 0  # the one that its messages must carry; 0 = ground truth


@dataclass(frozen=True, slots=True)
class HumanParams:
    """The rungs of human_ladder."""

    slow_age_ns: int  # older data slow the task down
    age_limit_ns: int  # older data stop the robot
    future_limit_ns: int  # a capture stamp this far ahead of now is a fault
    clock_limit_ns: int = 20_000_000  # a stamp that may be off by more stops the robot
    slow_coverage: float = 0.0  # less slows the task down
    least_coverage: float = 0.0  # less stops the robot
    sensors: tuple[SensorParams, ...] = (SensorParams(),)


@dataclass(frozen=True, slots=True)
class MonitorParams:
    """Speed and separation monitoring, see separation_monitor."""

    human_speed: float = 1.6  # m/s, v_h; ISO 13855:2010, walking
    intrusion_distance: float = 0.0  # m, C; 0: the sensor reports every part of the body
    robot_uncertainty: float = 0.01  # m, Z_r
    is_enforced: bool = False  # a protective stop while the distance is below S_p


@dataclass(frozen=True, slots=True)
class TaskParams:
    speed: float  # 0..1, share of the velocity limits that the reference uses
    goal_tolerance: float  # rad, per joint
    slow_speed: float = 0.1  # the share while something asks for caution; never more than `speed`


@dataclass(frozen=True, slots=True)
class Params:
    period_ns: int
    control: str  # "acceleration": the robot takes positions; "torque"
    silence_cycles: int  # this many periods without a sample are a silent robot
    tracking_tolerance: float  # rad, measured against commanded, beyond what the latency explains
    robot: RobotParams
    tool: ToolParams
    safety: SafetyParams
    human: HumanParams
    task: TaskParams
    monitor: MonitorParams = MonitorParams()
    changer: ChangerParams = ChangerParams()

    def holding(self, mount: int) -> Params:
        """As if the tool of this mount were the only one: with its limits, without a changer."""
        if not self.changer.mounts:
            return self
        held = self.changer.mounts[mount]
        slower = tuple(held.speed_share * v for v in self.robot.dq_max)
        robot = dataclasses.replace(self.robot, dq_max=slower)
        return dataclasses.replace(self, tool=held.tool, robot=robot, changer=ChangerParams())

    @property
    def n(self) -> int:
        return len(self.robot.joints)

    @property
    def period(self) -> float:
        return self.period_ns * 1e-9

    def canonical(self) -> bytes:
        """JSON with sorted keys and shortest exact floats: equal parameters have equal bytes."""
        return json.dumps(dataclasses.asdict(self), sort_keys=True, separators=(",", ":")).encode()

    def content_hash(self) -> str:
        return hashlib.sha256(self.canonical()).hexdigest()

    @classmethod
    def from_canonical(cls, data: bytes) -> Params:
        """Inverse of canonical(). TypeError or KeyError: not of this version."""
        return typing.cast(Params, _build(cls, json.loads(data)))


def _build(kind: Any, value: Any) -> Any:
    if dataclasses.is_dataclass(kind):
        hints = typing.get_type_hints(kind)
        if unknown := set(value) - set(hints):
            raise KeyError(f"not of this version: {', '.join(sorted(unknown))}")
        return typing.cast(Any, kind)(
            **{f.name: _build(hints[f.name], value[f.name]) for f in dataclasses.fields(kind)}
        )
    if typing.get_origin(kind) is tuple:
        args = typing.get_args(kind)
        return tuple(_build(args[0], item) for item in value)
    return value
