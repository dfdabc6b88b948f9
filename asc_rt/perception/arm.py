"""Where the arm's capsules are, and where they were at a capture."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque

import numpy as np
import pinocchio as pin

from asc_rt.core.robot_model import RobotModel
from asc_rt.core.types import Vector

EXTRAPOLATION_NS = 80_000_000  # joint states may be so much older than the picture
MEMORY = 512  # joint states


class JointHistory:
    """Stamped joint states, asked for the moment of capture. In the newest one the arm is elsewhere."""

    def __init__(self) -> None:
        self._t: deque[int] = deque(maxlen=MEMORY)
        self._q: deque[Vector] = deque(maxlen=MEMORY)

    def add(self, t_ns: int, q: Vector) -> None:
        if not self._t or t_ns > self._t[-1]:
            self._t.append(t_ns)
            self._q.append(q)

    def at(self, t_ns: int) -> Vector | None:
        """Interpolated, or carried on with the last velocity; None: none near enough."""
        times = list(self._t)
        if len(times) < 2 or not times[0] <= t_ns <= times[-1] + EXTRAPOLATION_NS:
            return None
        after = min(max(bisect_left(times, t_ns), 1), len(times) - 1)
        t0, t1, q0, q1 = times[after - 1], times[after], self._q[after - 1], self._q[after]
        return q0 + (t_ns - t0) / (t1 - t0) * (q1 - q0)


class Arm:
    def __init__(self, model: RobotModel) -> None:
        self._model, self._data = model, model.pin_model.createData()

    def capsules(self, q: Vector) -> tuple[np.ndarray, np.ndarray]:
        """(m, 3), (m, 3) m: ends of all robot capsules at q (rad), base frame."""
        model, capsules = self._model, self._model.capsules
        pin.forwardKinematics(model.pin_model, self._data, np.asarray(q, float))
        poses = [self._data.oMi[int(joint) + 1].homogeneous for joint in capsules.joint]  # 0: the base itself
        p0, p1 = (
            np.array([T[:3, :3] @ p + T[:3, 3] for T, p in zip(poses, ends, strict=True)])
            for ends in (capsules.p0, capsules.p1)
        )
        return p0, p1
