"""A way around a standing obstacle in joint space: RRT-connect and short cuts, seeded. It serves the task; nothing here
is trusted with safety.
"""

from __future__ import annotations

import numpy as np

from asc_rt.core.abstraction import People, separation
from asc_rt.core.system import System
from sim_hil.person import Array, Capsules

STEP = 0.25  # rad, the largest joint's, per branch
RESOLUTION = 0.04  # rad, between the poses of a branch that are looked at
LIMIT_MARGIN = 0.05  # rad, from the joint limits
AROUND = 1.2  # rad, how far beside start and goal it looks first
SHORT_CUTS = 80
PUSH, PUSHES = 0.02, 200  # rad, away from the obstacle


class Planner:
    """Ways that stay `clearance` (m) away from `obstacle`, for every capsule that a joint moves."""

    def __init__(self, system: System, obstacle: Capsules, clearance: float) -> None:
        self._system, self._clearance = system, clearance
        still = np.zeros_like(obstacle.p0)
        self._people = People(obstacle.p0, obstacle.p1, still, still, obstacle.radius, np.zeros(len(obstacle.radius)))
        self._low = system.bounds.q_min + LIMIT_MARGIN
        self._high = system.bounds.q_max - LIMIT_MARGIN

    def plan(self, start: Array, goal: Array, rng: np.random.Generator, branches: int) -> list[Array] | None:
        """Poses after `start`, the last one `goal`; None: no way found with so many branches."""
        first = self._pushed(start)
        if first is None or self._distance(goal)[0] < self._clearance:
            return None
        path = self._connect(first, goal, rng, branches)
        if path is None:
            return None
        path = self._shortened(path, rng)
        return path[1:] if np.array_equal(first, start) else path

    def _distance(self, q: Array) -> tuple[float, Array]:
        """Distance of the nearest pair and its gradient."""
        model = self._system.model
        found = separation(model.chain, model.capsules, self._people, q, np.zeros_like(q), np.inf, 0.0)
        nearest = int(found.d.argmin())
        return float(found.d[nearest]), found.C[nearest]

    def _pushed(self, q: Array) -> Array | None:
        """q itself if it is clear, else the way up the gradient until it is."""
        for _ in range(PUSHES):
            d, gradient = self._distance(q)
            if d >= self._clearance:
                return q
            q = np.clip(q + PUSH * gradient / max(float(np.linalg.norm(gradient)), 1e-9), self._low, self._high)
        return None

    def _is_free(self, a: Array, b: Array) -> bool:
        poses = max(1, int(np.ceil(np.max(np.abs(b - a)) / RESOLUTION)))
        return all(self._distance(a + (b - a) * i / poses)[0] >= self._clearance for i in range(1, poses + 1))

    def _connect(self, start: Array, goal: Array, rng: np.random.Generator, branches: int) -> list[Array] | None:
        """The whole path, both ends included."""
        if self._is_free(start, goal):
            return [start, goal]
        low = np.clip(np.minimum(start, goal) - AROUND, self._low, self._high)
        high = np.clip(np.maximum(start, goal) + AROUND, self._low, self._high)
        grown, other = _Tree(start), _Tree(goal)
        for i in range(branches):
            wide = i > branches // 2
            target = rng.uniform(self._low if wide else low, self._high if wide else high)
            reached = self._extend(grown, target)
            if reached is not None:
                new = reached
                while (step := self._extend(other, grown.poses[new])) is not None:
                    if np.array_equal(other.poses[step], grown.poses[new]):
                        ways = [grown.way(new), other.way(step)]
                        from_start, from_goal = ways if grown.poses[0] is start else ways[::-1]
                        return [*from_start, *from_goal[::-1][1:]]
            grown, other = other, grown
        return None

    def _extend(self, tree: _Tree, target: Array) -> int | None:
        near = tree.nearest(target)
        way = target - tree.poses[near]
        far = float(np.max(np.abs(way)))
        new = target if far <= STEP else tree.poses[near] + way * STEP / far
        return tree.add(new, near) if self._is_free(tree.poses[near], new) else None

    def _shortened(self, path: list[Array], rng: np.random.Generator) -> list[Array]:
        for _ in range(SHORT_CUTS):
            i, j = sorted(rng.integers(0, len(path), 2))
            if j - i > 1 and self._is_free(path[i], path[j]):
                path = path[: i + 1] + path[j:]
        return path


class _Tree:
    def __init__(self, root: Array) -> None:
        self.poses = [root]
        self._parents = [-1]

    def nearest(self, q: Array) -> int:
        return int(np.argmin(np.sum((np.array(self.poses) - q) ** 2, axis=1)))

    def add(self, q: Array, parent: int) -> int:
        self.poses.append(q)
        self._parents.append(parent)
        return len(self.poses) - 1

    def way(self, i: int) -> list[Array]:
        """From the root to i."""
        poses = []
        while i >= 0:
            poses.append(self.poses[i])
            i = self._parents[i]
        return poses[::-1]
