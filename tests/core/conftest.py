"""A bench for the core: parameters, made-up messages, a lockstep loop, and distances by other means than the
product's."""

from __future__ import annotations

import functools
import math
import tomllib
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from asc_rt.core.fusion import heard
from asc_rt.core.params import CapsuleSpec, HumanParams, Params, RobotParams, SafetyParams, TaskParams, ToolParams
from asc_rt.core.step import step
from asc_rt.core.system import System, initial
from asc_rt.core.types import (
    CoreState,
    CycleInputs,
    CycleOutputs,
    EventKind,
    Goal,
    Health,
    HumanState,
    JointState,
    Mode,
    OperatorEvent,
    RobotFlag,
    SensorReport,
    vector,
)

ROBOTS = Path(__file__).parents[2] / "asc_rt" / "robots"
T = 0.008
HOME = np.radians([0.0, 5.0, 10.0, 0.0, -75.0, 0.0])
GOALS = np.radians([[-60, 5, 0, 0, -85, 0], [0, 30, 20, 0, -80, 0], [60, 5, 0, 0, -85, 0], [0, 5, 10, 0, -75, 0]])
FINE = RobotFlag.READY | RobotFlag.SERVO_ON


@functools.cache
def make_params(tool: str = "drill") -> Params:
    """The LR Mate with a tool, read without the product's own loader; the safety numbers are the tests' own."""
    folder = ROBOTS / "lrmate_200id"
    profile = tomllib.loads((folder / "profile.toml").read_text())
    held = tomllib.loads((ROBOTS / "tools" / f"{tool}.toml").read_text())
    joints = profile["joints"]

    def radians(values: list[float]) -> tuple[float, ...]:
        return tuple(math.radians(v) for v in values)

    def capsules(table: dict[str, Any], link: str | None) -> tuple[CapsuleSpec, ...]:
        found = table.get("capsules", [])
        return tuple(CapsuleSpec(link or c["link"], tuple(c["p0"]), tuple(c["p1"]), c["radius"]) for c in found)

    robot = RobotParams(
        name=profile["name"],
        urdf=(folder / profile["urdf"]).read_text(),
        joints=tuple(joints["names"]),
        flange=profile["flange"],
        q_min=radians([low for low, _ in joints["position_deg"]]),
        q_max=radians([high for _, high in joints["position_deg"]]),
        dq_max=radians(joints["velocity_deg_s"]),
        ddq_max=radians(joints["acceleration_deg_s2"]),
        dddq_max=radians(joints["jerk_deg_s3"]),
        effort=(),
        command_latency_ns=60_000_000,
        capsules=capsules(profile, None),
    )
    carried = ToolParams(
        tool, held["mass_kg"], tuple(held["com"]), tuple(held["inertia"]), capsules(held, profile["flange"])
    )
    safety = SafetyParams(
        d_min=0.1, activation_distance=1.0, k=3.0, eta=1.0, M_floor=0.3, human_acceleration=3.0, rearm_distance=0.15
    )
    return Params(
        period_ns=8_000_000,
        control="acceleration",
        silence_cycles=12,
        tracking_tolerance=math.radians(8.0),
        robot=robot,
        tool=carried,
        safety=safety,
        human=HumanParams(100_000_000, 200_000_000, 20_000_000, 20_000_000, 0.9, 0.7),
        task=TaskParams(speed=0.5, goal_tolerance=math.radians(0.5)),
    )


@functools.cache
def make_system(tool: str = "drill") -> System:
    return System(make_params(tool))


def make_joint(q: Any, **changes: Any) -> JointState:
    n = len(q)
    return replace(JointState(0, 0, 0, vector(q), vector(np.zeros(n)), vector(np.zeros(n)), FINE, 0, True), **changes)


def make_human(p0: Any, p1: Any = None, radius: Any = 0.05, v: Any = (0.0, 0.0, 0.0), **changes: Any) -> HumanState:
    """People of one or more capsules; p1 None: points."""
    p0 = np.atleast_2d(np.asarray(p0, dtype=float)).reshape(-1, 3)
    p1 = p0 if p1 is None else np.atleast_2d(np.asarray(p1, dtype=float))
    m = len(p0)
    v = np.broadcast_to(np.asarray(v, dtype=float), (m, 3))
    made = HumanState(
        t_capture_ns=0,
        seq=1,
        sensor_id=1,
        calibration_hash=0,
        health=Health.OK,
        coverage=1.0,
        empty_certified=True,
        p0=vector(p0),
        p1=vector(p1),
        v0=vector(v),
        v1=vector(v),
        radius=vector(np.broadcast_to(radius, m)),
        position_bound=vector(np.zeros(m)),
        velocity_bound=vector(np.zeros(m)),
        visibility=np.zeros(m, dtype=np.int64),
    )
    return replace(made, **changes)


NOBODY = make_human(np.zeros((0, 3)), np.zeros((0, 3)))
FAR = make_human([5.0, 0.0, 0.5])


def make_inputs(joint: JointState | None, human: HumanState | None = FAR, tick: int = 0, **changes: Any) -> CycleInputs:
    """`human` as the only sensor sent it, unless `sensors` say otherwise."""
    age_ns = changes.get("human_age_ns", 30_000_000)
    sensors = heard(human, age_ns)
    made = CycleInputs(tick, tick * 8_000_000, 8_000_000, joint, human, age_ns, sensors, None, (), 0, False)
    return replace(made, **changes)


def make_report(**changes: Any) -> SensorReport:
    """Of a sensor of the bench that is in order."""
    return replace(heard(FAR, 30_000_000)[0], **changes)


def segment_distance(p0: Any, p1: Any, q0: Any, q1: Any) -> float:
    """Distance of two segments: the best of the interior point of the lines and the four end points, by least
    squares."""
    p0, p1, q0, q1 = (np.asarray(x, dtype=float) for x in (p0, p1, q0, q1))

    def to_point(x: Any, a: Any, b: Any) -> float:
        e = b - a
        s = 0.0 if e @ e == 0.0 else np.clip((x - a) @ e / (e @ e), 0.0, 1.0)
        return float(np.linalg.norm(x - a - s * e))

    best = min(to_point(p0, q0, q1), to_point(p1, q0, q1), to_point(q0, p0, p1), to_point(q1, p0, p1))
    A = np.column_stack((p1 - p0, q0 - q1))
    (s, t), *_, singular = np.linalg.lstsq(A, q0 - p0, rcond=None)
    if singular.min() > 1e-9 * max(singular.max(), 1e-12) and 0.0 <= s <= 1.0 and 0.0 <= t <= 1.0:
        best = min(best, float(np.linalg.norm(A @ (s, t) - (q0 - p0))))
    return best


def robot_capsules(system: System, q: Any) -> list[tuple[int, np.ndarray, np.ndarray, float]]:
    """(joint, p0, p1, radius) of every capsule in the base frame, placed by Pinocchio from the parameters' own
    figures."""
    model, params = system.model.pin_model, system.params
    data = model.createData()
    pin.framesForwardKinematics(model, data, np.asarray(q, dtype=float))
    found = []
    for spec in (*params.robot.capsules, *params.tool.capsules):
        frame = model.getFrameId(spec.link, pin.BODY)
        place = data.oMf[frame]
        joint = model.frames[frame].parentJoint - 1
        found.append((joint, place.act(np.array(spec.p0)), place.act(np.array(spec.p1)), spec.radius))
    return found


def true_distance(system: System, q: Any, human: HumanState) -> float:
    """Least separation distance of the moving links and the people as they are in `human`, bounds left aside."""
    return min(
        (
            segment_distance(p0, p1, human.p0[h], human.p1[h]) - radius - human.radius[h]
            for joint, p0, p1, radius in robot_capsules(system, q)
            if joint >= 0
            for h in range(len(human.radius))
        ),
        default=math.inf,
    )


def skew_arm() -> Params:
    """Four joints about odd axes, a locked one between them, a capsule on the root, one on a fixed link and one on a
    link."""
    joints = [
        ("a", "root", "l1", "0.1 -0.2 0.3", "0.3 -0.4 0.5", "1 2 -3"),
        ("b", "l1", "l2", "0.2 0.1 0", "1.2 0 -0.7", "0 1 1"),
        ("lock", "l2", "l3", "0 0.15 0.05", "0 0.9 0", "1 0 0"),
        ("c", "l3", "l4", "-0.1 0 0.25", "-0.5 0.2 0.1", "-1 0 2"),
        ("d", "l4", "l5", "0 0.2 -0.1", "0 0 2.0", "3 -1 1"),
    ]
    body = '<inertial><mass value="1"/><inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>'
    links = "".join(f'<link name="{name}">{body}</link>' for name in ("root", "l1", "l2", "l3", "l4", "l5", "tip"))
    turning = "".join(
        f'<joint name="{n}" type="revolute"><parent link="{p}"/><child link="{c}"/><origin xyz="{xyz}" rpy="{rpy}"/>'
        f'<axis xyz="{axis}"/><limit lower="-3" upper="3" velocity="3" effort="1"/></joint>'
        for n, p, c, xyz, rpy, axis in joints
    )
    tip = (
        '<joint name="e" type="fixed"><parent link="l5"/><child link="tip"/>'
        '<origin xyz="0.05 0.1 0.2" rpy="0.4 0 1"/></joint>'
    )
    four = (3.0, 3.0, 3.0, 3.0)
    robot = RobotParams(
        name="skew",
        urdf=f'<robot name="skew">{links}{turning}{tip}</robot>',
        joints=("a", "b", "c", "d"),
        flange="tip",
        q_min=(-3.0, -3.0, -3.0, -3.0),
        q_max=four,
        dq_max=four,
        ddq_max=(10.0, 10.0, 10.0, 10.0),
        dddq_max=(100.0, 100.0, 100.0, 100.0),
        effort=(),
        command_latency_ns=0,
        capsules=(
            CapsuleSpec("root", (0.0, 0.0, 0.0), (0.0, 0.0, 0.2), 0.1),
            CapsuleSpec("l3", (0.0, 0.02, 0.01), (0.1, 0.0, 0.2), 0.05),
            CapsuleSpec("tip", (0.0, 0.0, 0.1), (0.03, 0.1, 0.3), 0.04),
        ),
    )
    tool = ToolParams("none", 0.0, (0.0, 0.0, 0.0), (0.0,) * 6, ())
    return replace(make_params(), robot=robot, tool=tool)


@dataclass
class Cycle:
    """One cycle of a lockstep run, for the tests to look at."""

    before: CoreState
    x: CycleInputs
    state: CoreState
    out: CycleOutputs
    q_true: np.ndarray


People = Callable[[float], HumanState]  # true people at a time


class Rig:
    """Controller and arm in one thread. The arm is where the set-point was one command latency ago."""

    def __init__(
        self, system: System, people: People, start: Any = HOME, latency: float = 0.06, age: float = 0.03
    ) -> None:
        self.system, self.people, self.latency, self.age = system, people, latency, age
        self.state = initial(system)
        self.sent: deque[np.ndarray] = deque([np.array(start, dtype=float)] * 20, maxlen=20)
        self.tick = 0
        self.event = 0
        self.cycles: list[Cycle] = []

    def q_true(self) -> np.ndarray:
        back = self.latency / T
        i, share = int(back), back - int(back)
        return (1.0 - share) * self.sent[-1 - i] + share * self.sent[-2 - i]

    def arm(self) -> OperatorEvent:
        self.event += 1
        return OperatorEvent(self.event, EventKind.ARM)

    def cycle(self, events: tuple[OperatorEvent, ...] = (), goal: Goal | None = None, **changes: Any) -> Cycle:
        t = self.tick * T
        q = self.q_true()
        human = replace(self.people(t - self.age), t_capture_ns=round((t - self.age) * 1e9), seq=self.tick)
        x = make_inputs(
            make_joint(q, seq=self.tick),
            human,
            self.tick,
            human_age_ns=round(self.age * 1e9),
            events=events,
            goal=goal,
        )
        if {"human", "human_age_ns"} & changes.keys():
            seen = changes.get("human", human)
            changes.setdefault("sensors", heard(seen, changes.get("human_age_ns", x.human_age_ns)))
        x = replace(x, **changes)
        before = self.state
        self.state, out = step(self.system, before, x)
        self.sent.append(out.command.q if out.command else self.sent[-1])
        self.tick += 1
        self.cycles.append(Cycle(before, x, self.state, out, q))
        return self.cycles[-1]

    def run(self, seconds: float, goals: Any = GOALS, arm_again: bool = True) -> list[Cycle]:
        """Arm, work through the goals in turn, arm again half a second after every stop."""
        rest = 0
        for _ in range(round(seconds / T)):
            rest = rest + 1 if self.state.mode in (Mode.HOLD, Mode.STOPPED) else 0
            wanted = rest == 2 if self.state.mode is Mode.HOLD else rest > 60 and arm_again
            i = self.state.reached_id + 1
            self.cycle((self.arm(),) if wanted else (), Goal(i, vector(goals[i % len(goals)])))
            rest = 0 if rest > 60 else rest
        return self.cycles


@pytest.fixture(scope="session")
def bench() -> Any:
    """Everything above by name: with --import-mode=importlib the tests cannot import from here."""
    return _Names()


class _Names:
    T, HOME, GOALS, NOBODY, FAR, FINE = T, HOME, GOALS, NOBODY, FAR, FINE
    params, system = staticmethod(make_params), staticmethod(make_system)
    joint, human, inputs = staticmethod(make_joint), staticmethod(make_human), staticmethod(make_inputs)
    report = staticmethod(make_report)
    segment_distance, true_distance = staticmethod(segment_distance), staticmethod(true_distance)
    robot_capsules = staticmethod(robot_capsules)
    skew_arm = staticmethod(skew_arm)
    Rig = Rig
