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


@dataclass(frozen=True, slots=True)
class SafetyParams:
    d_min: float  # m, least separation distance
    activation_distance: float  # m, pairs farther apart get no row
    k: float  # of phi*, m2/s2... see safety_index
    eta: float  # 1/s: a positive phi has to fall by at least this share of itself
    M_floor: float  # m/s2, below it phi* is not evaluated
    human_acceleration: float  # m/s2, bound on the person's acceleration towards the robot
    rearm_distance: float  # m, least separation distance at which arming is accepted


@dataclass(frozen=True, slots=True)
class HumanParams:
    age_limit_ns: int  # older data stop the robot
    future_limit_ns: int  # a capture stamp this far ahead of now is a fault
    calibration_hash: int  # the one that the messages must carry; 0 = ground truth


@dataclass(frozen=True, slots=True)
class TaskParams:
    speed: float  # 0..1, share of the velocity limits that the reference uses
    goal_tolerance: float  # rad, per joint


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
