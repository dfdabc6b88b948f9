"""The ladder whole: the real command, its processes and wire; the simulated robot, and one that stands for hardware."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from asc_rt.config import load_cell
from asc_rt.ladder.climb import rehearsal
from asc_rt.ladder.identity import cell_hash
from asc_rt.ladder.journal import PASS, SIM, Journal
from asc_rt.ladder.steps import load_steps
from logs.seal import load_key

ROOT = Path(__file__).parents[2]
ASC = [sys.executable, "-m", "asc_rt", "trials", "ladder"]
PATIENT = "human.age_limit_ms=900"  # what is judged here is the ladder, not how busy this machine is

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A log key of our own."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return tmp_path


def climb(folder: Path, cell: str, *options: str) -> tuple[int, dict[str, Any], str]:
    done = subprocess.run(
        [*ASC, cell, "--json", "-o", str(folder / "ladder"), *options], cwd=ROOT, capture_output=True, text=True
    )
    return done.returncode, json.loads(done.stdout.splitlines()[-1]) if done.stdout else {}, done.stderr


def pretend(folder: Path, cell: str, overrides: Sequence[str], below: int) -> None:
    """As if all steps below had passed in simulation."""
    journal = Journal(folder / "ladder", load_key(None))
    found = cell_hash(load_cell(cell, [*overrides, *rehearsal(load_cell(cell, overrides))]))
    for step in load_steps()[: below - 1]:
        journal.add(
            {
                "step": step.number,
                "mode": SIM,
                "verdict": PASS,
                "cell_hash": found,
                "step_sha256": step.digest,
                "time": "2026-01-01T00:00:00Z",
            }  # fmt: skip
        )


@pytest.mark.parametrize("cell", ["fanuc-sim-truth", "fanuc-tools", "openarm-sim"])
def test_the_whole_ladder_in_simulation(cell: str, home: Path) -> None:
    code, told, err = climb(home, cell, "--sim", "--set", PATIENT)
    assert code == 0, err
    assert [row["verdict"] for row in told["rows"]] == [PASS] * 10 and told["passed_to"] == 10
    assert all((home / "ladder" / row["log"]).is_file() for row in told["rows"])


FANUC = {
    1: 'sim.fanuc.faults=[{at_s = 0.0, fault = "emergency_stop"}]',
    2: "sim.fanuc.start_deg=[0, 0, 0, 0, -124, 0]",
    3: "sim.human.latency_ms=1500",
    4: "sim.fanuc.lag_ms=150",
    5: "sim.fanuc.lag_ms=150",
    6: "sim.fanuc.lag_ms=300",
    7: "sim.fanuc.lag_ms=300",
    8: "sim.human.start_s=1e6 sim.human.still_at_s=0.0",
    9: "sim.fanuc.lag_ms=2000",
    10: "sim.human.latency_ms=1500",
}


CAN = {
    1: 'sim.can.faults=[{at_s = 0.0, fault = "power_cut", axis = 2}]',
    2: "sim.can.start_deg=[0, 30, 0, 138, 0, 0, 0]",
    3: "sim.human.latency_ms=1500",
    4: 'sim.can.faults=[{at_s = 15.0, fault = "encoder", axis = 4, value = 0.1}]',
    5: 'sim.can.faults=[{at_s = 8.0, fault = "block", axis = 2}]',
    6: 'sim.can.faults=[{at_s = 4.0, fault = "hot", axis = 1, value = 90}]',
    7: 'sim.can.faults=[{at_s = 4.0, fault = "silence", axis = 7}]',
    8: "sim.human.start_s=1e6 sim.human.still_at_s=0.0",
    9: 'sim.can.faults=[{at_s = 4.0, fault = "safe_torque_off"}]',
    10: "sim.human.latency_ms=1500",
}
FAULTY = [("fanuc-sim-truth", number, FANUC[number]) for number in FANUC]
FAULTY += [("openarm-sim", number, CAN[number]) for number in CAN]


@pytest.mark.parametrize(("cell", "number", "faults"), FAULTY)
def test_a_fault_makes_the_step_fail(cell: str, number: int, faults: str, home: Path) -> None:
    pretend(home, cell, [PATIENT], number)
    settings = [item if item.startswith("sim") else f"sim{item}" for item in faults.split(" sim")]
    options = [word for item in (PATIENT, *settings) for word in ("--set", item)]
    code, told, err = climb(home, cell, "--sim", "--step", str(number), *options)
    print(told.get("rows"))
    assert code == 1, err
    assert told["rows"][0]["verdict"] == "FAIL" and told["rows"][0]["failed"]
    assert "Traceback" not in err
    if number < 10:
        refused, _, err = climb(home, cell, "--sim", "--step", str(number + 1), *options)
        assert refused == 2 and "comes first" in err


class Stand:
    """A robot and a sensor that the ladder knows by their addresses only, and a person at its keyboard."""

    def __init__(self, cell: Path, folder: Path, *options: str) -> None:
        self._cell, self._step = str(cell), load_steps()[0]
        self._human: subprocess.Popen[str] | None = None
        self.robot = self._device("fanuc", "--plant", "kinematic")
        assert self.robot.stdout is not None and "ready" in self.robot.stdout.readline()
        command = [*ASC, str(cell), "--json", "-o", str(folder / "ladder"), *options]
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        self.process = subprocess.Popen(command, cwd=ROOT, text=True, **pipes)
        self.err = ""
        self._person = threading.Thread(target=self._attend, daemon=True)
        self._person.start()

    def _device(self, name: str, *options: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "sim_hil", name, self._cell, *options]
        return subprocess.Popen(command, cwd=ROOT, text=True, stdout=subprocess.PIPE)

    def _attend(self) -> None:
        """Reads what the ladder says and does what a person would."""
        assert self.process.stderr is not None
        line = ""
        while character := self.process.stderr.read(1):
            self.err += character
            line = "" if character == "\n" else line + character
            if line.endswith("yes/no: "):
                self._type("yes")
            elif line.endswith(">>> type arm"):
                self._type("arm")
            elif found := re.match(r"step (\d+) of ", line):
                self._step = load_steps()[int(found[1]) - 1]
            elif line.endswith("start control"):
                self._unplug()
                self._human = self._device("human", *(word for item in self._step.sim for word in ("--set", item)))
            elif line.endswith("unplug or cover the sensor of people"):
                self._unplug()

    def _type(self, text: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(text + "\n")
        self.process.stdin.flush()

    def _unplug(self) -> None:
        if self._human is not None:
            self._human.kill()
            self._human.wait()
            self._human = None

    def finish(self) -> tuple[int, dict[str, Any]]:
        assert self.process.stdout is not None
        try:
            out = self.process.stdout.read()
            code = self.process.wait(600)
        finally:
            self._unplug()
            self.robot.terminate()
            self.robot.wait(30)
        return code, json.loads(out.splitlines()[-1]) if out else {}


def test_the_hardware_is_climbed_after_the_simulation_with_the_same_file(home: Path, real: Path) -> None:
    text = real.read_text().replace("192.168.1.10", "127.0.0.1").replace("60015", str(os.getpid() % 10000 + 20000))
    real.write_text(text.replace("age_limit_ms = 200", "age_limit_ms = 900"))
    code, _, err = climb(home, str(real), "--step", "1")
    assert code == 2 and "not on the hardware before it passed in simulation" in err
    code, told, err = climb(home, str(real), "--sim", "--step", "1-8")
    assert code == 0, err
    stand = Stand(real, home, "--step", "1-8")
    code, told = stand.finish()
    assert code == 0, stand.err
    assert told["mode"] == "hardware" and [row["verdict"] for row in told["rows"]] == [PASS] * 8
    code, compared, err = climb(home, str(real), "--report", str(home / "report.html"))
    assert code == 0 and compared["compared"] == 8 and compared["same_cell"], err
