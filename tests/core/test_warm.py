"""What the loop will meet is loaded before it begins."""

import pytest

from asc_rt.config import load_cell
from asc_rt.core import safe_control, warm
from asc_rt.core.system import System
from asc_rt.core.types import Status


@pytest.mark.parametrize("cell", ["fanuc-sim-truth", "openarm-sim", "panda-torque-sim"])
def test_the_filter_has_acted_before_the_robot_is_touched(cell: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Or its kernels are loaded in the first cycle that needs them: 30 ms late, with a person in the way."""
    seen, asked, step = set(), [], warm.step

    def watched(*args: object) -> object:
        made = step(*args)
        seen.add(made[1].decision.status)
        return made

    piqp = safe_control._of_piqp
    monkeypatch.setattr(safe_control, "_of_piqp", lambda *program: asked.append(len(program[1])) or piqp(*program))
    monkeypatch.setattr(warm, "step", watched)
    warm.warm_up(System(load_cell(cell).params))
    assert {Status.PASS, Status.FILTERED} <= seen
    n = load_cell(cell).params.n
    assert {n, n + 1} <= set(asked), "with and without a share"
    assert len(safe_control._keeps.signatures) == 1, "whoever solved it"
