"""A cell is loaded whole or refused whole: every fault at once, one line each, and each line says where and what."""

from __future__ import annotations

import dataclasses
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asc_rt import config
from asc_rt.config import CELLS, ConfigError, load_cell, what_if
from asc_rt.core.params import Params
from calibration import result as calibration
from drivers import registry


def faults(cell: str | Path = "fanuc-sim-truth", *overrides: str) -> tuple[str, ...]:
    with pytest.raises(ConfigError) as caught:
        load_cell(cell, overrides)
    assert all("\n" not in line for line in caught.value.lines)
    return caught.value.lines


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the data files that a test may spoil; `fanuc-sim-truth` means the copy."""
    for name in ("cells", "robots"):
        shutil.copytree(config.PACKAGE / name, tmp_path / name)
    monkeypatch.setattr(config, "CELLS", tmp_path / "cells")
    monkeypatch.setattr(config, "ROBOTS", tmp_path / "robots")
    monkeypatch.setattr(config, "TOOLS", tmp_path / "robots" / "tools")
    return tmp_path


def spoil(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


# --- what is loaded --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(p.stem for p in CELLS.glob("*.toml")))
def test_every_cell_that_we_ship_is_in_order(name: str) -> None:
    cell = load_cell(name)
    assert cell.name == name
    assert Params.from_canonical(cell.params.canonical()) == cell.params


def test_files_speak_degrees_and_milliseconds_the_parameters_si() -> None:
    cell = load_cell("fanuc-sim-truth", ["control.tracking_tolerance_deg=9", "human.age_limit_ms=150", "period_ms=4"])
    p = cell.params
    assert (p.period_ns, p.human.age_limit_ns) == (4_000_000, 150_000_000)
    assert p.tracking_tolerance == math.radians(9)
    assert p.robot.q_max[0] == math.radians(170)
    assert p.robot.dq_max[0] == math.radians(450)
    assert p.robot.command_latency_ns == 60_000_000
    assert cell.goals[0][0] == math.radians(-60)
    assert {c.link for c in p.tool.capsules} == {p.robot.flange}
    assert "fanuc" in cell.sim and cell.simulated
    assert cell.driver["name"] == "fanuc-j519" and "name" not in cell.driver_options


def test_overrides_go_over_the_file_and_are_remembered() -> None:
    plain, changed = load_cell("fanuc-sim-truth"), load_cell("fanuc-sim-truth", ["safety.d_min_m = 0.12", "tool=bat"])
    assert plain.params.safety.d_min == 0.1
    assert changed.params.safety.d_min == 0.12
    assert changed.params.tool.name == "bat"
    assert changed.overrides == ("safety.d_min_m = 0.12", "tool=bat")
    assert changed.text == plain.text


def test_a_cell_may_be_given_as_a_path(tmp_path: Path) -> None:
    copy = tmp_path / "mine.toml"
    shutil.copy(CELLS / "fanuc-sim-truth.toml", copy)
    assert load_cell(copy).path == copy


def test_the_goals_of_the_cell_are_clear_of_the_mounting_plane() -> None:
    cell = load_cell("fanuc-sim-truth")
    robot = cell.params.robot
    model = pin.buildModelFromXML(robot.urdf)
    data = model.createData()
    for goal in cell.goals:
        pin.framesForwardKinematics(model, data, np.array(goal))
        for c in (*robot.capsules, *cell.params.tool.capsules):
            if c.link in ("base", "j1"):
                continue
            placement = data.oMf[model.getFrameId(c.link)]
            lowest = min(placement.act(np.array(p))[2] for p in (c.p0, c.p1)) - c.radius
            assert lowest > 0.05, (goal, c.link)


# --- what is refused -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("safety.d_min_m=-0.1", ["safety.d_min_m", "-0.1 m", "0 to 2 m", "sign"]),
        ("safety.d_min_m=100", ["safety.d_min_m", "100 m", "unit"]),
        ("safety.k=nan", ["safety.k", "nan", "not a finite number"]),
        ("safety.eta=inf", ["safety.eta", "inf", "not a finite number"]),
        ("safety.k=0.6", ["safety.k", "0.6", "1"]),
        ("safety.v_max_m_s=0", ["safety.v_max_m_s", "0", "0.01"]),
        ("safety.k='3'", ["safety.k", "'3'", "a number"]),
        ("human.age_limit_ms=true", ["human.age_limit_ms", "True", "ms"]),
        ("human.age_limit_ms=0.2", ["human.age_limit_ms", "0.2 ms", "10 to 1000 ms"]),
        ("safety.d_mim_m=0.1", ["safety.d_mim_m", "unknown key", "did you mean 'd_min_m'"]),
        ("saftey.d_min_m=0.1", ["saftey", "unknown key", "did you mean 'safety'"]),
        ("period_ms=5", ["period_ms", "5 ms", "2, 4 or 8 ms"]),
        ("simulated=1", ["simulated", "true or false"]),
        ("realtime.cpu=1.5", ["realtime.cpu", "whole number"]),
        ("robot=lrmate_200", ["robot", "did you mean 'lrmate_200id'", "known"]),
        ("tool=dril", ["tool", "did you mean 'drill'", "bare"]),
        ("driver.name=fanuc-519", ["driver.name", "did you mean 'fanuc-j519'"]),
        ("driver.prt=1", ["driver", "'prt'", "port"]),
        ("driver.version=9", ["driver", "version", "9"]),
        ("bus.endpoint=127.0.0.1", ["bus.endpoint", "tcp/127.0.0.1:17447"]),
        ("bus.endpoint=tcp/0.0.0.0:17447", ["bus.endpoint", "0.0.0.0", "127.0.0.1", "[bus.remote]"]),
        ("bus.remote.endpoint=tcp/10.0.0.1:5", ["bus.remote.endpoint", "tcp/10.0.0.1:5"]),
        ("human.slow_age_ms=201", ["human.slow_age_ms", "201 ms", "at most human.age_limit_ms = 200 ms"]),
        ("human.slow_coverage=0.5", ["human.slow_coverage", "0.5", "at least human.least_coverage = 0.7"]),
        ('human.sensors=["a","a"]', ["human.sensors", "a, a", "each once"]),
        ("human.calibrations.persn=x.json", ["human.calibrations.persn", "did you mean 'person'?"]),
        ("task.goals_deg=[]", ["task.goals_deg", "0 values"]),
        ("task.goals_deg=[[1, 2]]", ["task.goals_deg[0]", "2 angles", "6 joints"]),
        ("task.goals_deg=[[171, 0, 0, 0, 0, 0]]", ["task.goals_deg[0][0]", "171 deg", "J1", "-170 to 170 deg"]),
        ("safety.activation_m=0.1", ["safety.activation_m", "above safety.d_min_m"]),
        ("safety.rearm_distance_m=0.05", ["safety.rearm_distance_m", "at least safety.d_min_m"]),
        ("human.calibration=missing.toml", ["human.calibration", "missing.toml"]),
        ("sim.fanuk.x=1", ["sim.fanuk", "did you mean 'fanuc'"]),
        ("control=3", ["control", "a table with"]),
        ("no-equals-sign", ["--set no-equals-sign", "key=value"]),
        ("name.x.y=1", ["--set name.x.y=1", "not a table"]),
    ],
)
def test_one_wrong_value_is_one_clear_line(override: str, words: list[str]) -> None:
    lines = faults("fanuc-sim-truth", override)
    assert len(lines) == 1, lines
    for word in words:
        assert word in lines[0]


def test_every_fault_is_told_at_once_and_with_the_file() -> None:
    lines = faults("fanuc-sim-truth", "safety.d_min_m=-1", "period_ms=5", "tool=dril", "task.spede=1")
    assert len(lines) == 4
    assert all("fanuc-sim-truth.toml: " in line for line in lines)


def test_malformed_toml_is_told_with_its_line(tmp_path: Path) -> None:
    bad = tmp_path / "bad.toml"
    bad.write_text('name = "x"\nrobot = \n')
    (line,) = faults(bad)
    assert f"{bad}:2: malformed TOML" in line


def test_unreadable_and_unknown_cells(tmp_path: Path) -> None:
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\xff\xfe\x00")
    assert "UTF-8" in faults(binary)[0]
    assert "no such cell file" in faults(tmp_path / "none.toml")[0]
    assert "did you mean 'fanuc-sim'" in faults("fanuk-sim")[0]


def test_only_a_simulated_cell_may_run_uncertified() -> None:
    assert load_cell("fanuc-sim-truth", ["uncertified=true"]).uncertified
    lines = faults("fanuc-sim-truth", "simulated=false", "uncertified=true")
    assert any("uncertified: this cell is real" in line for line in lines)


def test_a_real_cell_has_no_ground_truth() -> None:
    lines = faults("fanuc-sim-truth", "simulated=false")
    assert any("ground-truth" in line for line in lines)
    assert not any(": sim: " in line for line in lines), "what it is rehearsed with may stay in its file"


PROFILE = "robots/lrmate_200id/profile.toml"


@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        ("robots/tools/drill.toml", "mass_kg = 1.6", "mass_kg = 16", ["mass_kg", "16 kg", "payload", "7 kg"]),
        ("robots/tools/drill.toml", "mass_kg = 1.6", "mass_kg = -1.6", ["mass_kg", "-1.6 kg", "sign"]),
        ("robots/tools/drill.toml", "inertia = [0.0062,", "inertia = [0.62,", ["inertia", "solid body"]),
        ("robots/tools/drill.toml", "radius = 0.040", "radius = 40", ["radius", "40 m", "unit"]),
        (PROFILE, 'link = "j1"', 'link = "j7"', ["capsules[1].link", "'j7'"]),
        (PROFILE, 'flange = "flange"', 'flange = "flunge"', ["flange", "did you mean 'flange'"]),
        (PROFILE, '"J1"', '"A1"', ["joints.names[0]", "'A1'", "J1"]),
        (PROFILE, "[-170, 170]", "[-2.97, 2.97]", ["joints.position_deg[0]", "radians"]),
        (PROFILE, "[-170, 170]", "[170, -170]", ["joints.position_deg[0]", "lower limit first"]),
        (PROFILE, "[-170, 170]", "[-180, 180]", ["joints.position_deg[0]", "wider than the URDF"]),
        (PROFILE, "[450, 380", "[7.85, 380", ["joints.velocity_deg_s[0]", "7.85 deg/s", "unit"]),
        (PROFILE, "[450, 380", "[-450, 380", ["joints.velocity_deg_s[0]", "sign"]),
        (PROFILE, "[450, 380, ", "[450, ", ["joints.velocity_deg_s", "5 values for 6 joints"]),
        (PROFILE, "payload_kg", "payload", ["payload", "unknown key"]),
        (PROFILE, 'urdf = "lrmate_200id.urdf"', 'urdf = "x.urdf"', ["x.urdf", "No such file"]),
        ("robots/lrmate_200id/lrmate_200id.urdf", "<link", "<<link", ["lrmate_200id.urdf:", "malformed URDF"]),
    ],
)
def test_a_wrong_robot_or_tool_file_is_told_with_its_name(
    files: Path, file: str, old: str, new: str, words: list[str]
) -> None:
    spoil(files / file, old, new)
    lines = faults("fanuc-sim-truth")
    assert any(all(word in line for word in words) and Path(file).name in line for line in lines), lines


VALUES = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5), st.lists(st.integers(), max_size=3)
)


@given(table=st.sampled_from(["safety", "human", "task", "control", "realtime", "driver", "bus", "sim"]), value=VALUES)
def test_no_value_of_a_table_makes_the_loader_raise_anything_else(table: str, value: Any) -> None:
    faults("fanuc-sim-truth", f"{table}={value!r}")


# --- what if ---------------------------------------------------------------------------------------------------------


def test_what_if_changes_what_is_asked_and_nothing_else() -> None:
    params = load_cell("fanuc-sim-truth").params
    changed = what_if(params, ["safety.d_min_m=0.12"])
    assert changed.safety == dataclasses.replace(params.safety, d_min=0.12)
    assert dataclasses.replace(changed, safety=params.safety) == params


@pytest.mark.parametrize("change", ["safety.d_min_m=-1", "safety.dmin=1", "task.speed=0.1", "safety=3"])
def test_what_if_refuses_what_it_cannot_do(change: str) -> None:
    with pytest.raises(ConfigError):
        what_if(load_cell("fanuc-sim-truth").params, [change])


# --- a cell that sees ------------------------------------------------------------------------------------------------

SEEING = "fanuc-sim"


def test_the_messages_of_cameras_carry_the_hash_of_all_their_calibrations(files: Path) -> None:
    before = load_cell(SEEING)
    assert before.perception is not None
    digest = before.perception.digest
    assert before.params.human.sensors[0].calibration_hash == int.from_bytes(digest[:8], "big") != 0
    left = files / "cells" / SEEING / "left.json"
    dataclasses.replace(calibration.read(left), operator="somebody else").save(left)
    after = load_cell(SEEING).perception
    assert after is not None and after.digest != digest


def test_a_calibration_that_must_not_be_used_is_refused_with_the_cell(files: Path) -> None:
    folder = files / "cells" / SEEING
    good = calibration.read(folder / "left.json")
    for changed, said in [
        (dataclasses.replace(good, reasons=("chi2",)), "accepted"),
        (dataclasses.replace(good, valid_until="2020-01-01"), "expired"),
    ]:
        changed.save(folder / "left.json")
        (line,) = faults(SEEING)
        assert "perception.camera.left.calibration" in line and said in line
    good.save(folder / "left.json")
    spoil(folder / "left.json", '"hand-eye"', '"eye-hand"')
    (folder / "right.json").unlink()
    assert [key in line for key, line in zip(("left", "right"), faults(SEEING), strict=True)] == [True, True]


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ("human.calibration=ground-truth", "human.calibration"),
        ("perception.sensor=other", "perception.sensor"),
        ("perception.high=[1, 1, -1]", "perception.high"),
        ("perception.camera.left.device.port=0", "perception.camera.left.device"),
        ("perception.camera.left.device.name=kinect", "perception.camera.left.device"),
        ("perception.voxel_m=50", "perception.voxel_m"),
    ],
)
def test_what_is_wrong_with_the_cameras_is_one_line_with_its_key(change: str, key: str) -> None:
    assert [line for line in faults(SEEING, change) if f": {key}" in line]


PLAYED = {"pcd": 'files = ["a.pcd"], fx = 1, fy = 1, cx = 1, cy = 1'} | dict.fromkeys(
    ("recording", "azure-mkv"), 'file = "a"'
)


@pytest.mark.parametrize("name", sorted(PLAYED))
def test_a_real_cell_sees_no_recordings(name: str) -> None:
    camera = ', camera = "left"' if name == "recording" else ""
    device = f'perception.camera.left.device={{name = "{name}", {PLAYED[name]}{camera}}}'
    assert PLAYED.keys() == registry.FILES
    said = [line for line in faults(SEEING, device, "simulated=false") if "plays what was" in line]
    assert len(said) == 1 and "perception.camera.left.device" in said[0]
    load_cell(SEEING, (device,))


def test_cameras_without_a_perception_table_are_nobodys(files: Path) -> None:
    assert "human.calibration" in faults("fanuc-sim-truth", "human.calibration=cameras")[0]
