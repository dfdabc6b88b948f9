from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from asc_rt.config import CELLS, load_cell
from asc_rt.ladder import identity
from asc_rt.ladder.identity import cell_hash

WAS = cell_hash(load_cell("fanuc-sim-truth"))


@pytest.mark.parametrize(
    "change",
    [
        "driver.host=127.0.0.2",
        "driver.port=60099",
        "bus.endpoint=tcp/127.0.0.1:19999",
        "log.dir=elsewhere",
        "sim.human.seed=2",
        "sim.fanuc.lag_ms=20",
        "name=twin",
    ],
)
def test_where_things_are_and_what_is_simulated_does_not_count(change: str) -> None:
    assert cell_hash(load_cell("fanuc-sim-truth", [change])) == WAS


@pytest.mark.parametrize(
    "change",
    [
        "safety.d_min_m=0.11",
        "tool=bat",
        "robot=lrmate_200id_7l",
        "human.age_limit_ms=210",
        "task.speed=0.4",
        "control.silence_cycles=13",
        "driver.limits=false",
        "driver.version=2",
        "period_ms=4",
        "realtime.priority=81",
        "uncertified=true",
        "task.goals_deg=[[0, 0, 0, 0, -85, 0]]",
    ],
)
def test_what_decides_how_the_arm_moves_counts(change: str) -> None:
    assert cell_hash(load_cell("fanuc-sim-truth", [change])) != WAS


def test_comments_and_order_do_not_count_certificates_do(tmp_path: Path) -> None:
    shutil.copytree(CELLS / "certificates", tmp_path / "certificates")
    cell = tmp_path / "mine.toml"
    cell.write_text("# mine\n" + (CELLS / "fanuc-sim-truth.toml").read_text())
    assert cell_hash(load_cell(cell)) == WAS
    other = tmp_path / "certificates" / "lrmate_200id-bat.json"
    other.unlink()
    assert cell_hash(load_cell(cell)) == WAS, "another tool's"
    own = tmp_path / "certificates" / "lrmate_200id-drill.json"
    own.write_bytes(own.read_bytes() + b"\n")
    assert cell_hash(load_cell(cell)) != WAS


def test_our_code_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(
        identity.PACKAGE / "core", tmp_path / "asc_rt" / "core", ignore=shutil.ignore_patterns("__pycache__")
    )
    monkeypatch.setattr(identity, "PACKAGE", tmp_path / "asc_rt")
    monkeypatch.setattr(identity, "CODE", (tmp_path / "asc_rt",))
    cell = load_cell("fanuc-sim-truth")
    before = cell_hash(cell)
    gate = tmp_path / "asc_rt" / "core" / "gate.py"
    gate.write_text(gate.read_text() + "\n")
    assert cell_hash(cell) != before
