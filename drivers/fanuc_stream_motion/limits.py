"""The controller's limit tables: as joint limits for the core, and as the check of each set-point before it is sent.

The controller takes backward differences of the set-points (v = dp / T, a = dv / T, j = da / T, everything before the
first equal to it) and compares them with tables over flange speed and payload. Whether it does so with its own J3
(against the horizontal) or with the mechanical one is not public: both are kept inside the table of axis 3.

The core's stop needs limits that do not change under way, so it gets one box for every flange speed up to a greatest
one. The check goes by the flange speed of the moment, and is there for a flange that is faster still.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import dist

import numpy as np

from asc_rt.core.types import Matrix, Vector, vector
from drivers.base import JointLimits
from drivers.fanuc_stream_motion.arms import Arm, Point
from drivers.fanuc_stream_motion.packets import DOF, STAGES, Thresholds

KINDS = ("velocity", "acceleration", "jerk")
UNITS = ("deg/s", "deg/s2", "deg/s3")
MARGIN = 0.02  # the core plans this share below the tables
REFUSE = 0.005  # a set-point within this share of a table is not sent: the controller may compute it differently
_TABLE_OF = np.array([*range(DOF), 2])  # whose table holds for joints 1 to 6 and FANUC's J3
FLOAT32_STEP = np.radians(2.0**-16)  # rad, half the distance of float32 angles between 256 and 512 deg


class Tables:
    """All tables of the six axes at one payload (0 none ... 1 full). ValueError: one is missing, or not positive."""

    def __init__(self, told: Sequence[Thresholds], payload: float) -> None:
        by_place = {(t.kind, t.axis): t for t in told}
        wanted = [(kind, axis) for kind in range(3) for axis in range(1, DOF + 1)]
        missing = [place for place in wanted if place not in by_place]
        if missing:
            raise ValueError(f"no table of (kind, axis) {missing}")
        rows = [by_place[place] for place in wanted]
        if min(min(t.no_payload.min(), t.full_payload.min()) for t in rows) <= 0:
            raise ValueError("the robot tells limits that are not positive")
        self.max_speed = rows[0].max_speed  # m/s
        without, full = np.array([t.no_payload for t in rows]), np.array([t.full_payload for t in rows])
        # (stages, 3 kinds, 6 axes): what is asked for in each cycle lies together
        self._stages = np.ascontiguousarray(
            (without + payload * (full - without)).reshape(3, DOF, STAGES).transpose(2, 0, 1)
        )

    def at(self, speed: float) -> Matrix:
        """(3 kinds, 6 axes) rad/s, rad/s2, rad/s3 at a flange speed [m/s].

        Linear between stages and payloads; below the first stage the first; above the last along the last slope.
        """
        place = max(0.0, STAGES * speed / self.max_speed - 1.0)
        low = min(int(place), STAGES - 2)
        below, above = self._stages[low], self._stages[low + 1]
        return np.asarray(below + (place - low) * (above - below))

    def least_up_to(self, speed: float) -> Matrix:
        """The least limits at any flange speed up to `speed`: (3, 6). Linear in between, so the stages decide."""
        stages = [k * self.max_speed / STAGES for k in range(1, STAGES + 1)]
        return np.min([self.at(s) for s in [*(s for s in stages if s < speed), speed]], axis=0)


def joint_limits(tables: Tables, flange_speed: float, rounding: float, period: float) -> JointLimits:
    """The box of URDF joint limits inside the tables up to `flange_speed` [m/s], MARGIN below them.

    J3_fanuc = J3_urdf - J2, so J2 and J3 share the table of axis 3 in the ratio of their own: b2 + b3 = L3 with
    b2 : b3 = L2 : L3. A box, not a coupled row: joints that brake each on its own then stay inside as well.
    `rounding`: rad, by how much the wire may round an angle; differenced k times it becomes 2^k rounding / T^k.
    """
    boxes = []
    for kind, limits in enumerate(tables.least_up_to(flange_speed)):
        noise = 2 ** (kind + 1) * rounding / period ** (kind + 1)
        box = (1.0 - MARGIN) * limits - noise
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
    speed: float  # m/s of the flange

    def __str__(self) -> str:
        value, limit = np.degrees([self.value, self.limit])
        return (
            f"J{self.axis} {KINDS[self.kind]} {value:.5g}, the robot's limit is {limit:.5g} {UNITS[self.kind]}"
            f" at a flange speed of {self.speed:.3g} m/s"
        )


class LimitCheck:
    """Holds the set-points, as the wire rounds them, against the tables at the speed that the flange has.

    Of this period and the one before: which of them the controller takes is not public.
    """

    def __init__(self, tables: Tables, arm: Arm, period: float) -> None:
        self._tables, self._arm, self._period = tables, arm, period
        self._newest: tuple[Matrix, Point] | None = None  # motion and flange of the set-point sent last
        self._speed = 0.0  # of the flange, m/s

    def breach(self, q: Vector) -> Breach | None:
        """What the set-point `q` (6,) rad would break, if it came next."""
        motion, _, speed = self._next(q)
        limits = (1.0 - REFUSE) * np.minimum(self._tables.at(self._speed), self._tables.at(speed))
        over = np.abs(motion[1:]) - limits[:, _TABLE_OF]
        if over.max() <= 0:
            return None
        kind = int(np.argmax(over.max(axis=1) > 0))
        worst = int(np.argmax(over[kind]))
        axis = int(_TABLE_OF[worst])
        return Breach(kind, axis + 1, abs(float(motion[1 + kind, worst])), float(limits[kind, axis]), speed)

    def sent(self, q: Vector) -> None:
        """`q` is out."""
        motion, place, self._speed = self._next(q)
        self._newest = motion, place

    def _next(self, q: Vector) -> tuple[Matrix, Point, float]:
        """(4, 7) position and its backward differences, the seventh FANUC's J3; the flange, and its speed."""
        motion, place = np.zeros((4, DOF + 1)), self._arm.place(q)
        motion[0, :DOF] = q
        motion[0, DOF] = q[2] - q[1]
        if self._newest is None:  # everything before the first equals it
            return motion, place, 0.0
        before, last_place = self._newest
        for k in range(3):
            motion[k + 1] = (motion[k] - before[k]) / self._period
        return motion, place, dist(place, last_place) / self._period
