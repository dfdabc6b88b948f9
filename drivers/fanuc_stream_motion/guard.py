"""No command leaves that the controller would answer with an alarm."""

from __future__ import annotations

from collections.abc import Sequence
from math import dist

import numpy as np

from asc_rt.core.types import Matrix
from drivers.base import HandshakeError, JointLimits, ProtocolError
from drivers.fanuc_stream_motion import alarms
from drivers.fanuc_stream_motion.arms import ARMS, Arm
from drivers.fanuc_stream_motion.limits import LimitCheck, Tables, joint_limits
from drivers.fanuc_stream_motion.options import Options
from drivers.fanuc_stream_motion.packets import DOF, Command, Status, Thresholds

START_TOLERANCE = np.radians(0.5)  # first set-point against the measured pose
POSE_TOLERANCE = 0.005  # m; an exchanged J3 or arm is off by centimetres as soon as J2 has moved
LAST_STEP = 1e-5  # rad from the set-point before the last one to the last
# (3 kinds, 6 axes) for our own stop if no tables are known: below the published ones of a collaborative arm. ASSUMED
CAUTIOUS = np.radians([[120.0] * DOF, [250.0] * DOF, [1200.0] * DOF])


class Guard:
    def __init__(self, options: Options) -> None:
        self._options = options
        self._tables: Tables | None = None
        self._check: LimitCheck | None = None

    def take(self, told: Sequence[Thresholds]) -> None:
        """The controller's tables. HandshakeError: they are not whole."""
        try:
            self._tables = Tables(told, self._options.payload_share)
        except ValueError as error:
            raise HandshakeError(
                f"limit tables of {self._options.address}: {error}",
                hint="set driver.limits = false to rely on the profile's limits alone",
            ) from error

    def begin(self, period: float) -> None:
        """A session, nothing sent yet."""
        self._check = None if self._tables is None else LimitCheck(self._tables, self._arm, period)

    @property
    def limits(self) -> Matrix:
        """(3, 6) rad/s, rad/s2, rad/s3 of set-points at every flange speed that the cell allows."""
        return CAUTIOUS if self._tables is None else self._tables.least_up_to(self._flange_speed(self._tables))

    def joint_limits(self, rounding: float, period: float) -> JointLimits | None:
        """What the robot's tables mean for its joints; None: they were not asked for."""
        if self._tables is None:
            return None
        return joint_limits(self._tables, self._flange_speed(self._tables), rounding, period)

    def check_pose(self, status: Status) -> None:
        """HandshakeError: at these angles the flange is not where the robot says."""
        if not self._options.arm:
            return
        off = dist(self._arm.place(status.q), status.place)
        if off > POSE_TOLERANCE:
            raise HandshakeError(
                f"the robot's flange is {1e3 * off:.0f} mm from where a {self._options.arm} would have it at these"
                f" angles",
                hint="correct driver.arm; let statuses tell the face plate ($STMO.$STAT_US_TCP = FALSE), not the tool",
            )

    @property
    def _arm(self) -> Arm:
        return ARMS[self._options.arm]

    def _flange_speed(self, tables: Tables) -> float:
        return self._options.flange_speed or tables.max_speed

    def refuse(self, told: Command, sent: Sequence[Command], newest: Status) -> None:
        """ProtocolError: `told` after `sent` would be an offence."""
        if not sent:
            off = np.degrees(np.abs(told.q - newest.q).max())
            if off > np.degrees(START_TOLERANCE):
                raise _refusal(alarms.START_ALARM, f"the first is {off:.3g} deg from where the arm is")
        elif told.last and np.abs(told.q - sent[-1].q).max() > LAST_STEP:
            raise ProtocolError(
                "set-point not sent: the last one of a session, and the arm still moves",
                hint="brake first; end the session at rest",
            )
        breach = self._check.breach(told.q) if self._check is not None else None
        if breach is not None:
            raise _refusal(alarms.LIMIT_ALARMS[breach.kind], str(breach))

    def sent(self, told: Command) -> None:
        if self._check is not None:
            self._check.sent(told.q)


def _refusal(number: str, what: str) -> ProtocolError:
    return ProtocolError(
        f"set-point not sent, it would raise {number} ({alarms.MEANINGS[number].meaning}): {what}",
        hint="lower the limits in the robot's profile; take them from the robot",
    )
