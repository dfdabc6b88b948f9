"""Joints with inertia, friction and a load that pulls: what the drives turn when no MuJoCo arm is needed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(slots=True)
class Joints:
    """q'' = (torque - load - friction q') / inertia for each joint on its own; a closed brake stands still."""

    q: Array  # (n,) rad
    dq: Array  # (n,) rad/s
    inertia: Array  # (n,) kg m2
    friction: Array  # (n,) Nms/rad
    load: Array  # (n,) Nm, as gravity pulls

    @classmethod
    def free(cls, n: int, load: float = 0.0) -> Joints:
        """ASSUMED 0.05 kg m2 and 0.05 Nms/rad each."""
        return cls(np.zeros(n), np.zeros(n), np.full(n, 0.05), np.full(n, 0.05), np.full(n, load))

    @classmethod
    def arm(cls, n: int = 7) -> Joints:
        """Heavy at the shoulder, light at the wrist: ASSUMED 0.3 to 0.003 kg m2."""
        return cls(np.zeros(n), np.zeros(n), np.geomspace(0.3, 0.003, n), np.full(n, 0.05), np.zeros(n))

    def step(self, torque: Array, braked: npt.NDArray[np.bool_], seconds: float) -> None:
        """Semi-implicit Euler."""
        self.dq = self.dq + seconds * (torque - self.load - self.friction * self.dq) / self.inertia
        self.dq[braked] = 0.0
        self.q = self.q + seconds * self.dq
