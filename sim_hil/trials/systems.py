"""The arms and tools of the trials: parameters from their data files, and the pose around which an arm works."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from asc_rt.config import load_arm
from asc_rt.core.params import HumanParams, Params, SafetyParams, TaskParams

Array = npt.NDArray[np.float64]

PERIOD_NS = {"panda": 1_000_000, "ur5e": 2_000_000}  # DATASHEET: torque interfaces of 1 kHz and 500 Hz
STREAMING_PERIOD_NS = 8_000_000  # DATASHEET: FANUC Stream Motion
# ASSUMED: an elbow-up pose with the tool in front of the arm, rad.
HOMES = {
    "panda": (0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8),
    "ur5e": (0.0, -1.4, 1.6, -1.8, -1.57, 0.0),
    "lrmate_200id": (0.0, 0.25, 0.2, 0.0, -1.45, 0.0),
    "lrmate_200id_7l": (0.0, 0.25, 0.2, 0.0, -1.45, 0.0),
    "crx_10ia_l": (0.0, -0.15, 0.15, 0.0, -1.45, 0.0),
}
AGE_LIMIT_NS, FUTURE_LIMIT_NS = 250_000_000, 20_000_000


@dataclass(frozen=True, slots=True)
class TrialSystem:
    """One arm with one tool, at one control level, under one index."""

    robot: str
    tool: str
    k: float
    control: str = "torque"
    d_min: float = 0.05  # m
    activation: float = 0.8  # m
    human_acceleration: float = 0.0  # m/s2
    v_max: float = 1.0  # m/s, the paper's

    @property
    def name(self) -> str:
        return f"{self.robot}+{self.tool}"

    @property
    def home(self) -> Array:
        """rad; a shortened Panda has a shortened home."""
        family = self.robot.partition("_")[0] if self.robot.startswith("panda") else self.robot
        n = len(load_arm(self.robot, self.tool)[0].joints)
        return np.array(HOMES[family][:n])

    def params(self) -> Params:
        """ConfigError: robot and tool do not fit."""
        robot, tool = load_arm(self.robot, self.tool)
        family = self.robot.partition("_")[0]
        return Params(
            period_ns=PERIOD_NS[family] if self.control == "torque" else STREAMING_PERIOD_NS,
            control=self.control,
            silence_cycles=12,
            tracking_tolerance=np.radians(8.0).item(),
            robot=robot,
            tool=tool,
            safety=SafetyParams(
                d_min=self.d_min,
                activation_distance=self.activation,
                k=self.k,
                eta=1.0,
                M_floor=0.3,
                human_acceleration=self.human_acceleration,
                rearm_distance=1.5 * self.d_min,
                v_max=self.v_max,
            ),
            human=HumanParams(AGE_LIMIT_NS, AGE_LIMIT_NS, FUTURE_LIMIT_NS),
            task=TaskParams(speed=0.5, goal_tolerance=0.01),
        )
