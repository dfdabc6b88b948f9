"""The certificates that are shipped hold for the shipped cell and for the present code."""

from __future__ import annotations

from dataclasses import replace

import pytest

from asc_rt.config import CELLS, load_arm, load_cell
from asc_rt.synthesis.certificate import file_name, load, refusals
from asc_rt.synthesis.certify import recheck

TOOLS = ["drill", "bat", "bare"]
SHIPPED = [(cell, tool) for cell in sorted(p.stem for p in CELLS.glob("*.toml")) for tool in TOOLS]


@pytest.mark.parametrize(("cell", "tool"), SHIPPED)
def test_every_shipped_cell_is_covered_with_every_tool(cell: str, tool: str) -> None:
    loaded = load_cell(cell)
    held = load_arm(loaded.params.robot.name, tool)[1]
    assert refusals(replace(loaded.params, tool=held), loaded.certificates) == []


@pytest.mark.parametrize(("cell", "tool"), SHIPPED)
def test_the_worst_states_are_still_what_the_code_computes(cell: str, tool: str) -> None:
    """Differs: M has changed. Raise certificate.METHOD and make the certificates again."""
    loaded = load_cell(cell)
    robot = loaded.params.robot.name
    found = load(loaded.certificates / file_name(robot, tool))
    assert recheck(found, *load_arm(robot, tool)) == []
