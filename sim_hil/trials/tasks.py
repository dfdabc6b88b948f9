"""What the arm is there for: goals, and ways around where the filter blocks the straight one. Not part of the core."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from asc_rt.core.types import CoreState, Goal, vector
from sim_hil.person import Array
from sim_hil.trials.planner import Planner

PROGRESS = 0.02  # rad nearer to the target, or it is no progress
CLOSER = 0.1  # rad: what an arm that is not held makes within a tenth of a second
PATIENCE = 1.0  # s without progress
NEAR = 0.1  # rad: near enough to a pose on the way
BRANCHES = 600  # per attempt
ATTEMPTS = 6


class Task(Protocol):
    def goal(self, t: float, state: CoreState, q: Array) -> Goal: ...

    @property
    def is_over(self) -> bool: ...

    def reached(self, state: CoreState) -> int:
        """Goals reached so far."""


class Rounds:
    """Goals in turn, again and again."""

    def __init__(self, goals: Array) -> None:
        self._goals = goals
        self._id = 1

    is_over = False

    def goal(self, t: float, state: CoreState, q: Array) -> Goal:
        if state.reached_id >= self._id:
            self._id += 1
        return Goal(self._id, vector(self._goals[self._id % len(self._goals)]))

    def reached(self, state: CoreState) -> int:
        return state.reached_id


class Shift:
    """Goals in turn; one that has not come CLOSER within `patience` s is left for the next: to creep is no progress."""

    def __init__(self, goals: Array, patience: float) -> None:
        self._goals, self._patience = goals, patience
        self._id, self._count = 1, 0
        self._best, self._since = np.inf, 0.0

    is_over = False

    def goal(self, t: float, state: CoreState, q: Array) -> Goal:
        left = float(np.max(np.abs(self._goals[self._id % len(self._goals)] - q)))
        if state.reached_id >= self._id:
            self._count += 1
            self._next(t)
        elif left < self._best - CLOSER:
            self._best, self._since = left, t
        elif t - self._since > self._patience:
            self._next(t)
        return Goal(self._id, vector(self._goals[self._id % len(self._goals)]))

    def reached(self, state: CoreState) -> int:
        return self._count

    def _next(self, t: float) -> None:
        self._id += 1
        self._best, self._since = np.inf, t


class Visit:
    """One goal. Straight towards it; after PATIENCE without progress by way of poses that the planner finds."""

    def __init__(self, goal: Array, planner: Planner | None, rng: np.random.Generator) -> None:
        self._planner, self._rng = planner, rng
        self._way = [goal]
        self._id, self._final = 1, goal
        self._attempts = 0
        self._best, self._since = np.inf, 0.0
        self.is_over = False

    def goal(self, t: float, state: CoreState, q: Array) -> Goal:
        if self.reached(state):
            self.is_over = True
        left = float(np.max(np.abs(self._way[0] - q)))
        if len(self._way) > 1 and left < NEAR:
            self._head(self._way[1:], t)
        elif left < self._best - PROGRESS:
            self._best, self._since = left, t
        elif t - self._since > PATIENCE and self._planner is not None:
            self._replan(t, q)
        return Goal(self._id, vector(self._way[0]))

    def reached(self, state: CoreState) -> int:
        return int(len(self._way) == 1 and state.reached_id == self._id)

    def _replan(self, t: float, q: Array) -> None:
        assert self._planner is not None
        if self._attempts == ATTEMPTS:
            self.is_over = True
            return
        self._attempts += 1
        way = self._planner.plan(q, self._final, self._rng, BRANCHES)
        self._head(way or [self._final], t)

    def _head(self, way: list[Array], t: float) -> None:
        self._way = way
        self._id += 1
        self._best, self._since = np.inf, t
