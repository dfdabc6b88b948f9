"""What the simulated controller knows about its arm: the pose it reports, its J3, and how it executes set-points."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sim_hil.fanuc import tables
from sim_hil.fanuc.tables import Array, Tables


class Plant(Protocol):
    """The mechanics. URDF radians; one step is one controller cycle."""

    @property
    def q(self) -> Array: ...

    @property
    def dq(self) -> Array: ...

    def set_target(self, q: Array) -> None: ...

    def step(self) -> None: ...


class KinematicPlant:
    """An arm without mass: it is where it is told to be."""

    def __init__(self, q: Array, period: float) -> None:
        self.q = self._target = np.array(q, dtype=np.float64)
        self.dq = np.zeros_like(self.q)
        self._period = period

    def set_target(self, q: Array) -> None:
        self._target = q

    def step(self) -> None:
        self.dq = (self._target - self.q) / self._period
        self.q = self._target


class Servo:
    """Set-points -> where the servos drive: moving average ($FLTR_LN), first-order lag; and braking when it is over.

    x(k) = x(k-1) + (1 - exp(-T / tau)) (mean of the last L set-points - x(k-1))
    """

    def __init__(self, q: Array, period: float, filter_cycles: int, lag_s: float, brake: Array) -> None:
        self.q = np.array(q, dtype=np.float64)  # rad
        self.dq = np.zeros_like(self.q)  # rad/s
        self._period = period
        self._gain = 1.0 - math.exp(-period / lag_s) if lag_s > 0 else 1.0
        self._window = deque([self.q] * filter_cycles, maxlen=filter_cycles)
        self._brake = brake  # rad/s2
        self._brake_cycles = 0

    def follow(self, q: Array) -> None:
        self._window.append(q)
        self._brake_cycles = 0
        self._move(self.q + self._gain * (np.mean(self._window, axis=0) - self.q))

    def hold(self) -> None:
        """Stay, once what was begun is finished: a brake to rest, the way to the last set-point."""
        if self._brake_cycles > 1:
            self.brake()
        else:
            self.follow(self._window[-1])

    def brake(self) -> None:
        """All joints to rest together, so that the arm stays on its path, the slowest at its deceleration limit."""
        if self._brake_cycles == 0:
            self._brake_cycles = max(1, math.ceil(float(np.max(np.abs(self.dq) / self._brake)) / self._period))
        self._move(self.q + self.dq * (1.0 - 1.0 / self._brake_cycles) * self._period)
        self._window.extend([self.q] * len(self._window))
        self._brake_cycles = max(1, self._brake_cycles - 1)

    def _move(self, q: Array) -> None:
        self.dq = (q - self.q) / self._period
        self.q = q


def to_wire(q: Array) -> Array:
    """URDF joints in radians as the pendant and the wire show them: degrees, J3 against the horizontal."""
    pendant = np.rad2deg(q)
    pendant[2] = pendant[2] - pendant[1]
    return np.concatenate([pendant, np.zeros(9 - len(pendant))])


def from_wire(axes: Array, n: int) -> Array:
    pendant = axes[:n].copy()
    pendant[2] = pendant[2] + pendant[1]
    return np.deg2rad(pendant)


_NEWTON_STEPS, _NEWTON_ENOUGH, _NEWTON_STRIDE, _NUDGE = 20, 1e-9, 0.2, 1e-6

# Face plate against the flange: its z is the flange's x. DATASHEET
_FACE_PLATE = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])


@dataclass(frozen=True)
class Arm:
    """Joint origins [m] and axes from the crossing height of J1 and J2 on, the flange; and the limit tables."""

    joints: tuple[tuple[tuple[float, float, float], tuple[int, int, int]], ...]
    flange: tuple[float, float, float]
    tables: Tables
    ampere_per_nm: tuple[float, ...]  # motor current per joint torque

    def place(self, q: Array) -> Array:
        """Flange in the world frame [m]."""
        return self._frame(q)[1]

    def pose(self, q: Array) -> Array:
        """Face plate in the world frame: X Y Z [mm], W P R [deg], E1-E3 = 0."""
        rotation, place = self._frame(q)
        r = rotation @ _FACE_PLATE
        p = math.atan2(-r[2, 0], math.hypot(r[0, 0], r[1, 0]))
        angles = (math.atan2(r[2, 1], r[2, 2]), p, math.atan2(r[1, 0], r[0, 0]))  # R = Rz(R) Ry(P) Rx(W)
        return np.concatenate([1000.0 * place, np.rad2deg(angles), np.zeros(3)])

    def inverse(self, pose: Array, near: Array) -> Array | None:
        """The joints at which the face plate has `pose` (X Y Z mm, W P R deg), on the branch of `near`; None: there are
        none, or `near` is too far away. Newton's method, differences for derivatives."""
        target = _rotation(np.radians(pose[3:6])), 1e-3 * pose[:3]
        q = near.copy()
        for _ in range(_NEWTON_STEPS):
            error = self._miss(q, target)
            if np.max(np.abs(error)) < _NEWTON_ENOUGH:
                return q
            slope = np.column_stack([self._miss(q + row, target) - error for row in _NUDGE * np.eye(len(q))]) / _NUDGE
            q = q - np.clip(np.linalg.lstsq(slope, error)[0], -_NEWTON_STRIDE, _NEWTON_STRIDE)
        return None

    def configuration(self, q: Array) -> Array:
        """(3,) wrist, elbow, shoulder: how far each is from where it turns over. Poses of one configuration have equal
        signs: sin J5 (no flip, flip); the forearm against the upper arm (up, down); the wrist before or behind J1."""
        rotation, place, places = np.eye(3), np.zeros(3), []
        for angle, (origin, axis) in zip(q, self.joints, strict=True):
            place = place + rotation @ np.array(origin)
            places.append(place)
            rotation = rotation @ _turn(axis, float(angle))
        shoulder, elbow, wrist = places[1], places[2], places[4]
        front = np.array([math.cos(q[0]), math.sin(q[0]), 0.0])
        across = np.array([math.sin(q[0]), -math.cos(q[0]), 0.0])
        bend = float(across @ np.cross(elbow - shoulder, wrist - elbow))
        return np.array([math.sin(q[4]), bend, float(front @ wrist)])

    def _miss(self, q: Array, target: tuple[Array, Array]) -> Array:
        """How far off the face plate is: (6,) m and rad."""
        rotation, place = self._frame(q)
        turn = target[0].T @ rotation @ _FACE_PLATE
        off = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2.0
        return np.concatenate([place - target[1], off])

    def _frame(self, q: Array) -> tuple[Array, Array]:
        rotation, place = np.eye(3), np.zeros(3)
        for angle, (origin, axis) in zip(q, self.joints, strict=True):
            place = place + rotation @ np.array(origin)
            rotation = rotation @ _turn(axis, float(angle))
        return rotation, place + rotation @ np.array(self.flange)


# Geometry DATASHEET; current ASSUMED: about 4 A at the torque that the URDF allows.
LR_MATE_200ID = Arm(
    joints=(
        ((0.0, 0.0, 0.0), (0, 0, 1)),
        ((0.050, 0.0, 0.0), (0, 1, 0)),
        ((0.0, 0.0, 0.330), (0, -1, 0)),
        ((0.0, 0.0, 0.035), (-1, 0, 0)),
        ((0.335, 0.0, 0.0), (0, -1, 0)),
        ((0.0, 0.0, 0.0), (-1, 0, 0)),
    ),
    flange=(0.080, 0.0, 0.0),
    tables=tables.LR_MATE_200ID,
    ampere_per_nm=(0.008, 0.008, 0.02, 0.057, 0.1, 0.2),
)
CRX_10IA_L = Arm(
    joints=(
        ((0.0, 0.0, 0.0), (0, 0, 1)),
        ((0.0, 0.0, 0.0), (0, 1, 0)),
        ((0.0, 0.0, 0.710), (0, -1, 0)),
        ((0.0, 0.0, 0.0), (-1, 0, 0)),
        ((0.540, 0.0, 0.0), (0, -1, 0)),
        ((0.0, -0.150, 0.0), (-1, 0, 0)),
    ),
    flange=(0.160, 0.0, 0.0),
    tables=tables.CRX_10IA_L,
    ampere_per_nm=(0.01, 0.01, 0.02, 0.067, 0.067, 0.067),
)
ARMS = {"lrmate_200id": LR_MATE_200ID, "crx_10ia_l": CRX_10IA_L}


def _rotation(angles: Array) -> Array:
    """R = Rz(R) Ry(P) Rx(W)."""
    w, p, r = (float(angle) for angle in angles)
    return _turn((0, 0, 1), r) @ _turn((0, 1, 0), p) @ _turn((1, 0, 0), w)


def _turn(axis: tuple[int, int, int], angle: float) -> Array:
    sign = sum(axis)
    c, s = math.cos(angle), sign * math.sin(angle)
    if axis[0]:
        return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    if axis[1]:
        return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
