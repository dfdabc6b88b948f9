"""The certificates that are shipped hold for the shipped cell and for the present code."""

from __future__ import annotations

from dataclasses import replace

import pytest

from asc_rt.config import CELLS, load_arm, load_cell
from asc_rt.synthesis.certificate import file_name, load, refusals
from asc_rt.synthesis.certify import recheck

CERTIFICATES = CELLS / "certificates"
TOOLS = ["drill", "bat", "bare"]


@pytest.mark.parametrize("tool", TOOLS)
def test_the_shipped_cell_is_covered_with_every_tool(tool: str) -> None:
    params = load_cell("fanuc-sim").params
    held = load_arm(params.robot.name, tool)[1]
    assert refusals(replace(params, tool=held), CERTIFICATES) == []


@pytest.mark.parametrize("tool", TOOLS)
def test_the_worst_states_are_still_what_the_code_computes(tool: str) -> None:
    """Differs: M has changed. Raise certificate.METHOD and make the certificates again."""
    found = load(CERTIFICATES / file_name("lrmate_200id", tool))
    assert recheck(found, *load_arm("lrmate_200id", tool)) == []
