from __future__ import annotations

from collections.abc import Callable

import pytest

from asc_rt.config import load_cell
from asc_rt.core.params import Params


@pytest.fixture(scope="session")
def arm_params() -> Callable[[str], Params]:
    """Parameters of the LR Mate 200iD with the named tool."""
    return lambda tool: load_cell("fanuc-sim-truth", [f"tool={tool}"]).params
