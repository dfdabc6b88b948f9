"""The tools of a cell: what its file says of them, which of them are certified, and the sphere around them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asc_rt.certified import covered, require
from asc_rt.config import ConfigError, load_arm, load_cell
from asc_rt.core.params import STAND_IN, Params
from asc_rt.enclosing import enclosing_sphere
from asc_rt.synthesis.certificate import load, with_limits

CELL = "fanuc-tools"


def test_the_cells_own_tool_is_first_and_the_stand_in_last() -> None:
    changer = load_cell(CELL, ["tool=bat"]).params.changer
    assert [m.number for m in changer.mounts] == [2, 1, 0, STAND_IN]
    assert [m.tool.name for m in changer.mounts] == ["bat", "drill", "bare", "enclosing-sphere"]
    assert changer.told_by_robot
    assert not any(m.covered for m in changer.mounts)  # nobody has looked yet
    assert load_cell("fanuc-sim-truth").params.changer.mounts == ()


def test_holding_a_tool_is_a_cell_with_that_tool_and_its_speed() -> None:
    params = load_cell(CELL).params
    held = params.holding(1)
    assert held.tool.name == "bat"
    np.testing.assert_allclose(held.robot.dq_max, 0.5 * np.array(params.robot.dq_max))
    assert held.changer.mounts == ()
    assert Params.from_canonical(params.canonical()) == params


def test_every_tool_of_the_shipped_cell_is_covered_the_sphere_too() -> None:
    cell = load_cell(CELL)
    params, why = covered(cell, cell.params)
    assert all(m.covered for m in params.changer.mounts), why


def test_the_stand_in_is_covered_with_the_limits_that_the_simulated_robot_tells() -> None:
    cell = load_cell(CELL)
    told = load(cell.certificates / "lrmate_200id-drill.json").limits  # made from a recording of that robot
    assert told.ddq_max < cell.params.robot.ddq_max
    params, why = covered(cell, replace(cell.params, robot=with_limits(cell.params.robot, told)))
    assert all(m.covered for m in params.changer.mounts), why


def test_each_tool_needs_its_own_certificate(tmp_path: Path) -> None:
    cell = load_cell(CELL)
    for name in ("drill", "bare"):
        file = f"lrmate_200id-{name}.json"
        (tmp_path / file).write_bytes((cell.certificates / file).read_bytes())
    cell = replace(cell, certificates=tmp_path)
    params, why = covered(cell, cell.params)
    assert [m.covered for m in params.changer.mounts] == [True, False, True, False]
    assert any("lrmate_200id-bat.json: missing" in line for line in why)
    require(cell)
    with pytest.raises(ConfigError, match="lrmate_200id-bat.json: missing"):
        require(cell, replace(cell.params, changer=replace(cell.params.changer, mounts=cell.params.changer.mounts[1:])))


def test_a_robot_too_weak_for_one_tools_certificate_is_not_moved_with_it() -> None:
    cell = load_cell(CELL)
    weak = replace(cell.params.robot, ddq_max=tuple(0.3 * a for a in cell.params.robot.ddq_max))
    params, why = covered(cell, replace(cell.params, robot=weak))
    assert not any(m.covered for m in params.changer.mounts)
    assert any("under the certified" in line for line in why)


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ("tool=ee2", "tools.mount: "),
        ("tools.nm_per_ampere=[1, 2]", "tools.nm_per_ampere: 2 values for 6 joints; one each for J1"),
        ("tools.told_by=nobody", "tools.told_by: nobody is not possible; one of robot or operator"),
        ("tools.mount=[]", "tools.mount"),
        ('tools.mount=[{number=1, tool="drill"}, {number=1, tool="bat"}]', "tools.mount.number: 1 stands there twice"),
        ('tools.mount=[{number=1, tool="dril"}]', "tool: 'dril' is unknown; did you mean 'drill'?"),
        ('tools.mount=[{number=-1, tool="drill"}]', "number: -1 is out of range"),
        ("tools.torque_tolerance_nm=0", "tools.torque_tolerance_nm: 0 Nm is out of range"),
    ],
)
def test_a_wrong_table_is_told_in_one_line(change: str, line: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_cell(CELL, [change])
    assert any(line in told for told in caught.value.lines), caught.value.lines


def test_the_sphere_encloses_every_tool_and_hardly_more() -> None:
    tools = [load_arm("lrmate_200id", name)[1] for name in ("drill", "bat", "bare")]
    (sphere,) = enclosing_sphere(tools, "flange").capsules
    far = max(
        float(np.linalg.norm(np.array(end) - sphere.p0)) + capsule.radius
        for tool in tools
        for capsule in tool.capsules
        for end in (capsule.p0, capsule.p1)
    )
    assert far <= sphere.radius
    assert sphere.radius < 0.5 * (0.6 + 0.02)  # the bat's tip is at 0.600 m, the flange at 0
    assert np.linalg.norm(sphere.p0) <= sphere.radius
