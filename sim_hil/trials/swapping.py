"""Trials on an arm whose tool is changed: who holds which tool, and what other ways there are to keep people safe.

Policies on the same draws:
asc               the filter with the tool that is really there
enclosing-sphere  the same filter that hears a number which nobody knows, and takes the tool for the cell's enclosing
                  sphere: the paper's baseline
ssm-stop          no filter: stop below the protective separation distance of ISO/TS 15066, go on above it
none              nobody looks
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asc_rt.core.abstraction import People, least_distance
from asc_rt.core.params import MonitorParams, ToolParams
from asc_rt.core.separation_monitor import greatest_speed, protective_distance, stopping_time
from asc_rt.core.system import System
from asc_rt.core.types import CoreState, CycleInputs, EventKind, Mode, OperatorEvent
from sim_hil.person import Array, Capsules, Person
from sim_hil.plant import MujocoPlant
from sim_hil.trials.sensing import Sensor

REST = 0.5  # s at rest, and far enough, before it is armed again
STEP = 0.02  # s between looks at the script of a person
DRAWS, GOAL_DRAWS = 200, 20  # people; poses around a goal


class Stands:
    """A person who stands there and reaches to where the arm works: a posture that a seeded person takes when reaching
    in."""

    def __init__(self, seed: int) -> None:
        person, t = Person(seed), 0.0
        while person.phase(t).name != "hold":
            t += STEP
        people = person.at(t)
        self._people = people._replace(v0=np.zeros_like(people.v0), v1=np.zeros_like(people.v1))

    def at(self, t: float) -> Capsules:
        return self._people


@dataclass(frozen=True, slots=True)
class Workplace:
    """Somebody who stands there, and work for the arm that is free of them."""

    person: Stands
    goals: Array  # (g, n) rad


def workplace(
    rng: np.random.Generator, plants: Sequence[MujocoPlant], largest: MujocoPlant, goals: Array, spread: float,
    clearance: float, free: float, near: float,
) -> Workplace:  # fmt: skip
    """A person at least `clearance` from the `largest` arm at the first of `goals`, and within `spread` of each of them
    a pose at least `free` from the person with every tool that comes; a goal without one is left out. At one of them at
    least some tool itself is no more than `near` from the person. RuntimeError: none of DRAWS people is like that.
    """
    for _ in range(DRAWS):
        person = Stands(int(rng.integers(2**31)))
        if _room([largest], goals[0], person)[0] < clearance:
            continue
        around = [goal + rng.uniform(-spread, spread, (GOAL_DRAWS, len(goal))) for goal in goals]
        found = [[(q, *_room(plants, q, person)) for q in drawn] for drawn in around]
        left = [next((pose for pose in poses if pose[1] >= free), None) for poses in found]
        kept = [pose for pose in left if pose is not None]
        if len(kept) >= 2 and min(of_tool for _, _, of_tool in kept) <= near:
            return Workplace(person, np.array([q for q, _, _ in kept]))
    raise RuntimeError(f"none of {DRAWS} people leaves two goals {free:g} m free, the tool at one within {near:g} m")


def _room(plants: Sequence[MujocoPlant], q: Array, person: Stands) -> tuple[float, float]:
    """Least distance of the arm, whichever of the plants it is, and the least of their tools."""
    for plant in plants:
        plant.reset(q)
        plant.set_person(person.at(0.0))
    return min(plant.distance().distance for plant in plants), min(plant.tool_distance() for plant in plants)


class Swaps:
    """The tools that come after the first: each at its time or later, as soon as it is `clearance` from everybody (a
    tool cannot be mounted where a person is)."""

    def __init__(
        self,
        mounts: Sequence[tuple[int, ToolParams]],
        times: Sequence[float],
        clearance: float,
        says: int | None = None,
    ) -> None:
        """`says`: what is told instead of the true number."""
        self._mounts, self._times, self._clearance, self._says = mounts, times, clearance, says
        self._mounted = 0

    def number(self, t: float, plant: MujocoPlant) -> int:
        """What the changer tells now; may make the plant carry the next tool."""
        waits = self._mounted + 1 < len(self._mounts)
        if waits and t >= self._times[self._mounted]:
            plant.carry(self._mounts[self._mounted + 1][1])
            if plant.distance().distance >= self._clearance:
                self._mounted += 1
            else:
                plant.carry(self._mounts[self._mounted][1])
        return self._mounts[self._mounted][0] if self._says is None else self._says


class Monitor:
    """The operator of a cell without a filter: stops the arm below S_p, arms it REST after S_p is kept again.

    S_p is of the arm's speed of the moment; to go on, of the greatest speed that the arm had since it was armed: at
    rest S_p is shorter, and the arm would start into the next stop.
    """

    def __init__(self, system: System, sensor: Sensor) -> None:
        self._system, self._sensor = system, sensor
        self._monitor = MonitorParams()
        self._fastest = self._rested = 0.0
        self._id = 0

    def events(self, state: CoreState, x: CycleInputs) -> tuple[OperatorEvent, ...]:
        seen, system = self._sensor.at(x.t_ns * 1e-9), self._system.holding(state.tool)
        if seen is None or x.joint is None:
            return ()
        human, age = seen
        speed = greatest_speed(system.model.chain, system.model.capsules, x.joint.q, x.joint.dq)
        is_active = state.mode is Mode.ACTIVE
        self._fastest = max(self._fastest, speed) if is_active else self._fastest
        dq = np.abs(state.dq_cmd) if is_active else system.params.task.speed * system.bounds.dq_max
        needed = protective_distance(
            self._monitor,
            speed if is_active else self._fastest,
            age,
            system.params.robot.command_latency_ns * 1e-9 + system.params.period,
            stopping_time(dq, system.bounds.ddq_max, system.bounds.dddq_max),
            float(np.max(human.position_bound, initial=0.0)),
        ).S_p
        people = People(human.p0, human.p1, human.v0, human.v1, human.radius, human.velocity_bound)
        d = least_distance(system.model.chain, system.model.capsules, people, x.joint.q)
        self._rested = self._rested + system.params.period if not is_active and d >= needed else 0.0
        if is_active and d < needed:
            return self._say(EventKind.STOP)
        waits = state.mode in (Mode.HOLD, Mode.STOPPED)
        if waits and (self._rested >= REST or (self._id == 0 and d >= needed)):
            self._fastest = self._rested = 0.0
            return self._say(EventKind.ARM)
        return ()

    def _say(self, kind: EventKind) -> tuple[OperatorEvent, ...]:
        self._id += 1
        return (OperatorEvent(self._id, kind),)


def swap_times(rng: np.random.Generator, seconds: float, count: int) -> list[float]:
    """One within each share of the middle of the trial, s."""
    edges = np.linspace(0.25, 0.85, count + 1) * seconds
    return [float(t) for t in rng.uniform(edges[:-1], edges[1:])]
