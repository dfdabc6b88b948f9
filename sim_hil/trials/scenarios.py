"""Seeded draws: pure functions of (suite seed, system, trial number)."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

from asc_rt.core.kinematics import forward
from asc_rt.core.system import System
from sim_hil.person import Array
from sim_hil.plant import MujocoPlant
from sim_hil.trials.sensing import Ball

SPREAD = 0.9  # rad, of start and goal around the home pose, per joint
LEAST_WAY = 0.6  # rad, of the joint that moves farthest
LIMIT_MARGIN = 0.1  # rad
BALL_RADIUS = 0.02  # m
OFFSET = 0.12  # m: how far from the last joint's way the ball may be, at most
FREE = 0.05  # m more than d_min at start and goal
DRAWS = 10_000


@dataclass(frozen=True, slots=True)
class GoalAndObstacle:
    q0: Array  # rad
    goal: Array
    ball: Ball


def rng_of(seed: int, system: str, trial: int, *purpose: int) -> np.random.Generator:
    """Of one trial of one system, whatever else is run; the same for every policy."""
    return np.random.default_rng((seed, zlib.crc32(system.encode()), trial, *purpose))


def goal_and_obstacle(system: System, home: Array, rng: np.random.Generator) -> GoalAndObstacle:
    """Start, goal, and a ball beside the way that the last joint takes if all joints go straight.

    The whole arm, its base included, is at least d_min + FREE away from the ball at start and goal, by MuJoCo's
    geometry. RuntimeError: no such draw in DRAWS.
    """
    plant, b = MujocoPlant(system.params), system.bounds
    low, high = np.maximum(home - SPREAD, b.q_min + LIMIT_MARGIN), np.minimum(home + SPREAD, b.q_max - LIMIT_MARGIN)
    free = system.params.safety.d_min + FREE
    for _ in range(DRAWS):
        q0, goal = rng.uniform(low, high), rng.uniform(low, high)
        between = q0 + rng.uniform(0.3, 0.7) * (goal - q0)
        offset = rng.normal(size=3)
        offset *= OFFSET * rng.random() ** (1 / 3) / np.linalg.norm(offset)
        place = forward(system.model.chain, between, np.zeros(system.n)).origin[-1] + offset
        if np.max(np.abs(goal - q0)) < LEAST_WAY:
            continue
        ball = Ball(place, BALL_RADIUS)
        if min(_distance(plant, q0, ball), _distance(plant, goal, ball)) >= free:
            return GoalAndObstacle(q0, goal, ball)
    raise RuntimeError(f"{system.params.robot.name}: no start and goal clear of an obstacle between them")


def _distance(plant: MujocoPlant, q: Array, ball: Ball) -> float:
    plant.reset(q)
    plant.set_person(ball.at(0.0))
    return plant.distance().distance
