"""Today's code does what the golden recording shows, or somebody looks at the difference and updates it."""

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

from asc_rt.core.types import StopReason
from logs.recording import open_recording
from logs.replay import replay
from logs.summary import STOP_COLUMNS, exit_reason, stops

UPDATE = "look at `python tests/logs/golden.py`, and if it is meant so, --update"


@pytest.fixture(scope="module")
def golden() -> ModuleType:
    spec = importlib.util.spec_from_file_location("golden", Path(__file__).with_name("golden.py"))
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_golden_recording_replays(golden: ModuleType) -> None:
    if not golden.GOLDEN.exists():
        pytest.skip("no golden recording yet: python tests/logs/golden.py --update")
    report = replay(golden.GOLDEN)
    assert report.cycles > 100
    assert report.mismatches == 0, f"{report.first_difference}; {UPDATE}"


def test_the_story_is_told_and_small_enough_to_keep(golden: ModuleType, tmp_path: Path) -> None:
    path = tmp_path / "new.mcap"
    golden.make(path)
    assert path.stat().st_size < 300_000
    c = open_recording(path).columns(*STOP_COLUMNS)
    assert [stop["reason"] for stop in stops(c)] == [StopReason.HUMAN_STALE.name]
    assert exit_reason(c) == StopReason.SESSION_END.name
    assert golden.difference(path) == [f"{len(c['inputs.tick'])} cycles, nothing differs"]
    golden.make(path)
    assert replay(path).exact
