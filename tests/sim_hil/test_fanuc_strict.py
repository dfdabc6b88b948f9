"""The simulated controller as strict as the real one: limit tables, signals, emergency stop, pendant, faults."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim_hil.fanuc import wire
from sim_hil.fanuc.arm import ARMS, KinematicPlant, to_wire
from sim_hil.fanuc.cabinet import MOVING, READY, SERVO_ON
from sim_hil.fanuc.controller import Controller
from sim_hil.fanuc.faults import FAULTS, Fault, FaultyController, Line, parse_script, read_script
from sim_hil.fanuc.settings import Settings
from sim_hil.fanuc.signals import RI, RO, Signals, Unassigned
from sim_hil.fanuc.tables import LR_MATE_200ID, LimitCheck

PC = ("127.0.0.1", 40001)
T = 0.008
START = np.array([10.0, 20.0, -30.0, 40.0, -50.0, 60.0])  # deg, J3 against the horizontal
REFERENCE = LR_MATE_200ID.at(0.0, 1.0)  # (3, 6): first stage, full payload


def check(period: float = T, payload: float = 1.0) -> LimitCheck:
    return LimitCheck(LR_MATE_200ID, payload, period, lambda pendant: np.zeros(3))


def excess(positions: np.ndarray[Any, Any], **kwargs: Any) -> Any:
    limits = check(**kwargs)
    return next((found for row in positions if (found := limits.excess(row)) is not None), None)


def one_axis(axis: int, way: list[float]) -> np.ndarray[Any, Any]:
    rows = np.tile(START, (len(way), 1))
    rows[:, axis] += way
    return rows


# --- tables ----------------------------------------------------------------------------------------------------------


def test_tables_are_interpolated_between_stages_and_payloads() -> None:
    tables = LR_MATE_200ID
    full, none = tables.full_payload[1, 0], tables.no_payload[1, 0]
    assert tables.at(4000.0, 1.0)[1, 0] == full[-1] == 500
    assert tables.at(0.0, 1.0)[1, 0] == tables.at(200.0, 1.0)[1, 0] == full[0]
    assert tables.at(500.0, 1.0)[1, 0] == pytest.approx((full[1] + full[2]) / 2)
    assert tables.at(4000.0, 0.25)[1, 0] == pytest.approx(0.25 * full[-1] + 0.75 * none[-1])
    assert tables.at(4400.0, 1.0)[1, 0] == pytest.approx(full[-1] + 2 * (full[-1] - full[-2]))


def test_the_limits_shrink_with_the_speed_of_the_flange() -> None:
    slow = LimitCheck(LR_MATE_200ID, 1.0, T, lambda pendant: np.zeros(3))
    fast = LimitCheck(LR_MATE_200ID, 1.0, T, lambda pendant: 1e9 * pendant[3:])
    way = one_axis(3, [0.0, 0.0, 0.9 * REFERENCE[2, 3] * T**3])
    assert all(slow.excess(row) is None for row in way)
    assert any(fast.excess(row) for row in way)


def way_to(kind: int, limits: np.ndarray[Any, Any], share: float, period: float) -> list[float]:
    """Positions whose velocity, acceleration or jerk comes to `share` of its limit, the other two staying below."""
    velocity, acceleration, jerk = limits
    match kind:
        case 0:
            t = np.linspace(0, 1, round(4.0 / period))
            v = share * velocity * t**2 * (3 - 2 * t)
        case 1:
            ramp = 0.9 * jerk * period * np.arange(1.2 * acceleration / jerk / period)
            v = np.cumsum(np.minimum(ramp, share * acceleration)) * period
        case _:
            return [0.0, share * jerk * period**3]
    return [0.0, *np.cumsum(v) * period]


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("period", [0.008, 0.004, 0.002])
@pytest.mark.parametrize("kind", range(3))
def test_99_percent_of_a_limit_passes_and_101_percent_does_not(kind: int, period: float, axis: int) -> None:
    limits = REFERENCE[:, axis]
    assert excess(one_axis(axis, way_to(kind, limits, 0.99, period)), period=period) is None
    found = excess(one_axis(axis, way_to(kind, limits, 1.01, period)), period=period)
    assert found is not None and found.kind == kind
    assert found.axis == axis + 1 or axis == 1  # J2 turns the mechanical J3 too


def test_both_conventions_of_j3_are_held_against_its_table() -> None:
    step = REFERENCE[2, 2] * T**3
    alone = one_axis(2, [0.0, 0.99 * step])
    assert excess(alone) is None
    j2 = one_axis(1, [0.0, 0.6 * step])
    assert excess(j2) is None
    together = alone.copy()
    together[1, 1] += 0.1 * step  # the sum is the mechanical J3
    assert excess(together).axis == 3


def test_the_first_position_is_no_movement() -> None:
    limits = check()
    assert limits.excess(START) is None
    limits.restart()
    assert limits.excess(START + 50) is None
    assert limits.excess(START + 51) is not None


# --- controller ------------------------------------------------------------------------------------------------------


class Bench:
    def __init__(self, **settings: Any) -> None:
        self.plant = KinematicPlant(np.radians([10, 20, -10, 40, -50, 60]), T)
        self.controller = Controller(self.plant, Settings(**settings))
        self.status: wire.Packet | None = None

    def cycle(self, *packets: bytes) -> None:
        for _, data in self.controller.cycle([(PC, data) for data in packets]):
            reply = wire.read_reply(data)
            self.status = reply if reply.name == "status" else self.status

    def stream(self, way: list[float], axis: int = 0, **fields: Any) -> None:
        if self.status is None:
            self.cycle(wire.write_request("start", 3))
        for position in one_axis(axis, way):
            assert self.status is not None
            number = self.status["sequence"]
            values = {"sequence": number, "data_style": 1, "position": [*position, 0, 0, 0], **fields}
            self.cycle(wire.write_request("command", 3, **values))

    @property
    def bits(self) -> int:
        assert self.status is not None
        return self.status["status"]

    @property
    def alarms(self) -> list[str]:
        return [alarm.number for alarm in self.controller.alarms]


def smooth(degrees: float, seconds: float) -> list[float]:
    t = np.linspace(0, 1, round(seconds / T) + 1)
    return list(degrees * t**3 * (10 - 15 * t + 6 * t**2))


@pytest.mark.parametrize(("family", "number"), [(720, "MOTN-722"), (609, "MOTN-611")])
def test_a_set_point_beyond_the_tables_is_an_alarm_with_its_number_axis_and_bytes(family: int, number: str) -> None:
    bench = Bench(limits=True, limit_alarms=family)
    bench.stream([0.0] * 10)
    bench.stream([0.004] * 10)
    assert bench.alarms == [number]
    assert "J1 jerk 7812.5, limit 5000" in bench.controller.alarms[0].text
    assert bench.controller.offences[0].data[:4] == b"\0\0\0\5"
    assert not bench.bits & READY
    np.testing.assert_allclose(bench.plant.q[0], np.radians(10), atol=1e-6)


def test_a_smooth_way_raises_nothing() -> None:
    bench = Bench(limits=True)
    bench.stream([0.0] * 10 + smooth(50.0, 1.0) + [50.0] * 20)
    assert bench.alarms == []
    np.testing.assert_allclose(np.degrees(bench.plant.q[0]), 60, atol=1e-3)


def test_an_emergency_stop_takes_servo_power_until_it_is_released_and_reset() -> None:
    bench = Bench()
    bench.stream([0.0] * 10 + smooth(50.0, 1.0)[:60])
    assert bench.bits & MOVING
    bench.controller.press_emergency_stop()
    for _ in range(60):
        bench.cycle()
    assert bench.alarms == ["SRVO-002"]
    assert not bench.bits & (READY | SERVO_ON | MOVING)
    bench.controller.reset()
    assert bench.alarms == ["SRVO-002"]
    bench.controller.release_emergency_stop()
    bench.controller.reset()
    bench.controller.run_program()
    bench.cycle()
    assert bench.bits == READY | SERVO_ON
    assert bench.controller.offences == []  # the PC did nothing wrong


def test_the_enabled_pendant_ends_the_program() -> None:
    bench = Bench()
    bench.stream([0.0] * 10)
    bench.controller.enable_pendant()
    bench.cycle()
    assert not bench.bits & READY
    bench.controller.reset()
    bench.controller.run_program()
    bench.cycle()
    assert not bench.bits & READY
    bench.controller.enable_pendant(False)
    bench.controller.reset()
    bench.controller.run_program()
    bench.cycle()
    assert bench.bits & READY


@pytest.mark.parametrize(("thinning", "gap", "nibble"), [(1, 1, 0), (4, 4, 4)])
def test_version_3_tells_fewer_statuses_while_it_brakes_by_itself(thinning: int, gap: int, nibble: int) -> None:
    bench = Bench(thinning=thinning, brake_deg_s2=200.0)
    bench.stream([0.0] * 10 + smooth(50.0, 1.0)[:60])
    numbers, bits = [], []
    for _ in range(40):  # silence
        before = bench.status
        bench.cycle()
        if bench.status is not before:
            assert bench.status is not None
            numbers.append(bench.status["sequence"])
            bits.append(bench.bits)
    braking = [number for number, b in zip(numbers, bits, strict=True) if b & MOVING and not b & READY]
    assert set(np.diff(braking)) == {gap}
    assert {b >> 4 for b in bits if b & MOVING and not b & READY} == {nibble}


def test_motor_currents_follow_the_torque_of_the_plant() -> None:
    bench = Bench()
    bench.plant.torque = np.array([10.0, -100.0, 50.0, 1.0, 1.0, 1.0])  # type: ignore[attr-defined]
    bench.cycle(wire.write_request("start", 3))
    assert bench.status is not None
    np.testing.assert_allclose(bench.status.axes("current")[:3], [0.08, 0.8, 1.0], rtol=1e-6)


# --- signals ---------------------------------------------------------------------------------------------------------


def test_a_read_window_is_told_in_every_status() -> None:
    bench = Bench(tool=5)
    bench.stream([0.0] * 3, read_type=RI, read_index=1, read_mask=0x3F)
    assert bench.status is not None
    assert (bench.status["read_type"], bench.status["read_index"], bench.status["read_mask"]) == (RI, 1, 0x3F)
    assert bench.status["read_value"] == 0b010111  # locked, present, tool 5
    assert bench.alarms == []


def test_the_changer_lets_go_when_told_and_takes_another_tool() -> None:
    bench = Bench(tool=5)
    bench.stream([0.0] * 3, write_type=RO, write_index=1, write_mask=1, write_value=1)
    assert bench.controller.signals.read(RI, 1, 0x3F) == 0
    bench.controller.signals.couple(3)
    assert bench.controller.signals.read(RI, 1, 0x3F) == 0  # it is told to let go
    bench.stream([0.0] * 3, write_type=RO, write_index=1, write_mask=1, write_value=0)
    bench.controller.signals.couple(3)
    assert bench.controller.signals.read(RI, 1, 0x3F) == 0b001111


@pytest.mark.parametrize(("kind", "index", "mask"), [(RO, 9, 1), (RO, 8, 3), (RI, 1, 1), (99, 1, 1), (RO, 0, 1)])
def test_writing_a_signal_that_is_not_there_raises_prio_023(kind: int, index: int, mask: int) -> None:
    bench = Bench()
    bench.stream([0.0] * 3, write_type=kind, write_index=index, write_mask=mask, write_value=mask)
    assert bench.alarms == ["PRIO-023"]
    with pytest.raises(Unassigned):
        Signals().write(kind, index, mask, mask)


# --- faults ----------------------------------------------------------------------------------------------------------


def carried(fault: str, value: int = 1) -> list[list[bytes]]:
    """What arrives of the packets 0, 1, 2... sent one a cycle, if the fault meets packet 1."""
    line, arrived = Line(), []
    for k in range(6):
        if k == 1:
            line.spoil(fault, 1, value)
        arrived.append([data for _, data in line.carry([(PC, bytes([k] * 80))], k)])
    return arrived


@pytest.mark.parametrize(
    ("fault", "wanted"),
    [
        ("lose", [[0], [], [2], [3], [4], [5]]),
        ("repeat", [[0], [1, 1], [2], [3], [4], [5]]),
        ("delay", [[0], [], [2], [1, 3], [4], [5]]),
        ("reorder", [[0], [], [2, 1], [3], [4], [5]]),
    ],
)
def test_the_line_does_what_the_fault_says(fault: str, wanted: list[list[int]]) -> None:
    assert [[data[0] for data in cycle] for cycle in carried(fault, value=2)] == wanted


def test_the_line_spoils_bytes() -> None:
    assert len(carried("truncate")[1][0]) == 40
    assert bytes.fromhex("7ff80000") in carried("nan")[1][0]
    assert len(carried("foreign")[1]) == 2


def test_a_script_runs_by_the_controllers_time() -> None:
    bench = Bench()
    script = [Fault.parse({"at_s": 0.4, "fault": "emergency_stop"}), Fault(0.16, "lose_status", count=3)]
    faulty = FaultyController(bench.controller, script)
    told = [len(faulty.cycle([(PC, wire.write_request("start", 3))] if k == 0 else [])) for k in range(60)]
    assert [k for k, count in enumerate(told) if not count] == [20, 21, 22]
    assert bench.alarms == ["SRVO-002"]


def test_a_script_changes_the_tool() -> None:
    bench = Bench(tool=5)
    faulty = FaultyController(bench.controller, parse_script([{"at_s": 0.04, "fault": "tool", "value": 7}], "script"))
    told = []
    for _ in range(8):
        faulty.cycle([])
        told.append(bench.controller.signals.read(RI, 3, 0xF))
    assert told == [5] * 5 + [7] * 3


def test_a_script_in_a_file_names_every_wrong_entry(tmp_path: Path) -> None:
    file = tmp_path / "faults.toml"
    file.write_text("[[faults]]\nat_s = 1\nfault = 'lose_status'\n")
    assert read_script(file) == [Fault(1, "lose_status")]
    file.write_text("[[faults]]\nat_s = 1\nfault = 'toaster'\n[[faults]]\nfault = 'reset'\n")
    with pytest.raises(ValueError, match=r"(?s)fault 1: .*toaster.*\n.*fault 2: a fault has at_s, fault") as caught:
        read_script(file)
    assert str(caught.value).count("\n") == 1
    for text, says in (
        ("at_s =", "malformed TOML"),
        ("toaster = 1", "nothing else is wanted"),
        ("faults = 3", "not 3"),
    ):
        file.write_text(text)
        with pytest.raises(ValueError, match=says):
            read_script(file)
    with pytest.raises(ValueError, match="cannot be read"):
        read_script(tmp_path / "nothing.toml")


@pytest.mark.parametrize("fault", FAULTS)
def test_every_fault_can_be_injected(fault: str) -> None:
    bench = Bench()
    faulty = FaultyController(bench.controller)
    faulty.inject(fault)
    for _ in range(5):
        faulty.cycle([(PC, wire.write_request("start", 3))])


@pytest.mark.parametrize(
    "entry",
    [
        {},
        {"at_s": 1},
        {"at_s": 1, "fault": "toaster"},
        {"at_s": -1, "fault": "reset"},
        {"at_s": 1, "fault": "reset", "count": 0},
        {"at_s": 1, "fault": "reset", "colour": 1},
        {"at_s": 1, "fault": "tool", "value": 16},
    ],
)
def test_a_wrong_script_is_refused(entry: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="fault"):
        Fault.parse(entry)


# --- arms ------------------------------------------------------------------------------------------------------------


def test_the_crx_stands_as_published() -> None:
    crx = ARMS["crx_10ia_l"]
    np.testing.assert_allclose(crx.place(np.zeros(6)), [0.700, -0.150, 0.710], atol=1e-12)
    np.testing.assert_allclose(crx.place(np.radians([0, 90, 90, 0, 0, 0])), [1.410, -0.150, 0.0], atol=1e-12)
    np.testing.assert_allclose(to_wire(np.radians([0, 90, 90, 0, 0, 0]))[:3], [0, 90, 0], atol=1e-12)
