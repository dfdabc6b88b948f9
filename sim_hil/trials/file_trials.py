"""One trial of a suite that is a file: who stands where, what the controller is told, who changes the tool."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from asc_rt.core.system import System
from asc_rt.core.warm import warm_up
from sim_hil.person import Array, Person
from sim_hil.plant import MujocoPlant
from sim_hil.roamer import Roamer
from sim_hil.trials.cell_systems import NOBODY_KNOWS, CellSystem
from sim_hil.trials.episode import Setup
from sim_hil.trials.scenarios import rng_of
from sim_hil.trials.sensing import Blind, Camera, Quality, World
from sim_hil.trials.suite_files import SPHERE, Seen, SuiteFile
from sim_hil.trials.swapping import Monitor, Swaps, swap_times, workplace
from sim_hil.trials.tasks import Shift

WATCHING = ("asc", SPHERE)  # policies with the filter


def setup(f: SuiteFile, of: CellSystem, policy: str, trial: int, seed: int) -> Setup:
    """The draws are the same for every policy."""
    system, rng, mounts = _system(of), rng_of(seed, of.name, trial), of.mounts()
    person, goals = _scene(f, of, rng)
    camera = Camera(person, _quality(f.seen), int(rng.integers(2**31)))
    times = swap_times(rng, f.seconds, max(1, len(mounts) - 1))
    return Setup(
        system,
        of.goals[0],
        person,
        camera if policy in WATCHING else Blind(),
        Shift(goals, f.patience_s),
        f.seconds,
        is_moving=f.person != "stands",
        ends_at_contact=False,
        carried=mounts[0][1],
        changer=Swaps(mounts, times, f.free_m, NOBODY_KNOWS if policy == SPHERE else None),
        operator=Monitor(system, camera) if policy == "ssm-stop" else None,
    )


@lru_cache(maxsize=16)
def _system(of: CellSystem) -> System:
    system = System(of.params())
    warm_up(system)
    return system


def _scene(f: SuiteFile, of: CellSystem, rng: np.random.Generator) -> tuple[World, Array]:
    if f.person == "stands":
        plants = [_plant(of, name) for name in of.tools]
        spread = float(np.radians(f.spread_deg))
        place = workplace(rng, plants, _plant(of, SPHERE), of.goals, spread, f.clearance_m, f.free_m, f.near_m)
        return place.person, place.goals
    kind = Person if f.person == "visits" else Roamer
    return kind(int(rng.integers(2**31))), of.goals


@lru_cache(maxsize=32)
def _plant(of: CellSystem, tool: str) -> MujocoPlant:
    """The arm with this tool; the enclosing sphere, where the cell has none, is the first tool."""
    plant, mounts = MujocoPlant(of.params().holding(0)), of.mounts()
    carried = of.sphere() if tool == SPHERE else next(t for _, t in mounts if t.name == tool or len(mounts) == 1)
    plant.carry(carried or mounts[0][1])
    return plant


def _quality(s: Seen) -> Quality:
    low, high = s.latency_ms
    return Quality(
        rate=s.rate_hz,
        latency=(1e-3 * low, 1e-3 * high),
        position_noise=s.position_noise_m,
        velocity_noise=s.velocity_noise_m_s,
        position_bound=s.position_bound_m,
        velocity_bound=s.velocity_bound_m_s,
    )
