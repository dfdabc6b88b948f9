"""No certificate, no motion: before the start, and with the limits that the robot tells."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from asc_rt.certified import require
from asc_rt.config import CELLS, ConfigError, load_cell


@pytest.mark.parametrize("name", sorted(path.stem for path in CELLS.glob("*.toml")))
def test_every_shipped_cell_is_certified(name: str) -> None:
    require(load_cell(name))


def test_every_reason_is_a_line_of_its_own() -> None:
    with pytest.raises(ConfigError) as caught:
        require(load_cell("fanuc-sim-truth", ["safety.k=1", "safety.eta=9"]))
    assert len(caught.value.lines) == 2
    assert all(
        line.startswith("certificate: ") and "lrmate_200id-drill.json: safety." in line for line in caught.value.lines
    )


def test_a_robot_that_can_do_less_than_was_certified_is_refused() -> None:
    cell = load_cell("fanuc-sim-truth")
    robot = replace(cell.params.robot, ddq_max=tuple(0.3 * a for a in cell.params.robot.ddq_max))
    with pytest.raises(ConfigError, match=r"ddq_max of J1 is 2\.618 rad/s2, under the certified"):
        require(cell, replace(cell.params, robot=robot))


def test_a_folder_without_certificates_refuses_unless_the_simulated_cell_says_so(tmp_path: Path) -> None:
    empty = f"certificates={tmp_path}"
    with pytest.raises(ConfigError, match="missing; no certificate for tool drill on lrmate_200id; make one: asc cert"):
        require(load_cell("fanuc-sim-truth", [empty]))
    require(load_cell("fanuc-sim-truth", [empty, "uncertified=true"]))
