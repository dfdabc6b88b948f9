"""`asc drives`: the drives of a robot, served by a person while nothing runs. Nothing is enabled, and nothing moves."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from asc_rt.config import Cell
from asc_rt.doctor import verdict
from drivers import registry
from drivers.base import Serviceable


def serve(cell: Cell, reset: Sequence[int], supported: bool, assign: int | None) -> dict[str, Any] | None:
    """What was found and done, as `asc doctor` tells it; None: the driver of this cell serves none."""
    driver = registry.driver_class(cell.driver["name"])(cell.driver_options)
    if not isinstance(driver, Serviceable):
        return None
    if assign is not None:
        return verdict(list(driver.assign(assign)))
    if reset:
        return verdict(list(driver.reset(cell.params.period_ns, reset, supported)))
    return verdict(list(driver.drives(cell.params.period_ns)))
