"""The fault table of the cameras in the running cell: every process, cameras on the wire, and an operator who waits."""

from __future__ import annotations

import functools
import socket
from typing import Any

import pytest

from sim_hil import seeing_faults
from sim_hil.seeing_faults import CAMERAS, DEVICES, HANGING, Row, Rows
from tests.ports import free_port

pytestmark = [pytest.mark.real_time, pytest.mark.timeout(600)]

NAMED = {row.name: row for session in seeing_faults.SESSIONS for row in session}
SHORT: Rows = tuple(NAMED[name] for name in ("one camera frozen", "both clocks 300 ms ahead", "perception killed"))


@functools.cache
def session(rows: Rows) -> dict[str, dict[str, Any]]:
    """Told by row; one session for all of them."""
    robot, bus, left, right = free_port(kind=socket.SOCK_DGRAM), free_port(), free_port(), free_port()
    ports = (f"perception.camera.{name}.device.port={port}" for name, port in (("left", left), ("right", right)))
    settings = (f"driver.port={robot}", f"bus.endpoint=tcp/127.0.0.1:{bus}", *ports)
    return {told["fault"]: told for told in seeing_faults.table("fanuc-sim", settings, [rows])}


def check(row: Row, rows: Rows) -> None:
    told = session(rows).get(row.name)
    if told is None or not seeing_faults.is_safe(told):
        session.cache_clear()  # tried again, it is a new session
    assert told is not None, "it was never reached"
    assert seeing_faults.is_safe(told), told
    assert told["unarmed_s"] > seeing_faults.FAULT_S + seeing_faults.REST_S - 0.5


@pytest.mark.parametrize("row", SHORT, ids=lambda row: row.name)
def test_every_row_is_safe(row: Row) -> None:
    check(row, SHORT)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("row", "rows"),
    [(row, rows) for rows in (CAMERAS, DEVICES, HANGING) for row in rows],
    ids=lambda x: getattr(x, "name", ""),
)
def test_every_row_of_the_whole_table_is_safe(row: Row, rows: Rows) -> None:
    check(row, rows)


def test_what_is_not_safe_is_told_so() -> None:
    good = {"reacts_ms": 80, "rests_ms": 500, "greatest_speed_then": 0.0, "full_speed_ms": 70}
    assert seeing_faults.is_safe(good)
    for wrong in (
        {"reacts_ms": None}, {"reacts_ms": 401}, {"greatest_speed_then": 0.1}, {"rests_ms": None, "full_speed_ms": 900},
    ):  # fmt: skip
        assert not seeing_faults.is_safe(good | wrong), wrong
    assert seeing_faults.is_safe(good | {"rests_ms": None}), "slow all the time"
