"""`asc bench log` measures what it says: every record of its loop is in its file."""

from pathlib import Path

import pytest

from asc_rt import realtime
from asc_rt.config import load_cell
from logs import bench


@pytest.mark.timeout(120)
def test_the_bench_of_recording_has_its_rows(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(bench, "CYCLES", 300)
    monkeypatch.setattr(bench, "RUNS", tmp_path / "runs")
    monkeypatch.setattr(realtime, "set_up", lambda priority, cpu: {})  # the test's own process stays as it is
    rows = {row["name"]: row for row in bench.bench_log("fanuc-sim-truth", load_cell("fanuc-sim-truth"))}
    assert list(rows) == ["ring_p50", "ring_p99.9", "logger", "recorded", "dropped"]
    assert (rows["recorded"]["value"], rows["dropped"]["value"]) == (300, 0)
    assert 0 < rows["ring_p50"]["value"] <= rows["ring_p99.9"]["value"]
    assert rows["logger"]["value"] > 0
    assert not any((tmp_path / "runs").iterdir())  # what was measured is gone
