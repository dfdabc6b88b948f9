"""A script of CAN faults: what is no fault is refused in one line each, that says what would be right."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from sim_hil.can import server
from sim_hil.can.arms import ARMS
from sim_hil.can.faults import FAULTS, Fault, check_axes, parse_script
from sim_hil.can.line import Line
from sim_hil.can.mechanics import Joints


@pytest.mark.parametrize(
    ("entry", "told"),
    [
        ("trip", "is a table with at_s, fault, axis, value, not 'trip'"),
        ({"fault": "trip"}, "is a table with at_s, fault, axis, value"),
        ({"at_s": 1, "fault": "trip", "joint": 2}, "is a table with at_s, fault, axis, value"),
        ({"at_s": 1, "fault": "tirp"}, "'tirp' is no fault; faults: lose, late"),
        ({"at_s": 1, "fault": ["trip"]}, r"\['trip'\] is no fault; faults: lose, late"),
        ({"at_s": 1, "fault": {}}, "{} is no fault"),
        ({"at_s": -1, "fault": "trip"}, "at_s: -1 is no time; seconds"),
        ({"at_s": float("nan"), "fault": "trip"}, "at_s: nan is no time"),
        ({"at_s": True, "fault": "trip"}, "at_s: True is no time"),
        ({"at_s": 1, "fault": "trip", "axis": 1.0}, "axis: 1.0 is no axis; they count from 1"),
        ({"at_s": 1, "fault": "trip", "axis": -1}, "axis: -1 is no axis"),
        ({"at_s": 1, "fault": "trip", "value": "much"}, "value: 'much' is not possible"),
        ({"at_s": 1, "fault": "drift", "value": float("inf")}, "value: inf is not possible"),
        (
            {"at_s": 1, "fault": "babble", "value": 2048},
            "value: 2048 is not possible; of 'babble' a number from 0 to 2047",
        ),
        ({"at_s": 1, "fault": "hot", "value": 256}, "value: 256 is not possible; of 'hot' a number from 0 to 255"),
    ],
)
def test_what_is_no_fault_is_refused_in_one_line(entry: Any, told: str) -> None:
    with pytest.raises(ValueError, match=f"^sim.can: fault 2: .*{told}") as refused:
        parse_script([{"at_s": 0, "fault": "trip"}, entry], "sim.can")
    assert "\n" not in str(refused.value)


def test_axes_that_the_arm_does_not_have_are_refused() -> None:
    check_axes([Fault(0.0, "trip", 7)], 7)
    with pytest.raises(ValueError, match="^fault 'trip': axis 8 of 7$"):
        check_axes([Fault(0.0, "trip", 7), Fault(0.0, "trip", 8)], 7)


@pytest.mark.parametrize("name", FAULTS)
@pytest.mark.parametrize("arm", ["openarm", "panda"])
def test_every_fault_strikes_every_kind_of_drive(arm: str, name: str) -> None:
    line = Line(ARMS[arm].drives(False), Joints.arm(7))
    for axis in (0, 3):
        (fault,) = parse_script([{"at_s": 0.0, "fault": name, "axis": axis}], "test")
        fault.strike(line)
    while line.advance(5_000_000) is not None:
        pass


def test_a_script_with_a_mistake_ends_the_simulator_before_it_serves(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    script = tmp_path / "faults.toml"
    for text, told in (('axis = 8\nfault = "trip"', "axis 8 of 7"), ('fault = ["trip"]', "is no fault; faults: ")):
        script.write_text(f"[[faults]]\nat_s = 1\n{text}\n")
        assert server.main(["openarm-sim", "--faults", str(script)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("can: ") and told in line


def test_a_fault_over_the_bus_of_no_axis_is_told_and_ends_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    line = Line(ARMS["openarm"].drives(False), Joints.arm(7))
    serving = server.Server(line, "fault-script")
    serving._strike(Fault(0.0, "silence", 8))
    assert "axis 8 of 7" in capsys.readouterr().err and not any(drive.is_silent for drive in line.drives)
    serving._strike(Fault(0.0, "silence", 7))
    assert line.drives[6].is_silent
    serving.close()
