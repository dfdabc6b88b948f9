from __future__ import annotations

from pathlib import Path

import pytest

from asc_rt.config import load_cell
from asc_rt.ladder.steps import FOLDER, People, StepError, load_step, load_steps

GOOD = (FOLDER / "04-joints.toml").read_text()


def test_the_ladder_goes_from_the_link_to_a_person_in_the_cell() -> None:
    steps = load_steps()
    assert [step.number for step in steps] == list(range(1, 11))
    assert (steps[0].name, steps[-1].name) == ("link", "person")
    assert not any(step.task.arm for step in steps[:2])
    speeds = [step.task.speed for step in steps[2:5]]
    assert max(speeds) <= 0.05
    assert [step.name for step in steps if step.people is not People.NOBODY] == ["dummy", "person"]
    assert all(step.confirm for step in steps)


@pytest.mark.parametrize("step", load_steps(), ids=lambda step: step.name)
@pytest.mark.parametrize("cell", ["fanuc-sim-truth", "openarm-sim"])
def test_a_step_sets_a_simulated_cell_as_it_says(step, cell: str) -> None:
    load_cell(cell, [*step.sim, f"task.speed={step.task.speed:g}"])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (GOOD.replace("people =", "peoples ="), "people, peoples"),
        (GOOD.replace('goals = "joints"', 'goals = "away"'), "'away'"),
        (GOOD.replace("seconds = 120", "second = 120"), "second"),
        (GOOD.replace("goals = 12", 'goals = "many"'), "many"),
        (GOOD[:100], "Unterminated"),
    ],
)
def test_a_file_that_is_no_step_is_refused_with_its_name(text: str, says: str, tmp_path: Path) -> None:
    path = tmp_path / "04-joints.toml"
    path.write_text(text)
    with pytest.raises(StepError, match=f"^{path}: ") as error:
        load_step(path)
    assert says in str(error.value)


def test_steps_are_numbered_without_a_gap(tmp_path: Path) -> None:
    for name in ("01-link", "03-hold"):
        (tmp_path / f"{name}.toml").write_text((FOLDER / f"{name}.toml").read_text())
    with pytest.raises(StepError, match="without a gap"):
        load_steps(tmp_path)
