"""Runs a step: what the operator confirms, a session of the cell, its judges, the devices' health, the journal."""

from __future__ import annotations

import hashlib
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from asc_rt.bus import BusError
from asc_rt.certified import require
from asc_rt.config import Cell, load_cell
from asc_rt.doctor import examine_cell, examine_pc
from asc_rt.ladder.identity import cell_hash
from asc_rt.ladder.journal import FAIL, PASS, SIM, Entry, Journal, not_passed, refusal
from asc_rt.ladder.measures import measures
from asc_rt.ladder.operator import MakeOperator
from asc_rt.ladder.rules import Run, judge
from asc_rt.ladder.steps import Step, load_steps
from asc_rt.ring import RingError
from asc_rt.supervisor import Session, StartError, run_cell
from logs.audit import audit
from logs.audit_finding import Finding
from logs.mcap_scan import LogError

SAMPLE = 200  # cycles that the audit of a step runs again
SIMULATED_ADDRESS = {"fanuc": ("driver.host=127.0.0.1",), "can": ("driver.interface=asc-sim", "driver.channel={name}")}
YES = ("yes", "y")


class Refused(Exception):
    """Nothing was started; the text says why, and what to do."""


class Person:
    """The operator at the keyboard; in simulation one who says yes to everything."""

    def __init__(self, simulated: bool) -> None:
        self._simulated = simulated

    def says_yes(self, statement: str) -> bool:
        if self._simulated:
            print(f"  [simulated operator] yes: {statement}", file=sys.stderr)
            return True
        print(f"  {statement}. yes/no: ", end="", file=sys.stderr, flush=True)
        return sys.stdin.readline().strip().lower() in YES

    def tell(self, what: str) -> None:
        print(f">>> {what}", file=sys.stderr, flush=True)


@dataclass(frozen=True, slots=True)
class Ladder:
    """One cell's ladder, in simulation or on the hardware. `cell` is what is compared: without what a step sets."""

    cell: Cell
    mode: str
    overrides: tuple[str, ...]
    steps: tuple[Step, ...]
    journal: Journal
    cell_hash: str

    @classmethod
    def of(cls, cell_name: str, overrides: Sequence[str], mode: str, journal: Journal) -> Ladder:
        """ConfigError; Refused: this cell cannot be run so."""
        cell = load_cell(cell_name, overrides)
        if mode == SIM:
            overrides = [*overrides, *rehearsal(cell)]
            cell = load_cell(cell_name, overrides)
        elif cell.simulated:
            raise Refused(f"{cell.path}: simulated = true: this cell is no hardware; run it with --sim")
        require(cell)
        return cls(cell, mode, tuple(overrides), load_steps(), journal, cell_hash(cell))

    def refusal(self, step: Step) -> str | None:
        before = self.steps[step.number - 2] if step.number > 1 else None
        return refusal(self.journal.entries, step, before, self.mode, self.cell_hash)

    @property
    def passed_to(self) -> int:
        """How many steps from the first on have passed."""
        above = (s.number for s in self.steps if not_passed(self.journal.entries, s, self.mode, self.cell_hash))
        return next(above, len(self.steps) + 1) - 1

    def climb(self, step: Step, person: Person) -> Entry:
        """Run the step and note it in the journal. Refused: it must not be run now."""
        if why := self.refusal(step):
            raise Refused(why)
        began = time.monotonic()
        log = (
            self.journal.path.parent
            / f"{step.number:02d}-{step.name}-{self.mode}-{time.strftime('%Y%m%d-%H%M%S')}.mcap"
        )
        findings, numbers = self._run(step, log, person)
        failed = [finding for finding in findings if not finding.holds]
        self.journal.add(
            {
                "time": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
                "cell": self.cell.name,
                "cell_hash": self.cell_hash,
                "step": step.number,
                "name": step.name,
                "step_sha256": step.digest,
                "mode": self.mode,
                "verdict": FAIL if failed else PASS,
                "failed": [f"{finding.name}: {finding.detail}" for finding in failed],
                "findings": {finding.name: finding.detail for finding in findings},
                "measures": numbers,
                "log": log.name if log.exists() else "",
                "log_sha256": hashlib.sha256(log.read_bytes()).hexdigest() if log.exists() else "",
                "seconds": round(time.monotonic() - began, 1),
            }
        )
        return self.journal.entries[-1]

    def _run(self, step: Step, log: Path, person: Person) -> tuple[list[Finding], dict[str, Any]]:
        for statement in step.confirm:
            if not person.says_yes(statement):
                return [Finding("confirmed", False, f"the operator did not say yes to: {statement}")], {}
        cell, operator = self._cell_of(step), MakeOperator(step, person.tell)
        try:
            session = run_cell(cell, log, step.task.seconds, operator)
        except (BusError, RingError, StartError) as error:
            return [Finding("session", False, str(error))], {}
        findings, numbers = [session_of(session), operator.finding()], {}
        try:
            report, evidence = audit(log, sample=SAMPLE)
            findings += [Finding(f"audit: {r['name']}", False, r["detail"]) for r in report["rules"] if not r["holds"]]
            if evidence is not None and evidence.cycles:
                run = Run.of(step, evidence)
                findings += judge(run)
                numbers = measures(run)
        except LogError as error:
            findings.append(Finding("recording", False, str(error)))
        findings += health(cell)
        for finding in findings:
            print(f"  {'ok  ' if finding.holds else 'FAIL'} {finding.name}: {finding.detail}", file=sys.stderr)
        findings += [
            Finding("seen", person.says_yes(statement), f"the operator was asked: {statement}")
            for statement in step.asks
        ]
        return findings, numbers

    def _cell_of(self, step: Step) -> Cell:
        """The cell as the step sets it: never faster than its own speed, a simulated one with the step's person."""
        speed = min(self.cell.params.task.speed, step.task.speed)
        sets = [f"task.speed={speed:g}", *(step.sim if self.mode == SIM else ())]
        return load_cell(self.cell.path, [*sets, *self.overrides])


def rehearsal(cell: Cell) -> list[str]:
    """What makes a real cell one that can be rehearsed: its simulated devices in place of the real ones. Refused."""
    if cell.simulated:
        return []
    robot = next((device for device in SIMULATED_ADDRESS if device in cell.sim), None)
    if robot is None or "human" not in cell.sim:
        known = " or ".join(f"[sim.{device}]" for device in SIMULATED_ADDRESS)
        raise Refused(f"{cell.path}: sim: missing; to rehearse a real cell it needs {known}, and [sim.human]")
    return ["simulated=true", *(item.format(name=cell.name) for item in SIMULATED_ADDRESS[robot])]


def session_of(session: Session) -> Finding:
    """It ended as asked, all of it recorded, and no process died under way."""
    holds = session.completed and not session.deaths and "error" not in session.end
    return Finding("session", holds, "; ".join([session.exit_reason("UNFINISHED"), *session.deaths]))


def health(cell: Cell) -> list[Finding]:
    """The devices after the step, as asc doctor sees them. Whether this PC is fit counts for a real robot only."""
    found = [*(() if cell.simulated else examine_pc()), *examine_cell(cell)]
    bad = [Finding(f"device health: {f.name}", False, f"{f.detail} | do: {f.fix}") for f in found if not f.ok]
    return bad or [Finding("device health", True, f"{len(found)} checks in order")]
