"""Parameters of the simulated controller: the [sim.fanuc] table of a cell."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from sim_hil.fanuc.alarms import LIMITS
from sim_hil.fanuc.arm import ARMS
from sim_hil.fanuc.tables import Tables
from sim_hil.fanuc.wire import USABLE_VERSIONS


@dataclass(frozen=True, slots=True)
class Settings:
    """`[sim.fanuc]` of a cell. Defaults are ASSUMED unless marked."""

    period_ms: float = 8.0  # DATASHEET R-30iB
    version: int = 3  # $STMO.$USABLE_VER
    start_move: int = 5  # $STMO.$START_MOVE, commands buffered before motion starts
    capacity: int = 10  # $STMO.$PKT_STACK. DATASHEET
    filter_cycles: int = 3  # $FLTR_LN: one cycle of delay
    lag_ms: float = 12.0  # with 5 buffered commands and the filter about 60 ms from set-point to motion
    start_threshold_deg: float = 1.0  # $STMO.$THRS_ABNPOS: first command against the measured pose
    brake_deg_s2: float = 1500.0  # how hard servos brake after an alarm
    program_starts: bool = True  # the TP program runs at power-on
    program_loops: bool = True  # after IBGN end it jumps back to IBGN start
    loop_cycles: int = 25  # how long that takes
    thresholds_while_waiting: bool = True  # some controllers do not answer while IBGN start waits
    limits: bool = False  # set-points are held against the limit tables, as the real controller does
    limit_alarms: int = 720  # or 609: the number of the velocity alarm of the software generation
    lenient: bool = False  # command numbers may skip ahead, as after the prefill of a well-known sample client
    payload_share: float = 1.0  # set at the controller; 1 = full, which is also what it takes if none is set
    thinning: int = 1  # version 3: while it brakes by itself it sends one status of so many
    tool: int = 0  # number of the tool in the changer at power-on; 0: none
    arm: str = "lrmate_200id"  # geometry and limit tables
    start_deg: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, -90.0, 0.0)  # where the arm is at power-on, URDF joints

    @classmethod
    def parse(cls, table: dict[str, Any], versions: tuple[int, ...] = USABLE_VERSIONS) -> Settings:
        """ValueError naming every wrong entry. `versions`: of the protocol that the wire knows."""
        known: dict[str, type] = {field.name: type(field.default) for field in fields(cls)}
        wrong = [f"unknown option {key!r} (known: {', '.join(known)})" for key in table if key not in known]
        if "start_deg" in table and not _is_pose(table["start_deg"]):
            wrong.append(f"start_deg must be six angles, not {table['start_deg']!r}")
        for key in table.keys() & known.keys() - {"start_deg", "arm"}:
            if not _is_amount(table[key], known[key]):
                wrong.append(f"{key} must be a non-negative {known[key].__name__}, not {table[key]!r}")
        for key in ("period_ms", "start_move", "filter_cycles", "brake_deg_s2"):
            if table.get(key) == 0:
                wrong.append(f"{key} must be above 0")
        for key, choices in (("arm", tuple(ARMS)), ("limit_alarms", tuple(LIMITS)), ("thinning", range(1, 16))):
            if key in table and table[key] not in choices:
                wrong.append(f"{key} must be one of {tuple(choices)}, not {table[key]!r}")
        if table.get("version", 3) not in versions:
            wrong.append(f"version must be one of {versions}, not {table['version']!r}")
        if wrong:
            raise ValueError("sim.fanuc: " + "; ".join(wrong))
        if "start_deg" in table:
            table = {**table, "start_deg": tuple(table["start_deg"])}
        settings = cls(**table)
        if settings.start_move > settings.capacity:
            raise ValueError("sim.fanuc: start_move must not be above capacity")
        return settings

    @property
    def period(self) -> float:
        return self.period_ms * 1e-3


def _is_amount(value: Any, kind: type) -> bool:
    kinds = {kind, int} if kind is float else {kind}
    return type(value) in kinds and bool(0 <= value < 1e6)


def _is_pose(value: Any) -> bool:
    """Six angles, none beyond a full turn."""
    if not isinstance(value, list | tuple) or len(value) != 6:
        return False
    return all(type(angle) in (int, float) and abs(angle) <= 360 for angle in value)


def thresholds(tables: Tables, axis: int, kind: int) -> dict[str, object]:
    """Fields of the threshold reply of axis 1-9; kind 0 velocity [deg/s], 1 acceleration [deg/s2], 2 jerk [deg/s3]."""
    there = axis <= tables.full_payload.shape[1]
    nothing = np.zeros(tables.full_payload.shape[2])
    return {
        "axis": axis,
        "kind": kind,
        "max_speed": tables.max_speed,
        "interval": 8,
        "no_payload": tables.no_payload[kind, axis - 1] if there else nothing,
        "full_payload": tables.full_payload[kind, axis - 1] if there else nothing,
    }
