"""A simulated person: ten capsules driven by a seeded script that is a pure function of (seed, time).

The person stands outside, walks in to the edge of the workspace, turns to the robot, reaches in with one or both hands,
holds, retracts, turns away, leaves and waits, again and again with other places and times. All sizes are ASSUMED, near
the 50th percentile of adults. Frame: the robot's base (z up, base axis = z axis); the floor is at z = FLOOR_Z.

Every phase moves one posture vector from rest to rest on a minimum-jerk profile, so position, velocity and acceleration
are continuous. Velocities are exact derivatives by the complex step: v = Im f(t + ih) / h with no subtraction, hence no
rounding, for any f built of analytic operations. So nothing below may use abs, norm, arctan2 or a comparison of values.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Numbers = npt.NDArray[Any]  # float64 or complex128

FLOOR_Z = -0.6  # m, the arm stands on a pedestal
HIP_Z = FLOOR_Z + 0.88
TORSO, HEAD = 0.50, (0.17, 0.24)  # m along the spine from the hips: shoulder line; ends of the head's axis above it
SHOULDER_Y, HIP_Y = 0.19, 0.09
UPPER_ARM, FOREARM = 0.30, 0.40  # the forearm's axis ends in the middle of the hand
THIGH, SHANK, FOOT_Z = 0.43, 0.43, FLOOR_Z + 0.055
RADII = {"torso": 0.16, "head": 0.10, "upper_arm": 0.05, "forearm": 0.045, "thigh": 0.075, "shank": 0.055}
LABELS = ("torso", "head") + tuple(f"{side}_{part}" for side in ("left", "right") for part in list(RADII)[2:])

OUTSIDE = 2.7  # m from the base axis, where the person waits
WALK_SPEED, TURN_SPEED, REACH_SPEED = (1.1, 1.5), 3.0, (1.0, 1.9)  # peaks: m/s, rad/s, m/s
STRIDE, HAND_SWING = 1.4, 0.06  # m per two steps; m
FOOT_SWING, FOOT_LIFT = STRIDE / (2 * np.pi), 0.06  # this swing lets the standing foot stand
ARM_REACH = 0.66  # m, shoulder to hand: never quite straight
PEAK = 1.875  # largest slope of the minimum-jerk profile
STEP = 1e-30  # of the complex step

# The posture: distance and azimuth of the body, heading against "towards the robot", lean, hands in the body frame,
# how far the hips are lowered
RHO, AZIMUTH, HEADING, LEAN, HANDS, CROUCH = 0, 1, 2, 3, slice(4, 10), 10
CHANNELS: dict[str, int | slice] = {
    "rho": RHO,
    "azimuth": AZIMUTH,
    "heading": HEADING,
    "lean": LEAN,
    "hands": HANDS,
    "crouch": CROUCH,
}
REST_HANDS = np.array([0.20, 0.24, 0.22, 0.20, -0.24, 0.22])  # m, left and right: x forward, y left, z above the base


class Capsules(NamedTuple):
    """Capsules with the velocities of their ends: m rows, metres and m/s, robot base frame."""

    labels: tuple[str, ...]
    p0: Array  # (m, 3)
    p1: Array  # (m, 3)
    radius: Array  # (m,)
    v0: Array  # (m, 3)
    v1: Array  # (m, 3)


@dataclass(frozen=True, slots=True)
class Phase:
    """From one posture to the next in `duration` seconds; `walk` metres of it on foot."""

    name: str
    start: float
    duration: float
    begin: Array
    end: Array
    walk: float = 0.0


class Person:
    """`at(t)` gives the capsules at script time t (s); before 0 the person stands still outside."""

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        azimuth, heading = self._rng.uniform(-1.2, 1.2), self._rng.uniform(-0.6, 0.6)
        self._posture = np.concatenate([[OUTSIDE, azimuth, heading, 0.0], REST_HANDS, [0.0]])
        self._phases: list[Phase] = []
        self._starts: list[float] = []
        self._end = 0.0
        self._add("wait", self._rng.uniform(0.3, 1.0))

    def at(self, t: float) -> Capsules:
        phase = self.phase(t)
        tau = np.clip((t - phase.start) / phase.duration, 0.0, 1.0) + 1j * STEP / phase.duration
        share = tau**3 * (10.0 - 15.0 * tau + 6.0 * tau**2)
        p0, p1 = _capsule_ends(phase.begin + (phase.end - phase.begin) * share, _gait(phase, tau, share))
        radius = np.array([RADII[label.removeprefix("left_").removeprefix("right_")] for label in LABELS])
        return Capsules(LABELS, p0.real, p1.real, radius, p0.imag / STEP, p1.imag / STEP)

    def phase(self, t: float) -> Phase:
        """What the script does at t. Draws further visits in order, so that the answer depends on seed and t only."""
        while self._end <= t:
            self._add_visit()
        return self._phases[max(bisect_right(self._starts, t) - 1, 0)]

    def _add(self, name: str, duration: float, walk: float = 0.0, **change: Any) -> None:
        end = self._posture.copy()
        for key, value in change.items():
            end[CHANNELS[key]] = value
        self._phases.append(Phase(name, self._end, duration, self._posture, end, walk))
        self._starts.append(self._end)
        self._posture, self._end = end, self._end + duration

    def _add_visit(self) -> None:
        rng = self._rng
        self._walk("walk in", rho=rng.uniform(0.96, 1.02), azimuth=self._near_azimuth())
        self._turn(0.0)
        for _ in range(rng.integers(1, 3)):
            self._reach()
        self._turn(np.pi * rng.choice([-1, 1]))
        self._walk("walk out", rho=OUTSIDE, azimuth=self._near_azimuth())
        self._posture = self._posture.copy()
        self._posture[HEADING] %= 2 * np.pi  # the same heading: the next turn starts from there
        self._turn(rng.uniform(-0.6, 0.6))
        self._add("wait", rng.uniform(0.5, 2.5))

    def _near_azimuth(self) -> float:
        """In front of the arm, not far from the present one: paths in polar coordinates never cross the robot."""
        return float(np.clip(self._posture[AZIMUTH] + self._rng.uniform(-0.4, 0.4), -1.4, 1.4))

    def _walk(self, name: str, rho: float, azimuth: float) -> None:
        length = abs(rho - self._posture[RHO]) + OUTSIDE * abs(azimuth - self._posture[AZIMUTH])  # upper bound
        self._add(name, PEAK * length / self._rng.uniform(*WALK_SPEED), length, rho=rho, azimuth=azimuth)

    def _turn(self, heading: float) -> None:
        self._add("turn", 0.3 + PEAK * abs(heading - self._posture[HEADING]) / TURN_SPEED, heading=heading)

    def _reach(self) -> None:
        rng = self._rng
        lean = rng.uniform(0.28, 0.36)
        both, right = rng.random() < 0.4, int(rng.integers(2))
        hands = REST_HANDS.reshape(2, 3).copy()
        for side in (0, 1) if both else (right,):
            hands[side] = self._hand_target(side, lean)
        way = np.linalg.norm(hands - REST_HANDS.reshape(2, 3), axis=1).max()
        self._add("reach", PEAK * way / rng.uniform(*REACH_SPEED), lean=lean, hands=hands.ravel())
        self._add("hold", rng.uniform(0.3, 1.2))
        self._add("retract", PEAK * way / rng.uniform(*REACH_SPEED), lean=0.0, hands=REST_HANDS)
        self._add("pause", rng.uniform(0.2, 0.8))

    def _hand_target(self, side: int, lean: float) -> Array:
        """A place 0.35 to 0.6 m from the base axis at table height that this hand can reach, in the body frame."""
        shoulder = np.array([TORSO * np.sin(lean), SHOULDER_Y * (1, -1)[side], HIP_Z + TORSO * np.cos(lean)])
        while True:
            rho, angle = self._rng.uniform(0.35, 0.60), self._rng.uniform(0.0, 0.6) * (1, -1)[side]
            height = self._rng.uniform(0.1, 0.5)
            place = np.array([self._posture[RHO] - rho * np.cos(angle), rho * np.sin(angle), height])
            if np.linalg.norm(place - shoulder) < ARM_REACH:
                return place


def _gait(phase: Phase, tau: complex, share: complex) -> tuple[complex, complex]:
    """(size, angle) of the swing of legs and arms: grows and fades within the walk, so that it ends on both feet."""
    size = (4.0 * tau * (1.0 - tau)) ** 3 if phase.walk else 0j
    return size, 2 * np.pi * phase.walk * share / STRIDE


def _capsule_ends(posture: Numbers, gait: tuple[complex, complex]) -> tuple[Numbers, Numbers]:
    size, angle = gait
    forward, lean = np.array([1.0, 0.0, 0.0]), posture[LEAN]
    hips = np.array([0.0, 0.0, 1.0]) * (HIP_Z - posture[CROUCH])
    spine = np.array([np.sin(lean), 0.0, np.cos(lean)])
    neck = hips + TORSO * spine
    segments: list[tuple[Numbers, Numbers]] = [(hips, neck), (neck + HEAD[0] * spine, neck + HEAD[1] * spine)]
    for left, hand in zip((1.0, -1.0), posture[HANDS].reshape(2, 3), strict=True):
        side = np.array([0.0, left, 0.0])
        phase = angle if left > 0 else angle + np.pi
        shoulder, hip = neck + SHOULDER_Y * side, hips + HIP_Y * side
        hand = hand - HAND_SWING * size * np.sin(phase) * forward  # against the leg of the same side
        elbow = _middle_joint(shoulder, hand, UPPER_ARM, FOREARM, np.array([-0.6, 0.5 * left, -0.6]))
        lift = FOOT_LIFT * (0.5 + 0.5 * np.cos(phase)) ** 2 * size
        foot = np.array([FOOT_SWING * size * np.sin(phase), HIP_Y * left, FOOT_Z + lift])
        knee = _middle_joint(hip, foot, THIGH, SHANK, forward)
        segments += [(shoulder, elbow), (elbow, hand), (hip, knee), (knee, foot)]
    ends = np.array(segments, dtype=np.complex128)  # (10, 2, 3), body frame
    yaw = posture[AZIMUTH] + np.pi + posture[HEADING]
    turned = ends @ np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    turned += posture[RHO] * np.array([np.cos(posture[AZIMUTH]), np.sin(posture[AZIMUTH]), 0])
    return turned[:, 0], turned[:, 1]


def _middle_joint(a: Numbers, b: Numbers, upper: float, lower: float, pole: Array) -> Numbers:
    """The elbow or knee of a two-link limb from a to b, on the side that `pole` points to."""
    line = b - a
    length = np.sqrt(line @ line)
    along = line / length
    foot = (length**2 + upper**2 - lower**2) / (2 * length)  # where the joint's plumb line meets the line a-b
    across = pole - (pole @ along) * along
    return a + foot * along + np.sqrt((upper**2 - foot**2) / (across @ across)) * across
