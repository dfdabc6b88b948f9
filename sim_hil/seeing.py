"""Perception judged by the truth: random episodes before two cameras, offline and faster than real time.

    python -m sim_hil seeing -n 200

Claim: at capture, the distance from the robot to the capsules, less their stated position bound, is never more than the
true one while that is above 0.1 m. Distances of both by MuJoCo.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from tqdm import tqdm

from asc_rt.config import load_cell
from asc_rt.core.system import System
from asc_rt.perception.grid import Grid, Intrinsics, View
from asc_rt.perception.observer import Observer, Seen
from calibration.geometry import look_at
from sim_hil.depth import UNIT, Eye, Optics, Scene
from sim_hil.person import Array, Capsules
from sim_hil.roamer import Roamer

PERIOD = 1 / 15  # s between captures
SECONDS, EMPTY_SECONDS = 5.0, 60.0  # of an episode with a person; without
START = 2.0  # s of each person's script, in which they only come nearer, are left out
LEAST_TRUE = 0.1  # m: nearer, the shell around the robot is blind
HORIZON = 0.1  # s: what control makes of a message so much later
NEAR = 1.0  # m: where distances matter (the cells' activation distance)
EYES = ((0.3, 2.4, 2.6), (1.9, -1.6, 2.6))  # m: neither opposite nor beside each other, so that shadows seldom meet
TARGET = (0.15, 0.0, -0.1)
VOLUME = ((-1.45, -1.9, -0.45), (1.9, 1.9, 1.15))  # m: 1.2 m around all that `arm_at` does
VOXEL = 0.05  # m
RODS = 10  # of each width at each distance


@dataclass
class Studio:
    """The cell before its cameras, and what perception makes of it."""

    scene: Scene
    judge: Scene  # holds what perception says, for the distance
    eyes: list[Eye]
    system: System
    views: list[View]
    grid: Grid

    def observer(self) -> Observer:
        return Observer(self.system.model, self.grid, self.views, [0.0] * len(self.views))


def lens_of(optics: Optics) -> Intrinsics:
    return Intrinsics(optics.width, optics.height, optics.fx, optics.fy, optics.cx, optics.cy)


@lru_cache(maxsize=1)
def studio() -> Studio:
    params, optics = load_cell("fanuc-sim-truth").params, Optics()
    scene, poses = Scene(params), [look_at(eye, TARGET) for eye in EYES]
    eyes = [Eye(scene, pose, optics, i) for i, pose in enumerate(poses)]
    grid = Grid.over(np.array(VOLUME[0]), np.array(VOLUME[1]), VOXEL)
    views = [View(lens_of(optics), UNIT, pose, eye.empty(), grid) for pose, eye in zip(poses, eyes, strict=True)]
    return Studio(scene, Scene(params), eyes, System(params), views, grid)


@dataclass(frozen=True, slots=True)
class Look:
    """One capture. Distances in m."""

    true: float
    told: float  # to the capsules, without their bound; inf: none
    true_later: float  # HORIZON after the capture
    told_later: float  # to the capsules as control grows and moves them, less all bounds
    bound: float
    cpu: float  # s of perception


def arm_at(seed: int, t: float) -> Array:
    """Joint angles of an arm that is always at work: from rest to rest between random poses, 2 s each."""
    leg, share = int(t // 2.0), (t % 2.0) / 2.0
    low, high = np.radians([-80, -10, -10, -30, -100, -60]), np.radians([80, 45, 25, 30, -50, 60])
    a, b = (np.random.default_rng((seed, leg + i)).uniform(low, high) for i in (0, 1))
    return np.asarray(a + (b - a) * share**3 * (10 - 15 * share + 6 * share**2))


def episode(seed: int, seconds: float = SECONDS, people: bool = True) -> list[Look]:
    """A pure function of the seed."""
    s = studio()
    for eye in s.eyes:
        eye.reseed(seed)
    person, observer, looks = Roamer(seed), s.observer(), []
    for k in range(round(seconds / PERIOD)):
        t = START + k * PERIOD
        q = arm_at(seed, t)
        s.scene.pose(q)
        s.scene.set_person(person.at(t) if people else _NOBODY)
        depths, begin = [eye.sense() for eye in s.eyes], time.process_time()
        seen = observer.observe(round(t * 1e9), depths, q)
        cpu = time.process_time() - begin
        true, told = s.scene.distance().distance, _distance(s, q, seen, 0.0)
        later = arm_at(seed, t + HORIZON)
        s.scene.pose(later)
        s.scene.set_person(person.at(t + HORIZON) if people else _NOBODY)
        looks.append(
            Look(true, told, s.scene.distance().distance, _distance(s, later, seen, HORIZON), seen.position_bound, cpu)
        )
    return looks


_NOBODY = Capsules((), *(np.zeros((0, 3)),) * 2, np.zeros(0), *(np.zeros((0, 3)),) * 2)


def _distance(s: Studio, q: Array, seen: Seen, horizon: float) -> float:
    """To the capsules; with a horizon moved and grown as `core.people.predict` does."""
    p = seen.parts
    if not len(p.radius):
        return float("inf")
    move = horizon * p.velocity
    grown = p.radius + (seen.position_bound + horizon * p.velocity_bound if horizon else 0.0)
    labels = tuple(str(i) for i in range(len(grown)))
    s.judge.pose(q)
    s.judge.set_person(Capsules(labels, p.p0 + move, p.p1 + move, grown, p.velocity, p.velocity))
    return s.judge.distance().distance


def table(looks: list[Look], empty: list[list[Look]]) -> dict[str, Any]:
    """What the campaign found. `empty`: episodes in which nobody was there."""
    true, told, bound = (np.array([getattr(x, name) for x in looks]) for name in ("true", "told", "bound"))
    counts = (true > LEAST_TRUE) & (true < NEAR)
    over = told[counts] - true[counts]
    later = np.array([[x.true_later, x.told_later] for x in looks])
    soon = (later[:, 0] > LEAST_TRUE) & (later[:, 0] < NEAR)
    hours = sum(map(len, empty)) * PERIOD / 3600
    return {
        "captures": len(looks),
        "judged": int(counts.sum()),
        "over_bound": int((over > bound[counts]).sum()),
        "worst_over_m": round(float(over.max()), 4),
        "bound_m": round(float(bound.max()), 4),
        "median_under_m": round(float(np.median(-over)), 4),
        "p95_under_m": round(float(np.quantile(-over, 0.95)), 4),
        "over_later": int((later[soon, 1] > later[soon, 0]).sum()),
        "worst_over_later_m": round(float((later[soon, 1] - later[soon, 0]).max()), 4),
        "empty_hours": round(hours, 3),
        "false_stops": sum(map(_stops, empty)),
        "starts_refused": sum(episode[0].told < NEAR for episode in empty),
        "cpu_ms_median": round(float(np.median([x.cpu for x in looks])) * 1e3, 2),
    }


def is_over(look: Look) -> bool:
    """Somebody near is told to be farther away than they may be, at the capture or HORIZON later."""
    now = LEAST_TRUE < look.true < NEAR and look.told - look.true > look.bound
    later = LEAST_TRUE < look.true_later < NEAR and look.told_later > look.true_later
    return now or later


def _stops(empty: list[Look]) -> int:
    """How often, nobody being there, something seems near: each time it begins. An episode that begins so is no stop
    but a start refused: the arm stands, and may not be armed before it has shown what it hides."""
    near = [look.told < NEAR for look in empty]
    return sum(now and not before for before, now in zip(near, near[1:], strict=False))


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m sim_hil seeing", description="Perception judged by the truth.")
    parser.add_argument("-n", type=int, default=200, help="episodes with a person; an eighth more without")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--cell", action="store_true", help="the whole cell that sees, in lockstep, instead")
    parser.add_argument("--seconds", type=float, default=10.0, help="with --cell: of an episode")
    parser.add_argument(
        "--faults", action="store_true", help="what the running cell does when its cameras fail, instead"
    )
    parser.add_argument("--rods", action="store_true", help="the detection of rods instead")
    options = parser.parse_args(argv)
    if options.rods:
        from sim_hil import seeing_rods

        print(json.dumps(seeing_rods.table(RODS, options.workers)))
        return 0
    if options.faults:
        from sim_hil import seeing_faults

        rows = seeing_faults.table("fanuc-sim")
        print(json.dumps(rows))
        return 0 if len(rows) == sum(map(len, seeing_faults.SESSIONS)) and all(map(seeing_faults.is_safe, rows)) else 1
    seeds = [options.seed * 100_000 + i for i in range(options.n)]
    if options.cell:
        from sim_hil import seeing_campaign

        result = seeing_campaign.run(seeds, options.seconds, options.workers)
        print(json.dumps(result))
        return 0 if not result["robot_caused"] else 1
    jobs = [(seed, SECONDS, True) for seed in seeds]
    jobs += [(seed, EMPTY_SECONDS, False) for seed in seeds[: options.n // 8 + 1]]
    with ProcessPoolExecutor(options.workers) as pool:
        done = list(tqdm(pool.map(episode, *zip(*jobs, strict=True)), total=len(jobs), disable=None))
    looks = [look for found in done[: options.n] for look in found]
    result = table(looks, done[options.n :])
    result["seeds_over"] = [seed for seed, found in zip(seeds, done, strict=False) if any(map(is_over, found))]
    print(json.dumps(result))
    return 1 if result["seeds_over"] or result["false_stops"] else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
