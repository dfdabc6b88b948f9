"""A cell of several machines: who is let in, and how a sensor on another machine joins."""

from __future__ import annotations

from asc_rt import bus_keys, topics
from asc_rt.bus import Bus, BusError, Keys, Remote, open_client
from asc_rt.config import Cell


def door(cell: Cell) -> Remote | None:
    """What the router opens for other machines; None: it is on loopback only. Every sensor of the cell may come in."""
    if cell.remote is None:
        return None
    rights = {sensor.name: topics.rights(sensor.name) for sensor in cell.params.human.sensors}
    return Remote(cell.remote.endpoint, Keys.of(cell.remote.keys, bus_keys.CELL), rights)


def join(cell: Cell, sensor: str) -> Bus:
    """The bus of `cell`, which runs on another machine, as its sensor of that name. BusError: no way in."""
    if cell.remote is None:
        raise BusError(f"cell {cell.name} is for one machine", "give its file a table [bus.remote]")
    return open_client(cell.remote.endpoint, keys=Keys.of(cell.remote.keys, sensor))
