"""What may stand in the files of a cell: cells/*.toml, robots/*/profile.toml, robots/tools/*.toml.

Units are part of the key names (`d_min_m`, `age_limit_ms`, `position_deg`); lengths without one are metres. The ranges
are wide: they catch a wrong sign and a wrong unit, they do not judge an engineer's choice.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field


def _number(low: float, high: float) -> Any:
    return Field(strict=True, allow_inf_nan=False, ge=low, le=high)


def _integer(low: int, high: int) -> Any:
    return Field(strict=True, ge=low, le=high)


Text = Annotated[str, Field(strict=True, min_length=1)]
Metre = Annotated[float, _number(-5.0, 5.0)]
Radius = Annotated[float, _number(0.005, 0.5)]
Degree = Annotated[float, _number(-720.0, 720.0)]
Provenance = str | dict[str, str]


class Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Driver(BaseModel):
    """`name` picks the driver; the other keys are the driver's own and it checks them."""

    model_config = ConfigDict(extra="allow", frozen=True)
    name: Text


class Bus(Table):
    endpoint: Annotated[str, Field(strict=True, pattern=r"^tcp/[^:/\s]+:\d{1,5}$")]


class Human(Table):
    age_limit_ms: Annotated[float, _number(10, 1000)]
    future_limit_ms: Annotated[float, _number(0, 100)]
    calibration: Text  # "ground-truth", or a calibration file
    camera: str = ""  # serial number that the calibration must belong to; empty in a simulated cell: any
    camera_mode: str = ""  # "1280x720"


class Safety(Table):
    d_min_m: Annotated[float, _number(0.0, 2.0)]
    activation_m: Annotated[float, _number(0.1, 10.0)]
    k: Annotated[float, _number(0.01, 10000.0)]
    eta: Annotated[float, _number(0.01, 100.0)]
    M_floor: Annotated[float, _number(0.01, 100.0)]
    human_acceleration_m_s2: Annotated[float, _number(0.0, 50.0)]
    rearm_distance_m: Annotated[float, _number(0.0, 5.0)]


class Task(Table):
    speed: Annotated[float, _number(0.01, 1.0)]
    goal_tolerance_deg: Annotated[float, _number(0.01, 10.0)]
    goals_deg: Annotated[list[list[Degree]], Field(min_length=1)]


class Control(Table):
    level: Literal["acceleration", "torque"] = "acceleration"  # what the robot takes: positions, or torques
    silence_cycles: Annotated[int, _integer(1, 125)]
    tracking_tolerance_deg: Annotated[float, _number(0.5, 45.0)]


class RealTime(Table):
    priority: Annotated[int, _integer(1, 98)] = 80
    cpu: Annotated[int, _integer(-1, 1023)] = -1


class Log(Table):
    dir: Text = "runs"
    key: str = ""  # file of the key that seals recordings; "": the user's own, made at first use
    on_full: Literal["finish", "stop"] = "stop"  # the disk takes no more: finish the session unrecorded, or stop it
    rotate_min: Annotated[float, _number(0, 1440)] = 0.0  # minutes in one file; 0: all


class CellFile(Table):
    name: Text
    robot: Text
    tool: Text
    simulated: Annotated[bool, Field(strict=True)]
    certificates: Text = "certificates"  # folder beside the cell file, with ROBOT-TOOL.json
    uncertified: Annotated[bool, Field(strict=True)] = False  # run without; simulated cells only
    period_ms: Literal[2, 4, 8]
    driver: Driver
    bus: Bus
    human: Human
    safety: Safety
    task: Task
    control: Control
    realtime: RealTime = RealTime()
    log: Log = Log()
    sim: dict[str, dict[str, Any]] = {}


class Capsule(Table):
    p0: tuple[Metre, Metre, Metre]
    p1: tuple[Metre, Metre, Metre]
    radius: Radius
    provenance: Provenance = ""


class LinkCapsule(Capsule):
    link: Text


class Joints(Table):
    names: Annotated[list[Text], Field(min_length=1)]
    position_deg: list[tuple[Degree, Degree]]
    velocity_deg_s: list[Annotated[float, _number(15, 3000)]]
    acceleration_deg_s2: list[Annotated[float, _number(60, 100000)]]
    jerk_deg_s3: list[Annotated[float, _number(600, 10000000)]]
    effort_nm: list[Annotated[float, _number(0.1, 10000)]] | None = None  # torque-controlled arms only
    provenance: Provenance


class ProfileFile(Table):
    name: Text
    urdf: Text
    flange: Text
    payload_kg: Annotated[float, _number(0.01, 3000)]
    command_latency_ms: Annotated[float, _number(0, 500)]
    provenance: Provenance
    joints: Joints
    capsules: Annotated[list[LinkCapsule], Field(min_length=1)]


class ToolFile(Table):
    name: Text
    mass_kg: Annotated[float, _number(0, 3000)]
    com: tuple[Metre, Metre, Metre]
    inertia: tuple[float, float, float, float, float, float]  # kg m2 about the com: xx xy xz yy yz zz
    provenance: Provenance
    capsules: list[Capsule]
