"""What simulation and hardware are compared by, and the report of it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from asc_rt.ladder.journal import HARDWARE, SIM, Journal
from asc_rt.ladder.measures import measures
from asc_rt.ladder.report import comparison, distance, tracking, way_to_rest, write_report
from asc_rt.ladder.rules import Run
from asc_rt.ladder.steps import load_steps

KEY = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))
Passed = Callable[[int], Run]


def test_what_is_measured_of_a_motion(passed: Passed) -> None:
    found = measures(passed(5))
    assert found["goals"] == 2 and found["stops"] is None and found["min_distance_m"] > 1.0
    assert found["latency_ms"] == pytest.approx(48, abs=8)  # five buffered commands and the servo's lag
    assert 0 < found["tracking_rms_deg"] < found["tracking_worst_deg"] < 0.5
    json.dumps(found, allow_nan=False)


def test_what_is_measured_of_a_stop_and_of_people(passed: Passed) -> None:
    stop, dummy = measures(passed(6)), measures(passed(8))
    assert stop["stops"] == 3 and 0 < stop["stop_s"] <= stop["stop_allowed_s"]
    assert 0 < stop["stop_travel_deg"] <= stop["stop_travel_allowed_deg"]
    assert 0 < dummy["min_distance_m"] < 0.4 and dummy["photon_to_command_p50_ms"] > 25


def test_curves_end_where_the_arm_rests(passed: Passed) -> None:
    for t, way in way_to_rest(passed(6)):
        assert t[0] == 0.0 and way[-1] == 0.0 and way[0] > 1.0
    ((_, off),) = tracking(passed(5))
    assert off.max() == pytest.approx(measures(passed(5))["tracking_worst_deg"], abs=1e-3)
    ((_, d),) = distance(passed(8))
    assert min(d[d > 0]) == pytest.approx(measures(passed(8))["min_distance_m"], abs=1e-3)


def entry(run: Run, mode: str, folder: Path, **other: Any) -> dict[str, Any]:
    log = f"{run.step.name}-{mode}.mcap"
    (folder / log).write_bytes(run.e.log.path.read_bytes())
    return {
        "step": run.step.number, "mode": mode, "verdict": "PASS", "failed": [], "time": "2026-01-01T00:00:00Z",
        "cell_hash": "a" * 64, "log": log, "measures": measures(run), **other,
    }  # fmt: skip


def test_the_report_sets_simulation_and_hardware_side_by_side(tmp_path: Path, passed: Passed) -> None:
    journal = Journal(tmp_path, KEY)
    for number in (5, 6):
        journal.add(entry(passed(number), SIM, tmp_path))
    slower = {**measures(passed(5)), "latency_ms": measures(passed(5))["latency_ms"] + 7.0}
    journal.add(entry(passed(5), HARDWARE, tmp_path, measures=slower, failed=["follows: <late>"], verdict="FAIL"))
    told = write_report(journal, tmp_path / "report.html")
    assert told["compared"] == 1 and told["same_cell"] and len(told["rows"]) == 10
    row = told["rows"][4]
    assert row["difference"]["latency_ms"] == 7.0 and row["hardware"]["verdict"] == "FAIL"
    assert told["rows"][5]["hardware"] is None and told["rows"][5]["difference"] == {}
    assert json.loads((tmp_path / "report.json").read_text()) == told
    assert (tmp_path / "report.png").read_bytes().startswith(b"\x89PNG")
    page = (tmp_path / "report.html").read_text()
    assert "follows: &lt;late&gt;" in page and "stop_travel_deg" in page and "not run" in page


def test_runs_of_two_cells_are_told_apart(tmp_path: Path, passed: Passed) -> None:
    entries = [entry(passed(5), SIM, tmp_path), entry(passed(5), HARDWARE, tmp_path, cell_hash="b" * 64)]
    assert not comparison(load_steps(), entries)["same_cell"]


def test_the_report_of_an_empty_journal_says_that_nothing_was_run(tmp_path: Path) -> None:
    told = write_report(Journal(tmp_path, KEY), tmp_path / "empty")
    assert told["compared"] == 0 and (tmp_path / "empty.html").is_file()
