"""Drives served by a person: a fault is reset at rest, cooled and carried, axis by axis, and nothing is enabled."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import Any, cast

import numpy as np
import pytest
from can_rig import Rig

from drivers.base import Finding, HandshakeError, Serviceable
from drivers.can.arms import ARMS
from drivers.can.driver import Can
from sim_hil.can.bus import Delivery

SICK = 2  # counted from 0
NAMES = ("openarm", "panda")


def held(arm: str) -> Rig:
    """A session at rest, with every drive enabled."""
    rig = Rig(arm, watchdog_ms=40.0)
    rig.line.on_stand = True
    rig.driver.configure()
    rig.driver.activate(rig.period_ns)
    return rig


def faulted(arm: str, fault: str, value: float = 1.0) -> Rig:
    """A session that the fault of one axis has ended, on its stand."""
    rig = held(arm)
    rig.strike(fault, SICK + 1, value)
    for _ in range(3):
        rig.wait()
        rig.driver.read(rig.now_ns() + rig.period_ns // 4)
    rig.driver.close()
    assert rig.driver.fault is not None
    rig.strike("stand")
    return rig


def reset(rig: Rig, *axes: int, supported: bool = True) -> dict[str, Finding]:
    return {line.name: line for line in rig.driver.reset(rig.period_ns, axes, supported)}


def wrong(lines: Iterator[Finding] | dict[str, Finding]) -> list[Finding]:
    return [line for line in (lines.values() if isinstance(lines, dict) else lines) if not line.ok]


def enabling(rig: Rig) -> list[Delivery]:
    """From now on every frame that could enable a drive."""
    seen: list[Delivery] = []

    def look(d: Delivery) -> None:
        data, number = d.frame.data, d.frame.id & 0x7FF
        if data == b"\xff" * 7 + b"\xfc" or (0x200 <= number < 0x500 and data and data[0] & 0x0F in (0x07, 0x0F)):
            seen.append(d)
        if 0x600 <= number < 0x680 and data[:3] == b"\x2b\x40\x60" and data[4] & 0x0F:
            seen.append(d)

    rig.line.listeners.append(look)
    return seen


@pytest.mark.parametrize("arm", NAMES)
def test_a_fault_is_reset_and_the_drive_stays_off_until_a_session_has_begun_anew(arm: str) -> None:
    rig = faulted(arm, "trip")
    with pytest.raises(HandshakeError, match=r"power: .*axis 3") as refused:
        rig.driver.configure()
        rig.driver.activate(rig.period_ns)
    assert "asc drives CELL --reset AXIS" in refused.value.hint
    rig.driver.close()
    (state,) = wrong(rig.driver.drives(rig.period_ns))
    assert state.name == "axis 3 state" and "--reset 3" in state.fix
    before = [drive.is_enabled for drive in rig.line.drives]
    seen = enabling(rig)
    lines = reset(rig, 3)
    assert not wrong(lines) and lines["axis 3 reset"].detail in ("it is disabled", "it is switch on disabled")
    assert [drive.is_enabled for drive in rig.line.drives] == before and not rig.line.drives[SICK].is_enabled
    assert not seen and not wrong(rig.driver.drives(rig.period_ns))
    rig.driver.configure()
    rig.driver.activate(rig.period_ns)
    assert all(drive.is_enabled for drive in rig.line.drives)


@pytest.mark.parametrize("arm", NAMES)
def test_a_drive_that_is_still_hot_is_not_reset(arm: str) -> None:
    rig = faulted(arm, "hot", 111.0)
    for celsius, ok in ((111.0, False), (86.0, False), (79.0, True)):
        rig.strike("hot", SICK + 1, celsius)
        lines = reset(rig, 3)
        assert lines["axis 3 heat"].ok is ok and ("axis 3 reset" in lines) is ok
    assert not wrong(lines)


def test_a_cause_that_is_not_over_is_told() -> None:
    rig = faulted("panda", "trip")
    rig.line.drives[SICK].voltage = False
    line = reset(rig, 3)["axis 3 reset"]
    assert (line.ok, line.detail) == (False, "it is fault") and "cause is not over" in line.fix
    rig.strike("power_on", SICK + 1)
    rig.line.drives[SICK]._word = 0x80  # as somebody else left it: there has to be an edge
    assert reset(rig, 3)["axis 3 reset"].detail == "it is switch on disabled"


def test_the_figure_that_a_drive_has_to_be_cooler_than() -> None:
    rig = faulted("openarm", "hot", 111.0)
    for celsius, ok in ((81.0, False), (80.0, True)):
        rig.strike("hot", SICK + 1, celsius)
        line = reset(rig, 3)["axis 3 heat"]
        assert (line.ok, line.detail) == (ok, f"{celsius:.0f} C, at most 80 C")


@pytest.mark.parametrize("arm", NAMES)
def test_what_holds_an_axis_is_asked_before_it_is_reset(arm: str) -> None:
    rig = faulted(arm, "trip")
    lines = reset(rig, 3, supported=False)
    has_brake = arm == "panda"
    assert lines["axis 3 weight"].ok is has_brake and ("axis 3 reset" in lines) is has_brake
    if not has_brake:
        assert "--supported" in lines["axis 3 weight"].fix and rig.line.drives[SICK].state > 1


@pytest.mark.parametrize("arm", NAMES)
def test_an_arm_that_moves_or_an_axis_without_a_fault_is_not_reset(arm: str) -> None:
    rig = faulted(arm, "trip")
    lines = reset(rig, 3, 4)
    assert [line.name for line in wrong(lines)] == ["axis 4 fault"] and "axis 3 reset" not in lines
    rig.line.on_stand = False
    rig.line.drives[SICK].jam_brake(closed=False, contact=False)
    rig.line.mechanics.dq[SICK], rig.line.mechanics.friction[SICK] = 0.1, 0.0
    lines = reset(rig, 3)
    assert [line.name for line in wrong(lines)] == ["at rest"] and "axis 3 reset" not in lines
    (line,) = wrong(rig.driver.reset(rig.period_ns, [0, 8], True))
    assert line.detail == "[0, 8] of 7"


@pytest.mark.parametrize("arm", NAMES)
def test_after_a_safe_torque_off_the_power_comes_first(arm: str) -> None:
    rig = faulted(arm, "safe_torque_off")
    lines = reset(rig, 3)
    assert not lines["axis 3 reset"].ok or arm == "panda"  # which is disabled, and latches nothing
    rig.strike("power_on", SICK + 1)
    if arm == "openarm":
        assert not wrong(reset(rig, 3))
    rig.driver.configure()
    rig.driver.activate(rig.period_ns)


def test_after_a_loss_of_communication_a_node_is_begun_anew_first() -> None:
    rig = held("panda")
    rig.driver._link.close()  # the session dies
    rig.run(1_000_000_000)
    assert all(drive.state == 0x08 and drive.brake_closed for drive in rig.line.drives)
    dead = rig.driver
    rig.driver = Can(rig.table, None, rig.open_bus, rig.now_ns)
    dead._lock.release()
    assert not wrong(reset(rig, *range(1, 8)))
    rig.driver.configure()
    rig.driver.activate(rig.period_ns)


def test_while_a_session_runs_nobody_looks_nor_resets() -> None:
    """Its questions would take drives out of the cycle."""
    rig = held("panda")
    other = Can(rig.table, None, rig.open_bus, rig.now_ns)
    said: list[Delivery] = []
    rig.line.listeners.append(said.append)
    asked = (other.reset(rig.period_ns, [3], True), other.drives(rig.period_ns), other.examine(rig.period_ns))
    for lines in (*asked, other.assign(3)):
        (line,) = lines
        assert line.name == "owner" and not line.ok and "stop process" in line.fix
    assert not said


@pytest.mark.parametrize("arm", NAMES)
def test_where_another_master_speaks_nothing_is_said(arm: str) -> None:
    """That one may be on another machine, which no lock knows of."""
    rig = Rig(arm)
    rig.strike("babble", 0, 0x55)
    ours: list[Delivery] = []
    rig.line.listeners.append(lambda d: ours.append(d) if d.frame.id != 0x55 else None)
    for lines in (rig.driver.examine(rig.period_ns), rig.driver.reset(rig.period_ns, [3], True), rig.driver.assign(3)):
        assert [line.name for line in wrong(lines)] == ["listen"]
    assert not ours


def test_a_drive_without_number_is_told_and_given_one() -> None:
    rig = Rig("panda")
    rig.strike("number", SICK + 1)
    with pytest.raises(HandshakeError, match="scan: node 3: 0 answers; a drive that has no node number") as refused:
        rig.driver.configure()
    assert "--assign NODE" in refused.value.hint
    (line,) = wrong(rig.driver.assign(4))
    assert line.detail == "node 4 is there already"
    (line,) = wrong(rig.driver.assign(8))
    assert line.detail == "8 is no node of this arm"
    lines = {line.name: line for line in rig.driver.assign(3)}
    assert not wrong(lines) and lines["number"].detail.endswith(f"[{0x1234}, 7, {0x0002_0001}, {2000 + SICK}]")
    assert rig.line.drives[SICK].node == 3
    (line,) = wrong(rig.driver.assign(5 - 2))
    assert line.detail == "node 3 is there already"
    rig.driver.configure()
    rig.driver.activate(rig.period_ns)


def test_a_drive_beyond_the_arm_that_has_no_number_is_not_overlooked() -> None:
    rig = Rig("panda")
    drives = [*rig.line.drives, copy.deepcopy(rig.line.drives[0])]
    drives[7].forget_number()
    drives[7].lss.identity = (0x1234, 7, 0x0002_0001, 77)
    rig.line.drives = drives
    rig.line.bus.join((1 << 20) + 7)
    with pytest.raises(HandshakeError, match="scan: 7 nodes, one answer each; a drive that has no node number"):
        rig.driver.configure()


def test_of_two_drives_without_number_one_gets_it_and_the_other_is_told() -> None:
    rig = Rig("panda")
    for axis in (3, 5):
        rig.strike("number", axis)
    assert not wrong(rig.driver.assign(3))
    assert sorted(drive.node for drive in rig.line.drives) == [1, 2, 3, 4, 6, 7, 255]
    with pytest.raises(HandshakeError, match="scan: node 5: 0 answers; a drive that has no node number"):
        rig.driver.configure()


def test_without_such_a_drive_or_its_memory_it_is_told() -> None:
    rig = Rig("panda")
    rig.strike("number", SICK + 1)
    rig.line.drives[SICK].lss.stores = False
    (line,) = wrong(rig.driver.assign(3))
    assert "LSS Error: 1" in line.detail
    rig = Rig("panda")
    rig.line.drives[SICK].is_silent = True
    (line,) = wrong(rig.driver.assign(3))
    assert line.detail == "no drive without a node number answers"
    (line,) = wrong(Rig("openarm").driver.assign(3))
    assert "take no number over this bus" in line.detail


def test_the_driver_is_serviceable() -> None:
    assert isinstance(cast(Any, Rig("yam").driver), Serviceable) and np.all([ARMS["yam"].joints])
