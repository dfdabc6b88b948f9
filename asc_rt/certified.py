"""No certificate, no motion: asked before anything starts, and again once the robot has told its own limits."""

from __future__ import annotations

import dataclasses

from asc_rt.config import Cell, ConfigError
from asc_rt.core.params import Params
from asc_rt.synthesis.certificate import refusals


def require(cell: Cell, params: Params | None = None) -> None:
    """ConfigError: no certificate covers the cell with its own tool, or `params` as they are really decided with. A
    simulated cell may say `uncertified = true`; that is in its recording."""
    if cell.uncertified:
        return
    if reasons := refusals((params or cell.params).holding(0), cell.certificates):
        raise ConfigError([f"certificate: {reason}" for reason in reasons])


def covered(cell: Cell, params: Params) -> tuple[Params, list[str]]:
    """`params` with each mounted tool marked whose certificate covers the arm with it, and why others are not: those
    are TOOL_UNCERTIFIED once they are mounted."""
    mounts, why = [], []
    for i, mount in enumerate(params.changer.mounts):
        reasons = [] if cell.uncertified else refusals(params.holding(i), cell.certificates)
        mounts.append(dataclasses.replace(mount, covered=not reasons))
        why += reasons
    changer = dataclasses.replace(params.changer, mounts=tuple(mounts))
    return dataclasses.replace(params, changer=changer), why
