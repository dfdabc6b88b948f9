"""People who do everywhere what a camera finds hard: come from any side, crouch, reach, and hide behind the robot."""

from __future__ import annotations

import numpy as np

from sim_hil.person import AZIMUTH, OUTSIDE, PEAK, REACH_SPEED, REST_HANDS, RHO, Person

NEAREST = 0.85  # m from the base axis: the body beside the arm, not inside it


class Roamer(Person):
    """Walks in from a random side; then walks round the robot, crouches, reaches and waits there, in random order."""

    def _add_visit(self) -> None:
        rng = self._rng
        self._posture = self._posture.copy()
        self._posture[AZIMUTH] = rng.uniform(-np.pi, np.pi)  # outside, where nobody sees the jump
        self._walk("walk in", rho=rng.uniform(NEAREST, 1.1), azimuth=self._posture[AZIMUTH] + rng.uniform(-0.3, 0.3))
        self._turn(0.0)
        for _ in range(rng.integers(2, 5)):
            act = rng.integers(4)
            if act == 0:
                self._reach()
            elif act == 1:
                self._crouch()
            elif act == 2:
                self._walk_round(rng.uniform(-np.pi, np.pi))
            else:
                self._add("hide", rng.uniform(0.5, 2.0))
        self._walk("walk out", rho=OUTSIDE, azimuth=self._posture[AZIMUTH] + rng.uniform(-0.3, 0.3))

    def _near_azimuth(self) -> float:
        return float(self._posture[AZIMUTH])

    def _walk_round(self, angle: float) -> None:
        """Along a circle around the robot: the other side is behind it for one of the cameras."""
        way = abs(angle) * self._posture[RHO]
        self._add("round", PEAK * way / 1.3 + 0.1, walk=way, azimuth=self._posture[AZIMUTH] + angle)

    def _crouch(self) -> None:
        depth = self._rng.uniform(0.2, 0.4)
        down = REST_HANDS.reshape(2, 3) - np.array([0.0, 0.0, depth])
        seconds = PEAK * depth / self._rng.uniform(0.6, REACH_SPEED[0])
        self._add("crouch", seconds, crouch=depth, hands=down.ravel())
        self._add("crouching", self._rng.uniform(0.3, 1.2))
        self._add("rise", seconds, crouch=0.0, hands=REST_HANDS)
