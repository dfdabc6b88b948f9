"""A line of the start-up checklist for each thing that can be wrong before an arm moves: it is refused by that line."""

from __future__ import annotations

import dataclasses
import json
import math
import struct
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from can_rig import Rig

from asc_rt import control
from asc_rt.config import load_cell
from asc_rt.core.system import System
from drivers.base import HandshakeError, LinkError
from drivers.can import arms, cia402_arm, start_up
from drivers.can.cia402_arm import Cia402Arm
from drivers.can.driver import Can
from drivers.can.stream import look
from sim_hil.can import cia402_drive
from sim_hil.can.line import FIRST_DRIVE

SICK = 3  # the drive that is not as it should be, counted from 0


class Corrupt(Counter[int]):
    """So many frames of every client are destroyed, whenever it comes."""

    def __missing__(self, node: int) -> int:
        return 17 if node < FIRST_DRIVE else 0


def drive(rig: Rig) -> Any:
    return rig.line.drives[SICK]


def ignores(rig: Rig, method: str) -> None:
    setattr(drive(rig), method, lambda *_: None)


def keeps_its_timeout(rig: Rig) -> None:
    answer = drive(rig)._register
    drive(rig)._register = lambda data: answer(data[:2] + b"\x33" + data[3:] if data[2] == 0x55 else data)


def refuses_its_timeout(rig: Rig) -> None:
    serve, write_1017 = drive(rig)._serve, b"\x17\x10"
    abort = struct.pack("<BHBI", 0x80, 0x1017, 0, cia402_drive.READ_ONLY)
    drive(rig)._serve = lambda data: abort if data[0] >> 5 == 1 and data[1:3] == write_1017 else serve(data)


def never_enables(rig: Rig) -> None:
    control = drive(rig)._control
    drive(rig)._control = lambda word: control(word & ~0x08)


BEFORE: dict[str, tuple[str, str, Callable[[Rig], Any]]] = {  # arm, line, what is wrong when the bus is opened
    "another master speaks": ("openarm", "listen", lambda rig: rig.strike("babble", 0, 0x55)),
    "a drive is missing": ("openarm", "scan", lambda rig: setattr(drive(rig), "is_silent", True)),
    "a node is missing": ("panda", "scan", lambda rig: setattr(drive(rig), "is_silent", True)),
    "two with one identifier": ("openarm", "scan", lambda rig: rig.line.echo.add(SICK)),
    "two with one node number": ("panda", "scan", lambda rig: rig.line.echo.add(SICK)),
    "another drive": ("openarm", "axis 4 identity", lambda rig: setattr(drive(rig).settings, "serial", 1)),
    "another node": ("panda", "axis 4 identity", lambda rig: drive(rig)._od.update({(0x1018, 4): 1})),
    "firmware": ("openarm", "axis 4 firmware", lambda rig: setattr(drive(rig).settings, "firmware", 1)),
    "revision": ("panda", "axis 4 firmware", lambda rig: drive(rig)._od.update({(0x1018, 3): 1})),
    "control mode": ("openarm", "axis 4 mode", lambda rig: setattr(drive(rig).settings, "mode", 2)),
    "no torque mode": ("panda", "axis 4 modes", lambda rig: drive(rig)._od.update({(0x6502, 0): 0x180})),
    "velocity range": ("openarm", "axis 4 scale", lambda rig: setattr(drive(rig).settings, "velocity", 10.001)),
    "gear": ("panda", "axis 4 scale", lambda rig: drive(rig)._od.update({(0x6091, 1): 101})),
    "least position": ("panda", "axis 4 limits", lambda rig: drive(rig)._od.update({(0x607D, 1): -6_408_171})),
    "greatest position": ("panda", "axis 4 limits", lambda rig: drive(rig)._od.update({(0x607D, 2): -145_600})),
    "rated torque": ("panda", "axis 4 scale", lambda rig: drive(rig)._od.update({(0x6076, 0): 86_999})),
    "destroyed frames": ("openarm", "bus state", lambda rig: setattr(rig.line.bus, "corrupt", Corrupt())),
}


def held_up(rig: Rig) -> None:
    """Nobody answers for a while; then all is well."""
    deaf, begin = rig.driver._link.receive, rig.now_ns()

    def receive(deadline_ns: int) -> Any:
        if begin + 40_000_000 < rig.now_ns() < begin + 80_000_000:
            rig.run(max(0, deadline_ns - rig.now_ns()))
            return None
        return deaf(deadline_ns)

    rig.driver._link.receive = receive  # type: ignore[method-assign]


AFTER: dict[str, tuple[str, str, Callable[[Rig], Any]]] = {  # what goes wrong once the bus is known to be well
    "a drive in fault": ("openarm", "power", lambda rig: rig.strike("trip", SICK + 1)),
    "no voltage": ("panda", "power", lambda rig: rig.strike("safe_torque_off", SICK + 1)),
    "lost answers": ("openarm", "rehearsal", lambda rig: rig.strike("lose", SICK + 1, 3)),
    "lost frames of a node": ("panda", "rehearsal", lambda rig: rig.strike("lose", SICK + 1, 3)),
    "answers too late": ("openarm", "rehearsal", held_up),
    "an arm that swings": ("openarm", "seed", lambda rig: rig.line.mechanics.dq.__setitem__(0, 2.5)),
    "out of its range": ("openarm", "home", lambda rig: rig.line.mechanics.q.__setitem__(SICK, -0.2)),
    "keeps its time-out": ("openarm", "axis 4 watchdog", keeps_its_timeout),
    "refuses its time-out": ("panda", "axis 4 watchdog", refuses_its_timeout),
    "ignores to be enabled": ("openarm", "enable axis 4", lambda rig: ignores(rig, "_special")),
    "is never ready": ("panda", "enable axis 4", never_enables),
    "a brake that stays closed": ("panda", "brake of axis 4", lambda rig: rig.strike("brake", SICK + 1, 1.0)),
    "a contact that tells closed": ("panda", "brake of axis 4", lambda rig: rig.strike("contact", SICK + 1, 1.0)),
    "gives way": ("openarm", "hold", lambda rig: rig.line.mechanics.load.__setitem__(0, 12.0)),
}


def rig_of(arm: str, **options: Any) -> Rig:
    first = 1000 if arm == "openarm" else 2000
    rig = Rig(arm, serials=tuple(range(first, first + 7)), **options)
    rig.line.on_stand = arm == "openarm"
    return rig


@pytest.mark.parametrize("wrong", BEFORE)
def test_what_is_wrong_on_the_bus_refuses_the_start(wrong: str) -> None:
    arm, line, spoil = BEFORE[wrong]
    rig = rig_of(arm)
    spoil(rig)
    with pytest.raises(HandshakeError, match=f"start-up refused: .*{line}: ") as refused:
        rig.driver.configure()
    assert refused.value.hint
    assert [found.name for found in rig.driver.checklist if not found.ok][0] == line
    assert not any(d.is_enabled for d in rig.line.drives)


@pytest.mark.parametrize("wrong", AFTER)
def test_what_goes_wrong_with_the_arm_refuses_the_start(wrong: str) -> None:
    arm, line, spoil = AFTER[wrong]
    rig = rig_of(arm, hold_s=0.3)
    rig.line.on_stand &= line != "seed"
    rig.driver.configure()
    spoil(rig)
    with pytest.raises(HandshakeError, match=f"start-up refused: {line}: ") as refused:
        rig.driver.activate(rig.period_ns)
    assert refused.value.hint
    if not line.startswith(("enable", "brake", "hold")):
        assert not any(d.is_enabled for d in rig.line.drives), "nothing is enabled before all is known to be well"


def test_an_answer_that_comes_late_is_not_lost() -> None:
    """5 ms after its command, where the next one goes after 4: two of that axis in one cycle."""
    rig = rig_of("openarm")
    rig.driver.configure()
    stream, told = rig.driver._new_stream(), []
    for late in ({}, {SICK: 5_000_000}, {}, {}):
        rig.line.late = late
        start_up._cycle(stream, look(7))
        told.append((stream.axes[SICK].lost, stream.counters.late_answers))
    assert told == [(0, 0), (1, 0), (0, 1), (0, 1)]


@pytest.mark.parametrize("arm", ["openarm", "panda"])
def test_without_anything_wrong_it_starts(arm: str) -> None:
    rig = rig_of(arm)
    rig.driver.configure()
    rig.driver.activate(rig.period_ns)
    assert all(found.ok for found in rig.driver.checklist) and all(d.is_enabled for d in rig.line.drives)
    lines = {found.name.split()[-1] if found.name.startswith("axis") else found.name for found in rig.driver.checklist}
    assert {
        "robot",
        "bit timing",
        "bus load",
        "when this PC dies",
        "listen",
        "scan",
        "bus state",
        "rehearsal",
        "home",
    } < lines
    assert {"identity", "firmware", "scale", "watchdog", "hold"} < lines


@pytest.mark.parametrize(("sign", "zero"), [(1, 0), (-1, 0), (1, 5000), (-1, -5000)])
def test_the_limits_of_a_drive_are_those_of_its_joint_to_the_count(sign: int, zero: int) -> None:
    """By hand: 131072 counts a turn of the motor, a hundred turns; a drive that turns the other way swaps the two."""
    counts = sorted(sign * round(deg / 360 * 131072 * 100) + zero for deg in (-176.001, -3.999))
    arm = cast(Cia402Arm, arms.ARMS["panda"])
    scale = dataclasses.replace(arm.scales[3], sign=sign, zero=zero)
    for low, high, ok in ((0, 0, True), (1, 0, False), (0, -1, False), (-1, 0, False), (0, 1, False)):
        told = {1: SimpleNamespace(raw=counts[0] + low), 2: SimpleNamespace(raw=counts[1] + high)}
        line = cia402_arm._limits("axis 4", cast(Any, {0x607D: told}), scale, arm.joints[3])
        assert line.ok is ok and str(counts[0] + low) in line.detail
        assert f"607Dh:01 = {counts[0]} and 607Dh:02 = {counts[1]}" in line.fix


@pytest.mark.parametrize("name", ["openarm-sim", "panda-torque-sim"])
def test_a_cell_that_goes_farther_than_the_drives_is_refused_with_the_figure(name: str) -> None:
    cell = load_cell(name)
    rig = rig_of(cell.driver["arm"])
    caps = rig.driver.configure()
    rig.driver.close()
    control._check(caps, System(cell.params))
    for low, high in ((-0.001, 0.0), (0.0, 0.001)):
        robot = cell.params.robot
        q_min, q_max = list(robot.q_min), list(robot.q_max)
        q_min[SICK], q_max[SICK] = q_min[SICK] + low, q_max[SICK] + high
        wide = dataclasses.replace(robot, q_min=tuple(q_min), q_max=tuple(q_max))
        with pytest.raises(HandshakeError, match="goes farther .*: joint 4: .* in the cell, .* in the") as refused:
            control._check(caps, System(dataclasses.replace(cell.params, robot=wide)))
        assert f"{math.degrees(q_min[SICK]):.4f} to {math.degrees(q_max[SICK]):.4f} deg" in str(refused.value)
        assert "position_deg" in refused.value.hint and "joint 3" not in str(refused.value)


def test_what_is_set_in_a_drive_before_it_is_enabled() -> None:
    """Spare PDOs off, because anybody who sends on them would command the axis; who watches whom, and for how long."""
    rig = rig_of("panda", watchdog_ms=40.0)
    rig.driver.configure()
    rig.driver.activate(rig.period_ns)
    for d in rig.line.drives:
        od = cast(Any, d)._od
        assert [od[index, 1] >> 31 for index in (0x1400, 0x1401, 0x1402, 0x1403)] == [0, 0, 0, 1]
        assert [od[index, 1] >> 31 for index in (0x1800, 0x1801)] == [0, 1]
        assert od[0x1016, 1] == 127 << 16 | 40 and od[0x1401, 5] == 40 and od[0x1017, 0] == 50
        assert (od[0x605A, 0], od[0x6007, 0], od[0x60C2, 1], od[0x60C2, 2]) == (6, 3, 4, -3)
        assert od[0x60FE, 1] == 0 and od[0x60FE, 2] == 1
    rig = rig_of("openarm", watchdog_ms=40.0)
    rig.driver.configure()
    rig.driver.activate(rig.period_ns)
    assert [cast(Any, d).settings.timeout for d in rig.line.drives] == [800] * 7


def test_a_setting_that_a_drive_does_not_take_refuses_the_start(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cia402_drive, "_WRITABLE", cia402_drive._WRITABLE - {0x605A})
    rig = rig_of("panda")
    with pytest.raises(HandshakeError, match="axis 1: node 1: "):
        rig.driver.configure()


def test_without_a_bus_there_is_no_start(tmp_path: Path) -> None:
    options = {"interface": "asc-sim", "channel": "nobody-serves-this", "arm": "openarm", "lock_dir": str(tmp_path)}
    with pytest.raises(LinkError, match="start-up refused: robot: ") as refused:
        Can(options).configure()
    assert refused.value.hint


def test_a_cycle_that_fills_the_bus_refuses_the_start_with_the_figure() -> None:
    with pytest.raises(HandshakeError, match=r"bus load: \d+\.\d% of 1 Mbit/s in the worst case, at most 80%"):
        rig_of("panda", period_ms=2.0).driver.configure()


def test_a_drive_that_goes_limp_in_silence_is_refused_without_a_brake(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = arms.ARMS["openarm"]
    limp = [dataclasses.replace(joint, holds_on_silence=i != SICK) for i, joint in enumerate(whole.joints)]
    monkeypatch.setitem(arms.ARMS, "openarm", dataclasses.replace(whole, joints=tuple(limp)))  # type: ignore[type-var]
    with pytest.raises(HandshakeError, match=r"when this PC dies: axes \[4\] have no brake and go limp"):
        rig_of("openarm").driver.configure()


@pytest.mark.parametrize(
    ("left", "told"),
    [
        (None, "the last session did not end cleanly"),
        ("nonsense", "the last session did not end cleanly"),
        (json.dumps({"q": [0.0, 0.0, 0.0, 0.04, 0.0, 0.0, 0.0]}), r"axis 4 by -0\.040 rad"),
    ],
)
def test_an_arm_that_is_not_where_it_was_left_is_refused(tmp_path: Path, left: str | None, told: str) -> None:
    home = tmp_path / "home.json"
    if left is not None:
        home.write_text(left)
    rig = rig_of("openarm", home=str(home))
    rig.driver.configure()
    with pytest.raises(HandshakeError, match=f"start-up refused: home: {told}"):
        rig.driver.activate(rig.period_ns)


def test_a_clean_end_keeps_the_pose_for_the_next_start(tmp_path: Path) -> None:
    home = tmp_path / "home.json"
    home.write_text(json.dumps({"q": [0.0] * 7}))
    rig = rig_of("openarm", home=str(home))
    for _ in range(2):
        rig.driver.configure()
        rig.driver.activate(rig.period_ns)
        assert not home.exists(), "while a session runs the pose is not known"
        rig.driver.stop()
        np.testing.assert_allclose(json.loads(home.read_text())["q"], rig.line.mechanics.q, atol=1e-3)


def shown(**changes: Any) -> str:
    """As `ip -details -json link show can0` tells."""
    data = {"state": "ERROR-ACTIVE", "bittiming": {"bitrate": 1000000, "sample_point": "0.750"}}
    data |= {"data_bittiming": {"bitrate": 5000000, "sample_point": "0.750"}}
    link = {"ifname": "can0", "flags": ["NOARP", "UP", "LOWER_UP", "ECHO"], "mtu": 72, "txqlen": 64}
    kind = changes.pop("kind", "can")
    data |= changes.pop("data", {})
    return json.dumps([link | changes | {"linkinfo": {"info_kind": kind, "info_data": data}}])


@pytest.mark.parametrize(
    ("told", "wrong"),
    [
        (shown(), ""),
        (shown(flags=["NOARP"]), "is down"),
        (shown(data={"bittiming": {"bitrate": 500000}}), "500000 bit/s, not 1000000"),
        (shown(data={"data_bittiming": {"bitrate": 2000000}}), "2000000 bit/s in the data phase, not 5000000"),
        (shown(mtu=16), "carries no CAN FD"),
        (shown(txqlen=10), "queue of 10 frames, at least 64"),
        ("[]", "no such interface"),
        ("", "no such interface"),
    ],
)
def test_the_bit_timing_of_a_socketcan_interface_is_checked(
    monkeypatch: pytest.MonkeyPatch, told: str, wrong: str
) -> None:
    monkeypatch.setattr(start_up, "shown_by_ip", lambda channel: told)
    line = start_up.bit_timing(arms.ARMS["openarm"], "socketcan", "can0")
    assert line.name == "bit timing" and line.ok is not bool(wrong)
    assert wrong in line.detail and line.fix
