"""The coordinated stop: every axis comes to rest at the same moment, on the straight way that they were on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asc_rt.core.types import Vector

LEAST_S = 0.02  # shorter is a step


@dataclass(frozen=True, slots=True)
class StopPath:
    """q(t) = q0 + dq0 (t - t^2 / 2D), 0 <= t <= D: the path speed falls linearly, D by the joint that needs longest."""

    q0: Vector  # rad
    dq0: Vector  # rad/s
    duration: float  # s

    @classmethod
    def plan(cls, q: Vector, dq: Vector, ddq: Vector) -> StopPath:
        """`ddq`: deceleration of each joint, rad/s2."""
        return cls(q, dq, max(LEAST_S, float(np.max(np.abs(dq) / ddq))))

    def at(self, t: float) -> tuple[Vector, Vector, Vector]:
        """q, dq, ddq; after the end: at rest."""
        if t >= self.duration:
            zero = np.zeros_like(self.q0)
            return self.q0 + self.dq0 * self.duration / 2.0, zero, zero
        left = 1.0 - t / self.duration
        return self.q0 + self.dq0 * t * (1.0 + left) / 2.0, self.dq0 * left, -self.dq0 / self.duration
