"""The cell that sees, in lockstep: true arm and person, simulated cameras, perception, control; a function of the seed.

Everything between the rays and the set-point is the product's own code (`perception.Sensor`, `Mail`, `step`); only the
wire of the cameras and the processes are left out. For campaigns (`python -m sim_hil seeing --cell`) and for the fault
table of the cameras.
"""

from __future__ import annotations

import dataclasses
import time
from collections import deque
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from asc_rt.cell_cameras import PerceptionOptions
from asc_rt.config import load_cell
from asc_rt.core.step import step
from asc_rt.core.system import System, initial
from asc_rt.core.types import CoreState, CycleInputs, Goal, JointState, Mode, RobotFlag, StopReason, vector
from asc_rt.human_codec import clock_id
from asc_rt.inputs import Mail, freeze
from asc_rt.pacing import DevicePaced
from asc_rt.perception.cameras import grid_of, pose_bound
from asc_rt.perception.eye import CameraInfo, DepthFrame, Eye
from asc_rt.perception.grid import View
from asc_rt.perception.observer import Observer
from asc_rt.perception.sensor import Identity, Sensor, around
from asc_rt.perception.stance import Stance
from sim_hil import depth
from sim_hil.camera import true_pose
from sim_hil.camera_faults import Fault, struck
from sim_hil.depth import UNIT, Optics, Scene
from sim_hil.person import Array, Capsules
from sim_hil.plant import MujocoPlant
from sim_hil.roamer import Roamer
from sim_hil.seeing import lens_of
from sim_hil.trials.episode import Arm, Armer
from sim_hil.trials.judge import Judge, Outcome

CELL = "fanuc-sim"
START_NS = 10**12
BATCH_NS = 24_000_000  # of joints, from the logger
LEAST_LATENCY_NS = 20_000_000  # as the cameras declare it
LATENCY = (0.020, 0.045)  # s, mid-exposure to the message, drawn per capture: camera, wire, perception


class Somebody(Protocol):
    def at(self, t: float) -> Capsules: ...


@dataclass(frozen=True, slots=True)
class Story:
    """What happened, beside what the judge says."""

    outcome: Outcome
    reasons: tuple[StopReason, ...]  # of all stops and slow-downs, in order
    latency_ns: Array  # photon to command, of each cycle with a command while it works
    perception_s: float  # CPU
    control_s: float
    rest_after: float  # s from the first fault of the script until the arm stands; nan: it never does
    mode: Mode


class Cell:
    """`run` once. Where cameras and person really are is the simulator's; what the cell believes its files say."""

    def __init__(
        self, seed: int, optics: Optics | None = None, person: Somebody | None = None, script: tuple[Fault, ...] = (),
        overrides: tuple[str, ...] = (),
    ) -> None:  # fmt: skip
        config = load_cell(CELL, overrides)
        assert config.perception is not None
        self.system, self._goals = System(config.params), config.goals
        self._person, self._script = person or Roamer(seed), script
        self._studio = Studio(config.params, config.perception, config.sim["camera"], optics or Optics(), seed, script)
        self.sensor = self._studio.sensor(self.system, config.params.human.sensors[0].id)

    def run(self, seconds: float) -> Story:
        system, period_ns = self.system, self.system.params.period_ns
        plant = MujocoPlant(system.params, np.array(self._goals[-1]))
        arm, operator, judge, told = Arm(plant, system), Armer(period_ns * 1e-9), Judge(system, plant), _Told()
        box, state = Box(), initial(system)
        mail = Mail({1: box}, Nothing(), Nothing(), joints=system.n)
        pacer = DevicePaced(period_ns, lambda: START_NS)
        k = 0
        for k in range(round(seconds * 1e9 / period_ns)):
            t, now_ns = k * period_ns * 1e-9, START_NS + k * period_ns
            person = self._person.at(t)
            plant.set_person(person)
            judge.look(t)
            self._studio.look(t, now_ns, plant.q, person)
            begin = time.process_time()
            box.newest = self._perceive(t, now_ns) or box.newest
            seen = time.process_time()
            x = self._inputs(mail, pacer, now_ns, plant, state, k)
            before, x = state, dataclasses.replace(x, events=operator.events(state, x))
            state, out = step(system, state, x)
            told.spend(seen - begin, time.process_time() - seen)
            judge.note(t, before, state, out)
            told.note(t, state, x, min((fault.at_s for fault in self._script), default=np.inf))
            if out.command is None:
                break
            arm.send(out.command)
            plant.step()
        outcome = judge.outcome(k * period_ns * 1e-9, k, state, state.reached_id, reachable=True)
        spent, latency = (told.perception, told.control), np.array(told.latency)
        return Story(outcome, tuple(told.reasons), latency, *spent, told.rest_after, state.mode)

    def _perceive(self, t: float, now_ns: int) -> bytes | None:
        """The newest message of now. A killed process says nothing."""
        for t_ns, q in self._studio.joints(t, now_ns):
            self.sensor.joints.add(t_ns, q)
        messages = [m for frames in self._studio.arrived(now_ns) for m in self.sensor.take(frames, now_ns)]
        messages += self.sensor.wait(now_ns)
        return messages[-1] if messages and not is_struck(self._script, "killed", t) else None

    def _inputs(
        self, mail: Mail, pacer: DevicePaced, t_ns: int, plant: MujocoPlant, state: CoreState, k: int
    ) -> CycleInputs:
        q, dq, none = vector(plant.q), vector(plant.dq), vector(np.zeros(self.system.n))
        joint = JointState(t_ns, t_ns, k, q, dq, none, RobotFlag.READY | RobotFlag.SERVO_ON, 0, False)
        x = freeze(k, self.system.params.period_ns, joint, mail, lambda: t_ns, pacer)
        goal = Goal(state.reached_id + 1, vector(self._goals[state.reached_id % len(self._goals)]))
        return dataclasses.replace(x, goal=goal)


class Studio:
    """The true cameras before the true scene, and what is on its way from them."""

    def __init__(
        self, params: Any, options: PerceptionOptions, table: dict[str, Any], optics: Optics, seed: int,
        script: tuple[Fault, ...],
    ) -> None:  # fmt: skip
        self._options, self._optics, self._script = options, optics, script
        self._scene, self._rate = Scene(params), float(table["rate_hz"])
        self._eyes = {
            camera.name: depth.Eye(self._scene, true_pose(table[camera.name]), optics, seed + i)
            for i, camera in enumerate(options.cameras)
        }
        self._rng = np.random.default_rng([seed, 9])
        self._kept: dict[str, Any] = {}  # the picture of a frozen camera
        self._seq, self._due, self._batch_ns = 0, 0.0, 0
        self._frames: deque[tuple[int, dict[int, DepthFrame]]] = deque()
        self._joints: list[tuple[int, Array]] = []

    def sensor(self, system: System, number: int) -> Sensor:
        """Perception as the cell's files describe these cameras."""
        options, lens, grid = self._options, lens_of(self._optics), grid_of(self._options)
        views = [View(lens, UNIT, c.pose.pose(), self._eyes[c.name].empty(), grid) for c in options.cameras]
        info = CameraInfo("simulated", "", "1", lens, UNIT, round(1e9 / self._rate), LEAST_LATENCY_NS)
        stances = [Stance(view, grid.corners()) for view in views]
        eyes = [Eye(c.name, info, v, 0, s) for c, v, s in zip(options.cameras, views, stances, strict=True)]
        bounds = [pose_bound(camera.pose, grid) for camera in options.cameras]
        observer = Observer(system.model, grid, views, bounds, options.margin)
        least = around(system.params.safety.activation_distance)
        identity = Identity(number, options.digest, options.margin, options.detection, least)
        return Sensor(identity, eyes, observer, clock_id, lambda t_ns: (t_ns, 0))

    def look(self, t: float, now_ns: int, q: Array, person: Capsules) -> None:
        """The arm is at `q` at time t; a capture of all cameras when one is due."""
        self._joints.append((now_ns, q))
        if t < self._due - 1e-9:
            return
        self._due += 1.0 / self._rate
        self._seq += 1
        self._scene.pose(q)
        self._scene.set_person(person)
        arrival_ns, frames = now_ns + round(1e9 * self._rng.uniform(*LATENCY)), {}
        for i, (name, wrong, moved) in enumerate(struck(self._script, list(self._eyes), t)):
            eye = self._eyes[name]
            eye.move(moved)
            picture = eye.sense() * (not wrong.cover)
            picture = self._kept.get(name, picture) if wrong.freeze else picture
            self._kept[name] = picture
            if not wrong.silent:
                stamp = now_ns + wrong.clock_ns
                frames[i] = DepthFrame(picture, stamp, 0, stamp, arrival_ns, self._seq)
        self._frames.append((arrival_ns, frames))

    def arrived(self, now_ns: int) -> list[dict[int, DepthFrame]]:
        arrived = []
        while self._frames and self._frames[0][0] <= now_ns:
            arrived.append(self._frames.popleft()[1])
        return [frames for frames in arrived if frames]

    def joints(self, t: float, now_ns: int) -> list[tuple[int, Array]]:
        """The batch that the logger sends now; [] between two."""
        if now_ns < self._batch_ns:
            return []
        self._batch_ns = now_ns + BATCH_NS
        batch, self._joints = self._joints, []
        return [] if is_struck(self._script, "no_joints", t) else batch


def is_struck(script: tuple[Fault, ...], fault: str, t: float) -> bool:
    return any(one.fault == fault and one.at_s <= t < one.at_s + one.for_s for one in script)


@dataclass
class Box:
    """A mailbox of the bus: the newest message."""

    newest: bytes | None = None

    def take(self) -> bytes | None:
        data, self.newest = self.newest, None
        return data


class Nothing:
    def take(self) -> bytes | None:
        return None


@dataclass
class _Told:
    reasons: list[StopReason] = field(default_factory=list)
    latency: list[int] = field(default_factory=list)
    rest_after: float = float("nan")
    perception: float = 0.0
    control: float = 0.0

    def spend(self, perception: float, control: float) -> None:
        self.perception += perception
        self.control += control

    def note(self, t: float, state: CoreState, x: CycleInputs, fault_at: float) -> None:
        for reason in (state.reason, state.slow):
            if reason is not StopReason.NONE and reason not in self.reasons[-2:]:
                self.reasons.append(reason)
        if state.mode is Mode.ACTIVE:
            self.latency.append(x.human_age_ns)
        if t >= fault_at and np.isnan(self.rest_after) and not np.any(state.dq_cmd):
            self.rest_after = t - fault_at
