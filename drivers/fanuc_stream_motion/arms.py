"""Where the flange is: the limit tables go by its speed, and a wrong arm or a wrong J3 shows in the pose that is told.

J1 turns about the vertical, J2 and J3 about parallel horizontal axes, J4, J5, J6 meet in the wrist (a CRX's J6 beside
it). SI and URDF joints; the world frame is at the crossing height of J1 and J2.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, sin

from asc_rt.core.types import Vector

Point = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Arm:
    """Lengths, m."""

    shoulder: float  # from the axis of J1 to J2
    upper: float  # J2 to J3
    rise: float  # J3 to the axis of J4
    fore: float  # along the axis of J4 to J5
    beside: float  # from J5 to the axis of J6
    flange: float  # along the axis of J6

    def place(self, q: Vector) -> Point:
        """The flange's centre, m, at `q` (6,) rad.

        p = Rz(q1) (s x + Ry(q2) u z + Ry(q2 - q3) ((f, 0, r) + Rx(-q4) Ry(-q5) (l, -b, 0))).
        """
        q1, q2, q3, q4, q5, _ = map(float, q)
        pitch = q2 - q3
        z5 = self.flange * sin(q5)
        along = self.fore + self.flange * cos(q5)
        across = -self.beside * cos(q4) + z5 * sin(q4)
        above = self.rise + self.beside * sin(q4) + z5 * cos(q4)
        ahead = self.shoulder + self.upper * sin(q2) + along * cos(pitch) + above * sin(pitch)
        height = self.upper * cos(q2) - along * sin(pitch) + above * cos(pitch)
        return (ahead * cos(q1) - across * sin(q1), ahead * sin(q1) + across * cos(q1), height)


# DATASHEET: the manufacturer's published descriptions.
ARMS = {
    "lrmate_200id": Arm(shoulder=0.050, upper=0.330, rise=0.035, fore=0.335, beside=0.0, flange=0.080),
    "lrmate_200id_7l": Arm(shoulder=0.050, upper=0.440, rise=0.035, fore=0.420, beside=0.0, flange=0.080),
    "crx_10ia": Arm(shoulder=0.0, upper=0.540, rise=0.0, fore=0.540, beside=0.150, flange=0.160),
    "crx_10ia_l": Arm(shoulder=0.0, upper=0.710, rise=0.0, fore=0.540, beside=0.150, flange=0.160),
}
