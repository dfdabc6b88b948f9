"""Limit tables of the simulated arms, and the check of the set-points against them.

Velocity, acceleration and jerk of each axis are limited at 20 stages of flange speed (k / 20 of the greatest), without
and with full payload; between stages and payloads linearly, below the first stage the first, above the last along the
last slope.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

STAGES = 20
KINDS = ("velocity", "acceleration", "jerk")
ROUNDING = 1e-9  # share of a limit: differences of exact positions are not exact themselves
# A set-point may be rounded to a float64 of about 1000 deg; differenced three times over T that is 4 ulp / T^3.
ULP = 2.0**-43  # deg


@dataclass(frozen=True)
class Tables:
    max_speed: int  # mm/s at the flange: the last stage
    no_payload: Array  # (3 kinds, 6 axes, 20 stages): deg/s, deg/s2, deg/s3
    full_payload: Array

    def at(self, speed: float, payload: float) -> Array:
        """(3, 6) limits at a flange speed [mm/s] and a payload (0 none, 1 full)."""
        table = self.no_payload + payload * (self.full_payload - self.no_payload)
        place = max(0.0, speed / self.max_speed * STAGES - 1.0)
        low = min(int(place), STAGES - 2)
        below, above = table[:, :, low], table[:, :, low + 1]
        return np.asarray(below + (place - low) * (above - below))


def _invented(
    max_speed: int,
    velocity: tuple[float, ...],
    acceleration: tuple[float, ...],
    jerk: tuple[float, ...],
    without_payload: float,
) -> Tables:
    """From the limits at full payload and speed. Their fall over the stages by a fifth is ASSUMED, as is the rest."""
    last = np.array([velocity, acceleration, jerk])[:, :, None]
    fall = np.stack([np.ones(STAGES), *[np.linspace(1.25, 1.0, STAGES)] * 2])[:, None, :]
    gain = np.array([1.0, without_payload, without_payload])[:, None, None]
    return Tables(max_speed, last * fall * gain, last * fall)


# velocity DATASHEET, everything else ASSUMED: FANUC does not publish it. Never a limit for a real arm.
LR_MATE_200ID = _invented(
    4000, (450.0, 380.0, 520.0, 550.0, 545.0, 1000.0), (500.0, 500.0, 700.0, 1100.0, 1100.0, 2000.0), (4000.0,) * 6, 1.3
)
# Last stage and speed: read from the simulator of the manufacturer (facts 7.2); the fall over the stages is ASSUMED.
CRX_10IA_L = _invented(
    2000, (120.0,) * 2 + (180.0,) * 4, (265.0,) * 2 + (399.0,) * 4, (1240.0,) * 2 + (1860.0,) * 4, 1.0
)


@dataclass(frozen=True, slots=True)
class Excess:
    kind: int  # index of KINDS
    axis: int  # 1-6
    value: float  # deg/s, deg/s2 or deg/s3
    limit: float

    def __str__(self) -> str:
        return f"J{self.axis} {KINDS[self.kind]} {self.value:.6g}, limit {self.limit:.6g}"


class LimitCheck:
    """Backward differences of the set-points against the tables; all positions before the first equal it.

    Whether the controller holds its own J3 or the mechanical one against the table of axis 3 is not public: both are.
    """

    def __init__(self, tables: Tables, payload: float, period: float, place: Callable[[Array], Array]) -> None:
        """`place`: pendant angles [deg] -> flange position [mm]."""
        self._tables, self._payload, self._period, self._place = tables, payload, period, place
        self._past: deque[Array] = deque(maxlen=3)

    def restart(self) -> None:
        self._past.clear()

    def excess(self, pendant: Array) -> Excess | None:
        """Take one set-point (6 angles in degrees, J3 against the horizontal); what it exceeds, if anything."""
        if not self._past:
            self._past.extend([pendant] * 3)
        speed = float(np.linalg.norm(self._place(pendant) - self._place(self._past[-1]))) / self._period
        limits = self._tables.at(speed, self._payload)
        rows = np.array([*self._past, pendant])
        rows = np.column_stack([rows, rows[:, 1] + rows[:, 2]])  # the seventh is J3 against the upper arm
        limits = np.column_stack([limits, limits[:, 2]])
        self._past.append(pendant)
        for kind in range(3):
            rows = np.diff(rows, axis=0) / self._period
            value, noise = np.abs(rows[-1]), 2**kind * ULP / self._period ** (kind + 1)
            over = value > limits[kind] * (1 + ROUNDING) + noise
            if over.any():
                worst = int(np.argmax(value / limits[kind]))
                return Excess(kind, 3 if worst == 6 else worst + 1, float(value[worst]), float(limits[kind][worst]))
        return None
