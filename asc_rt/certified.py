"""No certificate, no motion: asked before anything starts, and again once the robot has told its own limits."""

from __future__ import annotations

from asc_rt.config import Cell, ConfigError
from asc_rt.core.params import Params
from asc_rt.synthesis.certificate import refusals


def require(cell: Cell, params: Params | None = None) -> None:
    """ConfigError: no certificate covers the cell, or `params` as they are really decided with. A simulated cell may
    say `uncertified = true`; that is in its recording."""
    if cell.uncertified:
        return
    if reasons := refusals(params or cell.params, cell.certificates):
        raise ConfigError([f"certificate: {reason}" for reason in reasons])
