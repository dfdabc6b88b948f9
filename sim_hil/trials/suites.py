"""The suites: which systems, which worlds, and how one numbered trial of them is run.

table1        five Panda systems by torque, a goal behind a ball that stands still
transfer      the same with the index of panda+ee1, unchanged, on tools and arms that it was not made for
moving-human  an LR Mate at work while people walk in and reach; they are seen late and inexactly
and those that are files, see suite_files: tool-swap

Policies: `asc`, and `none`: the same draws, arm and reference, with a controller that is told that nobody is there.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from asc_rt.config import ConfigError
from asc_rt.core.system import System
from asc_rt.core.warm import warm_up
from sim_hil.person import Person
from sim_hil.trials import episode, file_trials, suite_files
from sim_hil.trials.cell_systems import CellSystem
from sim_hil.trials.episode import Setup
from sim_hil.trials.judge import Outcome
from sim_hil.trials.planner import Planner
from sim_hil.trials.recorder import Recorder
from sim_hil.trials.scenarios import goal_and_obstacle, rng_of
from sim_hil.trials.sensing import Blind, Camera, Perfect, Quality
from sim_hil.trials.suite_files import FOLDER, SPHERE, SuiteFile
from sim_hil.trials.systems import TrialSystem
from sim_hil.trials.tasks import Rounds, Visit

POLICIES = ("asc", "none")

# Chosen by measurement, on 16 draws of panda+ee1 (nearest approach, median time to the goal): k = 0.3: 49.6 mm, 3.29 s;
# 0.6: 49.6 mm, 3.44 s; 1: 50.2 mm, 3.59 s; 2: 52.6 mm, 3.78 s. Under 1 the sampled control gets 0.4 mm inside d_min.
K_TORQUE = 2.0
K_PERSON = 3.0  # of the cell fanuc-sim-truth

WAY_CLEARANCE = 0.02  # m more than d_min, of the ways that the planner offers
SEARCH = 4000  # branches: without a way after these there is none
SECONDS, SECONDS_UNFILTERED = 20.0, 8.0  # of one goal
PERSON_SECONDS = 16.0  # most of one visit

# ASSUMED: a depth camera with skeleton tracking.
CAMERA = Quality(
    rate=30.0,
    latency=(0.060, 0.100),
    position_noise=0.015,
    velocity_noise=0.10,
    position_bound=0.04,
    velocity_bound=0.4,
)
LRMATE_GOALS = np.radians(
    [[-60, 5, 0, 0, -85, 0], [0, 30, 20, 0, -80, 0], [60, 5, 0, 0, -85, 0], [0, 5, 10, 0, -75, 0]]
)


@dataclass(frozen=True, slots=True)
class Suite:
    systems: tuple[TrialSystem | CellSystem, ...]
    is_moving: bool  # the world
    trials: int  # by default
    policies: tuple[str, ...] = POLICIES
    is_transfer: bool = False  # the index is carried to systems that it may not cover: see `transfer`
    file: SuiteFile | None = None  # of a suite that is one


@dataclass(frozen=True, slots=True)
class Job:
    """One trial: with the code it determines the outcome."""

    suite: str
    system: int  # index
    policy: str
    trial: int
    seed: int


def _streaming(robot: str, tool: str) -> TrialSystem:
    return TrialSystem(robot, tool, K_TORQUE, control="acceleration", activation=1.0)


TABLE1 = tuple(
    TrialSystem(robot, tool, K_TORQUE)
    for robot, tool in [
        ("panda_5dof", "ee1"),
        ("panda_6dof", "ee1"),
        ("panda", "ee1"),
        ("panda", "ee2"),
        ("panda_ee3", "ee1"),
    ]
)
TRANSFER = (
    *(TrialSystem("panda", tool, K_TORQUE) for tool in ("ee1", "ee2", "drill", "bat")),
    *(TrialSystem("ur5e", tool, K_TORQUE) for tool in ("ee1", "drill")),
    *(_streaming("lrmate_200id", tool) for tool in ("ee1", "drill", "bat")),
    _streaming("lrmate_200id_7l", "drill"),
    _streaming("crx_10ia_l", "drill"),
)
MOVING_HUMAN = (
    TrialSystem(
        "lrmate_200id", "drill", K_PERSON, "acceleration", 0.1, activation=1.0, human_acceleration=3.0, v_max=2.0
    ),
)
SUITES = {
    "table1": Suite(TABLE1, is_moving=False, trials=100),
    "transfer": Suite(TRANSFER, is_moving=False, trials=20, is_transfer=True),
    "moving-human": Suite(MOVING_HUMAN, is_moving=True, trials=100),
}


def find(name: str) -> Suite:
    """By its name, or by its file. ConfigError: what is wrong with the file; KeyError: there is no such suite."""
    if name in SUITES:
        return SUITES[name]
    path = Path(name) if name.endswith(".toml") else FOLDER / f"{name}.toml"
    if not name.endswith(".toml") and not path.is_file():
        raise KeyError(name)
    return _of_file(path)


@lru_cache(maxsize=4)
def _of_file(path: Path) -> Suite:
    f = suite_files.load(path)
    systems = tuple(CellSystem(s.cell, tuple(s.tools), tuple(map(tuple, s.goals_deg)), tuple(f.set)) for s in f.systems)
    lines = [f"{path}: systems[{i}]: {line}" for i, s in enumerate(systems) for line in s.faults(SPHERE in f.policies)]
    if f.person == "live":
        lines.append(f"{path}: person: nobody is live in simulation; stands, visits or roams (live: asc trials ladder)")
    if lines:
        raise ConfigError(lines)
    return Suite(systems, is_moving=True, trials=f.trials, policies=tuple(f.policies), file=f)


def names() -> list[str]:
    return [*SUITES, *sorted(path.stem for path in FOLDER.glob("*.toml"))]


def run(job: Job, folder: Path | None = None) -> Outcome:
    """One trial; with a folder it is recorded there, in place of an earlier recording of the same trial."""
    suite = find(job.suite)
    trial_system = suite.systems[job.system]
    if suite.file is not None:
        assert isinstance(trial_system, CellSystem)
        setup, is_reachable = file_trials.setup(suite.file, trial_system, job.policy, job.trial, job.seed), _always
    else:
        assert isinstance(trial_system, TrialSystem)
        setup, is_reachable = (_with_person if suite.is_moving else _around_a_ball)(trial_system, job)
    outcome = _played(setup, job, trial_system, folder)
    return outcome if outcome.reached else dataclasses.replace(outcome, reachable=is_reachable())


def _played(setup: Setup, job: Job, trial_system: TrialSystem | CellSystem, folder: Path | None) -> Outcome:
    if folder is None:
        return episode.run(setup)
    path = folder / f"{Path(job.suite).stem}-{trial_system.name}-{job.policy}-{job.seed}-{job.trial}.mcap"
    path.unlink(missing_ok=True)
    about = {key: str(value) for key, value in dataclasses.asdict(job).items()}
    recorder = Recorder(path, setup.system.params, about)
    outcome = episode.run(setup, recorder)
    recorder.close(outcome.end)
    return outcome


@lru_cache(maxsize=4)
def _system(trial_system: TrialSystem) -> System:
    system = System(trial_system.params())
    warm_up(system)
    return system


def _around_a_ball(trial_system: TrialSystem, job: Job) -> tuple[Setup, Callable[[], bool]]:
    system = _system(trial_system)
    drawn = goal_and_obstacle(system, trial_system.home, rng_of(job.seed, trial_system.name, job.trial))
    scene = (system, drawn.q0, drawn.ball)
    if job.policy == "none":
        task = Visit(drawn.goal, None, rng_of(0, "", 0))
        return Setup(*scene, Blind(), task, SECONDS_UNFILTERED, is_moving=False, ends_at_contact=True), _always
    planner = Planner(system, drawn.ball.at(0.0), trial_system.d_min + WAY_CLEARANCE)
    task = Visit(drawn.goal, planner, rng_of(job.seed, trial_system.name, job.trial, 1))
    setup = Setup(*scene, Perfect(drawn.ball), task, SECONDS, is_moving=False, ends_at_contact=True)

    def is_reachable() -> bool:
        rng = rng_of(job.seed, trial_system.name, job.trial, 2)
        return planner.plan(drawn.q0, drawn.goal, rng, SEARCH) is not None

    return setup, is_reachable


def _with_person(trial_system: TrialSystem, job: Job) -> tuple[Setup, Callable[[], bool]]:
    system = _system(trial_system)
    seed = int(rng_of(job.seed, trial_system.name, job.trial).integers(2**31))
    person = Person(seed)
    sensor = Blind() if job.policy == "none" else Camera(person, CAMERA, seed)
    scene = (system, LRMATE_GOALS[0], person)
    task = Rounds(LRMATE_GOALS)
    return Setup(*scene, sensor, task, PERSON_SECONDS, is_moving=True, ends_at_contact=False), _always


def _always() -> bool:
    return True
