"""Running a step, with the session replaced: what is asked, what is refused, what is written down."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from asc_rt.config import load_cell
from asc_rt.ladder import climb, command
from asc_rt.ladder.climb import Ladder, Person, Refused, rehearsal, session_of
from asc_rt.ladder.identity import cell_hash
from asc_rt.ladder.journal import FAIL, HARDWARE, PASS, SIM, Journal
from asc_rt.ladder.rules import Run
from asc_rt.supervisor import Session, StartError

KEY = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))


class Says(Person):
    def __init__(self, no: str = "") -> None:
        self.asked: list[str] = []
        self._no = no

    def says_yes(self, statement: str) -> bool:
        self.asked.append(statement)
        return statement != self._no

    def tell(self, what: str) -> None:
        """Not heard."""


@pytest.fixture
def session(monkeypatch: pytest.MonkeyPatch, passed: Callable[[int], Run]) -> dict[str, Any]:
    """`run_cell` copies a recording of lockstep; `steps`: of these only. `devices`: what doctor finds."""
    from drivers.base import Finding

    told: dict[str, Any] = {
        "done": True,
        "cells": [],
        "session": {},
        "error": None,
        "devices": [Finding("robot", True, "there")],
    }

    def run_cell(cell: Any, log: Path, seconds: float, operator: Any) -> Session:
        told["cells"].append(cell)
        if told["error"]:
            raise told["error"]
        operator._made = SimpleNamespace(is_done=told["done"])
        number = int(log.name.split("-")[0])
        log.write_bytes(passed(number).e.log.path.read_bytes())
        return Session(log, **{"started": True, "control_code": 0, **told["session"]})

    monkeypatch.setattr(climb, "run_cell", run_cell)
    monkeypatch.setattr(climb, "examine_cell", lambda cell: told["devices"])
    return told


def ladder(folder: Path, mode: str = SIM, cell: str = "fanuc-sim-truth", *overrides: str) -> Ladder:
    return Ladder.of(cell, list(overrides), mode, Journal(folder, KEY))


def test_a_step_that_passes_is_written_down_with_all_that_it_rests_on(tmp_path: Path, session: dict[str, Any]) -> None:
    it, person = ladder(tmp_path), Says()
    step = it.steps[0]
    entry = it.climb(step, person)
    assert (entry["verdict"], entry["failed"]) == (PASS, [])
    assert entry["cell_hash"] == cell_hash(load_cell("fanuc-sim-truth")) and entry["step_sha256"] == step.digest
    assert (tmp_path / entry["log"]).is_file() and len(entry["log_sha256"]) == 64
    assert entry["measures"]["cycles"] > 0
    assert person.asked == [*step.confirm, *step.asks]
    (cell,) = session["cells"]
    assert cell.sim["human"]["start_s"] == 1e6 and cell.params.task.speed == 0.5
    assert Journal(tmp_path, KEY).entries == [entry]


def test_the_speed_of_a_step_is_never_above_the_cells_own(tmp_path: Path, session: dict[str, Any]) -> None:
    for number in (1, 2, 3):
        it = ladder(tmp_path)
        it.climb(it.steps[number - 1], Says())
    assert [cell.params.task.speed for cell in session["cells"]] == [0.5, 0.5, 0.05]


def test_without_the_operators_yes_nothing_starts_and_the_step_fails(tmp_path: Path, session: dict[str, Any]) -> None:
    it = ladder(tmp_path)
    entry = it.climb(it.steps[0], Says(no=it.steps[0].confirm[1]))
    assert entry["verdict"] == FAIL and session["cells"] == [] and entry["log"] == ""
    assert entry["failed"] == [f"confirmed: the operator did not say yes to: {it.steps[0].confirm[1]}"]


def test_what_the_operator_did_not_see_fails_the_step(tmp_path: Path, session: dict[str, Any]) -> None:
    it = ladder(tmp_path)
    entry = it.climb(it.steps[0], Says(no=it.steps[0].asks[0]))
    assert [line.split(":")[0] for line in entry["failed"]] == ["seen"]


@pytest.mark.parametrize(
    ("told", "name"),
    [
        ({"control_code": 1}, "session"),
        ({"recorded": False}, "session"),
        ({"deaths": ["human ended"]}, "session"),
        ({"end": {"error": "the robot said no"}}, "session"),
    ],
)
def test_a_session_that_did_not_end_as_asked_fails_the_step(told, name, tmp_path, session) -> None:
    session["session"] = told
    it = ladder(tmp_path)
    assert [line.split(":")[0] for line in it.climb(it.steps[0], Says())["failed"]] == [name]


def test_a_step_that_somebody_ended_early_fails(tmp_path: Path, session: dict[str, Any]) -> None:
    session["done"] = False
    it = ladder(tmp_path)
    assert it.climb(it.steps[0], Says())["failed"] == ["done: ended before, or not done in 20 s"]


def test_a_session_that_does_not_start_fails_the_step(tmp_path: Path, session: dict[str, Any]) -> None:
    session["error"] = StartError("fanuc did not start: exit code 2")
    it = ladder(tmp_path)
    assert it.climb(it.steps[0], Says())["failed"] == ["session: fanuc did not start: exit code 2"]


def test_a_device_that_is_not_well_afterwards_fails_the_step(tmp_path: Path, session: dict[str, Any]) -> None:
    from drivers.base import Finding

    session["devices"] = [Finding("robot", False, "alarm SRVO-001", "clear it")]
    it = ladder(tmp_path)
    assert it.climb(it.steps[0], Says())["failed"] == ["device health: robot: alarm SRVO-001 | do: clear it"]


def test_an_audit_rule_that_is_broken_fails_the_step(tmp_path, session, monkeypatch) -> None:
    from logs.audit_finding import Finding

    monkeypatch.setattr("logs.audit.RULES", (lambda e: Finding("safety rows", False, "3 cycles"),))
    monkeypatch.setattr("logs.audit._report", lambda log, e, found: {"rules": [vars_of(f) for f in found]})
    it = ladder(tmp_path)
    assert it.climb(it.steps[0], Says())["failed"] == ["audit: safety rows: 3 cycles"]


def vars_of(finding: Any) -> dict[str, Any]:
    return {"name": finding.name, "holds": finding.holds, "detail": finding.detail}


def test_a_failed_step_blocks_the_next(tmp_path: Path, session: dict[str, Any]) -> None:
    it = ladder(tmp_path)
    session["session"] = {"control_code": 1}
    it.climb(it.steps[0], Says())
    with pytest.raises(Refused, match="step 2 listen: step 1 link comes first"):
        it.climb(it.steps[1], Says())
    assert it.passed_to == 0
    session["session"] = {}
    it.climb(it.steps[0], Says())
    assert it.passed_to == 1 and it.climb(it.steps[1], Says())["verdict"] == PASS


# --- a real cell -----------------------------------------------------------------------------------------------------


def test_a_real_cell_is_rehearsed_as_the_same_cell(real: Path, tmp_path: Path) -> None:
    sim, hardware = ladder(tmp_path, SIM, str(real)), ladder(tmp_path, HARDWARE, str(real))
    assert sim.cell.simulated and sim.cell.driver["host"] == "127.0.0.1"
    assert not hardware.cell.simulated and hardware.cell.driver["host"] == "192.168.1.10"
    assert sim.cell_hash == hardware.cell_hash


def test_the_hardware_is_refused_until_the_same_cell_passed_in_simulation(real, tmp_path, session) -> None:
    hardware = ladder(tmp_path, HARDWARE, str(real))
    with pytest.raises(Refused, match="not on the hardware before it passed in simulation"):
        hardware.climb(hardware.steps[0], Says())
    sim = ladder(tmp_path, SIM, str(real))
    assert sim.climb(sim.steps[0], Says())["verdict"] == PASS
    other = ladder(tmp_path, HARDWARE, str(real), "control.silence_cycles=13")
    with pytest.raises(Refused, match="another cell hash"):
        other.climb(other.steps[0], Says())
    again = ladder(tmp_path, HARDWARE, str(real))
    again.climb(again.steps[0], Says())
    assert [entry["mode"] for entry in again.journal.entries] == [SIM, HARDWARE]
    assert not session["cells"][-1].simulated and session["cells"][0].simulated


def test_a_real_robot_needs_a_pc_that_is_fit(real, tmp_path, session, monkeypatch) -> None:
    from drivers.base import Finding

    monkeypatch.setattr(climb, "examine_pc", lambda: [Finding("priority", False, "refused", "do this")])
    sim = ladder(tmp_path, SIM, str(real))
    assert sim.climb(sim.steps[0], Says())["verdict"] == PASS
    hardware = ladder(tmp_path, HARDWARE, str(real))
    failed = hardware.climb(hardware.steps[0], Says())["failed"]
    assert failed == ["device health: priority: refused | do: do this"]


def test_a_simulated_cell_is_no_hardware(tmp_path: Path) -> None:
    with pytest.raises(Refused, match="simulated = true"):
        ladder(tmp_path, HARDWARE)


def test_a_real_cell_without_simulated_devices_cannot_be_rehearsed(real: Path, tmp_path: Path) -> None:
    real.write_text(real.read_text().split("[sim.fanuc]")[0])
    with pytest.raises(Refused, match=r"needs \[sim.fanuc\] or \[sim.can\], and \[sim.human\]"):
        rehearsal(load_cell(real))


# --- the command -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["no-such-cell", "--sim"], "no-such-cell"),
        (["fanuc-sim-truth"], "run it with --sim"),
        (["--sim", "--step", "3"], "step 3 hold: step 2 listen comes first (sim): it was not run yet"),
        (["--sim", "--step", "11"], "a step from 1 to 10"),
        (["--sim", "--step", "4-2"], "a step from 1 to 10"),
        (["--sim", "--set", "safety.d_min_m=7"], "safety.d_min_m"),
    ],
)
def test_what_cannot_be_run_is_refused_in_one_line(arguments, says, tmp_path, capsys) -> None:
    try:
        code = command.main([*arguments, "-o", str(tmp_path)])
    except SystemExit as left:
        code = int(left.code or 0)
    err = capsys.readouterr().err
    assert code == 2 and says in err and err.splitlines()[-1].startswith("error: ")
    assert not (tmp_path / "journal.jsonl").exists()


def test_the_command_climbs_until_a_step_fails(tmp_path, session, capsys) -> None:
    assert command.main(["--sim", "--step", "1-2", "--json", "-o", str(tmp_path)]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert [row["verdict"] for row in told["rows"]] == [PASS, PASS] and told["passed_to"] == 2
    session["session"] = {"control_code": 1}
    assert command.main(["--sim", "--json", "-o", str(tmp_path)]) == 1
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert [(row["step"], row["verdict"]) for row in told["rows"]] == [(3, FAIL)] and told["passed_to"] == 2


def test_the_session_is_told_with_its_end(tmp_path: Path) -> None:
    lost = Session(tmp_path, started=True, control_code=0, deaths=["human ended"])
    assert not session_of(lost).holds and "human ended" in session_of(lost).detail
