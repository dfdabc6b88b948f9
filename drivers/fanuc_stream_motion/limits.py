"""The controller's limit tables: as joint limits for the core, and as the check of each set-point before it is sent.

The controller takes backward differences of the set-points (v = dp / T, a = dv / T, j = da / T, everything before the
first equal to it) and compares them with tables over flange speed and payload. Whether it does so with its own J3
(against the horizontal) or with the mechanical one is not public: both are kept inside the table of axis 3.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asc_rt.core.types import Matrix, Vector, vector
from drivers.base import JointLimits
from drivers.fanuc_stream_motion.packets import DOF, STAGES, Thresholds

KINDS = ("velocity", "acceleration", "jerk")
UNITS = ("deg/s", "deg/s2", "deg/s3")
MARGIN = 0.02  # the core plans this share below the tables
REFUSE = 0.005  # a set-point within this share of a table is not sent: the controller may compute it differently
FLOAT32_STEP = np.radians(2.0**-16)  # rad, half the distance of float32 angles between 256 and 512 deg


class Tables:
    """All tables of the six axes. ValueError: one is missing, or a limit is not positive."""

    def __init__(self, told: Sequence[Thresholds]) -> None:
        by_place = {(t.kind, t.axis): t for t in told}
        wanted = [(kind, axis) for kind in range(3) for axis in range(1, DOF + 1)]
        missing = [place for place in wanted if place not in by_place]
        if missing:
            raise ValueError(f"no table of (kind, axis) {missing}")
        rows = [by_place[place] for place in wanted]
        self.max_speed = rows[0].max_speed  # m/s
        self._no_payload = np.array([t.no_payload for t in rows]).reshape(3, DOF, STAGES)
        self._full_payload = np.array([t.full_payload for t in rows]).reshape(3, DOF, STAGES)
        if not (self._no_payload.min() > 0 and self._full_payload.min() > 0):
            raise ValueError("the robot tells limits that are not positive")

    def at(self, speed: float, payload: float) -> Matrix:
        """(3 kinds, 6 axes) rad/s, rad/s2, rad/s3 at a flange speed [m/s] and a payload (0 none ... 1 full).

        Linear between stages and payloads; below the first stage the first; above the last along the last slope.
        """
        table = self._no_payload + payload * (self._full_payload - self._no_payload)
        place = max(0.0, STAGES * speed / self.max_speed - 1.0)
        low = min(int(place), STAGES - 2)
        below, above = table[:, :, low], table[:, :, low + 1]
        return np.asarray(below + (place - low) * (above - below))

    def least_up_to(self, speed: float, payload: float) -> Matrix:
        """The least limits at any flange speed up to `speed`: (3, 6). Linear in between, so the stages decide."""
        stages = [k * self.max_speed / STAGES for k in range(1, STAGES + 1)]
        return np.min([self.at(s, payload) for s in [*(s for s in stages if s < speed), speed]], axis=0)


def joint_limits(limits: Matrix, rounding: float, period: float) -> JointLimits:
    """The box of URDF joint limits inside `limits` (3, 6), MARGIN below them.

    J3_fanuc = J3_urdf - J2, so J2 and J3 share the table of axis 3 in the ratio of their own: b2 + b3 = L3 with
    b2 : b3 = L2 : L3. A box, not a coupled row: joints that brake each on its own then stay inside as well.
    `rounding`: rad, by how much the wire may round an angle; differenced k times it becomes 2^k rounding / T^k.
    """
    boxes = []
    for kind in range(3):
        noise = 2 ** (kind + 1) * rounding / period ** (kind + 1)
        box = (1.0 - MARGIN) * limits[kind] - noise
        third = box[2] - noise  # two rounded angles
        second = min(box[1], third * box[1] / (box[1] + box[2]))
        box[1], box[2] = second, third - second
        boxes.append(vector(box))
    return JointLimits(*boxes)


@dataclass(frozen=True, slots=True)
class Breach:
    kind: int  # index of KINDS
    axis: int  # 1-6
    value: float  # rad/s, rad/s2 or rad/s3
    limit: float

    def __str__(self) -> str:
        value, limit = np.degrees([self.value, self.limit])
        return f"J{self.axis} {KINDS[self.kind]} {value:.5g}, the robot's limit is {limit:.5g} {UNITS[self.kind]}"


class LimitCheck:
    """Holds the set-points, as the wire rounds them, against the tables."""

    def __init__(self, limits: Matrix, period: float) -> None:
        self._limits = (1.0 - REFUSE) * np.column_stack([limits, limits[:, 2]])  # (3, 7), the seventh: FANUC's J3
        self._period = period
        self._past: deque[Vector] = deque(maxlen=3)

    def breach(self, q: Vector) -> Breach | None:
        """What the set-point `q` (6,) rad would break, if it came next."""
        past = self._past or deque([q] * 3)
        rows = np.array([*past, q])
        rows = np.column_stack([rows, rows[:, 2] - rows[:, 1]])
        for kind in range(3):
            rows = np.diff(rows, axis=0) / self._period
            over = np.abs(rows[-1]) - self._limits[kind]
            axis = int(np.argmax(over))
            if over[axis] > 0:
                return Breach(kind, 3 if axis == 6 else axis + 1, abs(float(rows[-1, axis])), self._limits[kind, axis])
        return None

    def sent(self, q: Vector) -> None:
        """`q` is out."""
        self._past.extend([q] if self._past else [q] * 3)
