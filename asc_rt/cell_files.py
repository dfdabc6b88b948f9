"""What may stand in the files of a cell: cells/*.toml, robots/*/profile.toml, robots/tools/*.toml.

Units are part of the key names (`d_min_m`, `age_limit_ms`, `position_deg`); lengths without one are metres. The ranges
are wide: they catch a wrong sign and a wrong unit, they do not judge an engineer's choice.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from asc_rt.core.params import MAX_SENSORS


def number(low: float, high: float) -> Any:
    return Field(strict=True, allow_inf_nan=False, ge=low, le=high)


def integer(low: int, high: int) -> Any:
    return Field(strict=True, ge=low, le=high)


Text = Annotated[str, Field(strict=True, min_length=1)]
Metre = Annotated[float, number(-5.0, 5.0)]
Radius = Annotated[float, number(0.005, 0.5)]
Degree = Annotated[float, number(-720.0, 720.0)]
SensorName = Annotated[str, Field(strict=True, pattern=r"^[a-z0-9_-]{1,32}$")]
Provenance = str | dict[str, str]


class Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Driver(BaseModel):
    """`name` picks the driver; the other keys are the driver's own and it checks them."""

    model_config = ConfigDict(extra="allow", frozen=True)
    name: Text


class Remote(Table):
    """The door for sensors on other machines; see bus_keys."""

    endpoint: Annotated[str, Field(strict=True, pattern=r"^tls/[^:/\s]+:\d{1,5}$")]
    keys: Text = "keys"  # folder beside the cell file, made by `asc keys`


class Bus(Table):
    endpoint: Annotated[str, Field(strict=True, pattern=r"^tcp/[^:/\s]+:\d{1,5}$")]  # on loopback
    remote: Remote | None = None


class Human(Table):
    slow_age_ms: Annotated[float, number(10, 1000)] = 100.0
    age_limit_ms: Annotated[float, number(10, 1000)]
    future_limit_ms: Annotated[float, number(0, 100)]
    clock_limit_ms: Annotated[float, number(0, 100)] = 20.0  # a sensor's clock may be off by so much
    slow_coverage: Annotated[float, number(0, 1)] = 0.9
    least_coverage: Annotated[float, number(0, 1)] = 0.7
    sensors: Annotated[list[SensorName], Field(min_length=1, max_length=MAX_SENSORS)] = ["person"]
    calibration: Text  # "ground-truth", "cameras" (those of [perception]), or a calibration file
    calibrations: dict[str, Text] = {}  # of single sensors, by name
    camera: str = ""  # serial number that the calibration must belong to; empty in a simulated cell: any
    camera_mode: str = ""  # "1280x720"


class Camera(Table):
    """One depth camera of [perception]; the files lie beside the cell file."""

    device: Driver  # `name` picks the backend
    calibration: Text  # result of `asc calibrate hand-eye`: where it stands
    background: Text  # made by `asc perceive CELL --background`
    intrinsics: str = ""  # result of `asc calibrate intrinsics`; "": what the device says of its lens
    time_offset: str = ""  # result of `asc calibrate time-offset`; "": the arm's clock is the camera's
    binning: Annotated[int, integer(1, 8)] = 1  # so many pixels of the mode of `intrinsics` make one, each way


class Pose(Table):
    """An estimator of people's poses beside the depth layer: what it sees is added, nothing is taken away."""

    backend: Text
    model: Text  # file, beside the cell file


class Perception(Table):
    """People seen by depth cameras, as one sensor of [human]. Lengths in the robot's base frame."""

    sensor: SensorName = "person"
    remote: Annotated[bool, Field(strict=True)] = False  # it runs on another machine: `asc perceive CELL --remote`
    low: tuple[Metre, Metre, Metre]  # corners of the guarded volume
    high: tuple[Metre, Metre, Metre]
    voxel_m: Annotated[float, number(0.02, 0.2)] = 0.05
    margin_m: Annotated[float, number(0.02, 0.2)] = 0.06  # around the robot nothing is told from it
    detection_m: Annotated[float, number(0.01, 0.5)] = 0.07  # width of what is surely seen; for who reads the log
    record: Annotated[bool, Field(strict=True)] = False  # the depth images go into the session's recording, too
    pose: Pose | None = None  # None: without
    camera: Annotated[dict[SensorName, Camera], Field(min_length=1, max_length=8)]


# Under this phi* leaves no room for what it takes as constant during a stop (C, drift, M between two cycles): at 1 kHz
# a torque-controlled Panda came 0.4 mm inside d_min, with k = 0.3 and 0.6 alike (see sim_hil.trials.suites).
LEAST_K = 1.0


class Safety(Table):
    d_min_m: Annotated[float, number(0.0, 2.0)]
    activation_m: Annotated[float, number(0.1, 10.0)]
    k: Annotated[float, number(LEAST_K, 10000.0)]
    eta: Annotated[float, number(0.01, 100.0)]
    M_floor: Annotated[float, number(0.01, 100.0)]
    human_acceleration_m_s2: Annotated[float, number(0.0, 50.0)]
    rearm_distance_m: Annotated[float, number(0.0, 5.0)]
    index: Literal["phi-star", "phi-b"] = "phi-star"  # phi-b: the stopping-distance index, on brake_m_s2
    brake_m_s2: Annotated[float, number(0.01, 100.0)] = 1.0
    v_max_m_s: Annotated[float, number(0.01, 10.0)] = 1.0  # approach speed up to which the index is certified


class Monitor(Table):
    human_speed_m_s: Annotated[float, number(0.0, 5.0)] = 1.6
    intrusion_m: Annotated[float, number(0.0, 2.0)] = 0.0
    robot_uncertainty_m: Annotated[float, number(0.0, 0.5)] = 0.01
    enforce: Annotated[bool, Field(strict=True)] = False


class Task(Table):
    speed: Annotated[float, number(0.01, 1.0)]
    slow_speed: Annotated[float, number(0.001, 1.0)] = 0.1  # while something asks for caution
    goal_tolerance_deg: Annotated[float, number(0.01, 10.0)]
    goals_deg: Annotated[list[list[Degree]], Field(min_length=1)]


class Control(Table):
    level: Literal["acceleration", "torque"] = "acceleration"  # what the robot takes: positions, or torques
    silence_cycles: Annotated[int, integer(1, 125)]
    tracking_tolerance_deg: Annotated[float, number(0.5, 45.0)]


class ToolMount(Table):
    number: Annotated[int, integer(0, 2**31 - 1)]  # as the changer tells it, or a person names it; 0: it is empty
    tool: Text
    speed_share: Annotated[float, number(0.01, 1.0)] = 1.0  # of the arm's velocity limits


class Tools(Table):
    """The tools that the arm may carry; without this table it carries the cell's own."""

    told_by: Literal["robot", "operator"]
    mount: Annotated[list[ToolMount], Field(min_length=1)]
    in_motion: Literal["stop", "go-on"] = "stop"  # on a swap; "go-on": only where the new tool's rows all hold
    unknown: Literal["stop", "enclosing-sphere"] = "stop"  # what a tool with another number is taken for
    nm_per_ampere: list[Annotated[float, number(0.0, 10000.0)]] = []  # per joint; []: the weight is not checked
    torque_tolerance_nm: Annotated[float, number(0.01, 1000.0)] = 1.0


class RealTime(Table):
    priority: Annotated[int, integer(1, 98)] = 80
    cpu: Annotated[int, integer(-1, 1023)] = -1


class Log(Table):
    dir: Text = "runs"
    key: str = ""  # file of the key that seals recordings; "": the user's own, made at first use
    on_full: Literal["finish", "stop"] = "stop"  # the disk takes no more: finish the session unrecorded, or stop it
    rotate_min: Annotated[float, number(0, 1440)] = 0.0  # minutes in one file; 0: all


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
    perception: Perception | None = None
    safety: Safety
    monitor: Monitor = Monitor()
    task: Task
    control: Control
    tools: Tools | None = None
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
    velocity_deg_s: list[Annotated[float, number(15, 3000)]]
    acceleration_deg_s2: list[Annotated[float, number(60, 100000)]]
    jerk_deg_s3: list[Annotated[float, number(600, 10000000)]]
    effort_nm: list[Annotated[float, number(0.1, 10000)]] | None = None  # torque-controlled arms only
    provenance: Provenance


class ProfileFile(Table):
    name: Text
    urdf: Text
    flange: Text
    payload_kg: Annotated[float, number(0.01, 3000)]
    command_latency_ms: Annotated[float, number(0, 500)]
    provenance: Provenance
    joints: Joints
    capsules: Annotated[list[LinkCapsule], Field(min_length=1)]


class ToolFile(Table):
    name: Text
    mass_kg: Annotated[float, number(0, 3000)]
    com: tuple[Metre, Metre, Metre]
    inertia: tuple[float, float, float, float, float, float]  # kg m2 about the com: xx xy xz yy yz zz
    provenance: Provenance
    capsules: list[Capsule]
