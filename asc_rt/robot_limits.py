"""The robot's own limits put over the profile's: what the core plans with is inside both."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

from asc_rt.core.params import Params
from drivers.base import JointLimits


def within(params: Params, told: JointLimits | None) -> Params:
    """`params` with each joint limit the smaller of the profile's and of what the robot tells (None: nothing)."""
    if told is None:
        return params
    r = params.robot
    robot = dataclasses.replace(
        r,
        dq_max=_least(r.dq_max, told.dq_max),
        ddq_max=_least(r.ddq_max, told.ddq_max),
        dddq_max=_least(r.dddq_max, told.dddq_max),
    )
    return dataclasses.replace(params, robot=robot)


def _least(ours: Iterable[float], theirs: Iterable[float]) -> tuple[float, ...]:
    return tuple(min(float(a), float(b)) for a, b in zip(ours, theirs, strict=True))
