"""`asc run`, whole: every process, the real wire, and what happens when one of them dies. Nothing here is timed."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from asc_rt.footprint import START_ONLY
from tests.ports import free_port

ROOT = Path(__file__).parents[2]
PATIENCE = 240  # s; only what hangs takes so long
ASC = [sys.executable, "-m", "asc_rt"]
KEYS = {
    "cycles", "period_ms", "missed_deadlines", "cycle_us", "wake_us", "min_distance_m", "robot_caused_violations",
    "infeasible_cycles", "goals_reached", "stops", "dropped_records", "log", "exit_reason",
}  # fmt: skip

pytestmark = pytest.mark.real_time


class Run:
    """A running `asc run --json` on ports of its own."""

    def __init__(self, folder: Path, duration: float, port: int | None = None, torque: bool = False) -> None:
        self.log = folder / "log.mcap"
        self.port = port or free_port(kind=socket.SOCK_DGRAM)
        bus = free_port()
        cell, link = ("openarm-sim", "channel=test-") if torque else ("fanuc-sim-truth", "port=")
        settings = [f"driver.{link}{self.port}", f"bus.endpoint=tcp/127.0.0.1:{bus}", "human.age_limit_ms=900"]
        command = [*ASC, "run", cell, "--json", "--duration", str(duration), "--log", str(self.log)]
        for setting in settings:
            command += ["--set", setting]
        self._err = folder / "stderr"
        with self._err.open("wb") as err:
            self.process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=err)

    @property
    def err(self) -> str:
        return self._err.read_text()

    def await_text(self, text: str) -> None:
        deadline = time.monotonic() + PATIENCE
        while text not in self.err:
            assert self.process.poll() is None, self.err
            assert time.monotonic() < deadline, self.err
            time.sleep(0.05)

    def kill(self, module: str) -> None:
        """SIGKILL to the child process that runs `module`."""
        os.kill(self.child(module), signal.SIGKILL)

    def child(self, module: str) -> int:
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split()
        (pid,) = [int(c) for c in children if module in Path(f"/proc/{c}/cmdline").read_text().replace("\0", " ")]
        return pid

    def finish(self) -> tuple[int, dict[str, Any]]:
        out, _ = self.process.communicate(timeout=PATIENCE)
        assert "Traceback" not in self.err
        left = [p.name for p in Path("/dev/shm").iterdir() if p.name.partition(".")[0].endswith(f"-{self.process.pid}")]
        assert not left, self.err
        return self.process.returncode, json.loads(out.decode().splitlines()[-1]) if out else {}


@contextmanager
def running(folder: Path, duration: float, port: int | None = None, torque: bool = False) -> Iterator[Run]:
    run = Run(folder, duration, port, torque)
    try:
        yield run
    finally:
        run.process.terminate()
        run.process.wait(PATIENCE)


def as_in_file(pid: int) -> dict[str, int]:
    """kB that process `pid` holds of each file it has mapped, in pages that it has not made its own."""
    kept: dict[str, int] = {}
    for path, figures in re.findall(
        r"^\w+-\w+ \S+ \S+ \S+ \S+ +(/.*)\n((?:\w+:.*\n)+)", Path(f"/proc/{pid}/smaps").read_text(), re.MULTILINE
    ):
        rss, own = (int(re.search(rf"^{name}: +(\d+) kB", figures, re.MULTILINE)[1]) for name in ("Rss", "Anonymous"))
        kept[path] = kept.get(path, 0) + (rss if own == 0 else 0)
    return kept


def replay(log: Path) -> dict[str, Any]:
    done = subprocess.run([*ASC, "replay", str(log), "--json"], cwd=ROOT, capture_output=True, text=True)
    told: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    assert done.returncode == 0, told
    return told


def test_the_cell_runs_ends_and_replays_to_the_byte(tmp_path: Path) -> None:
    with running(tmp_path, 6) as run:
        code, told = run.finish()
    assert code == 0, run.err
    assert told.keys() >= KEYS
    assert told["exit_reason"] == "completed" and told["robot_caused_violations"] == 0
    assert told["dropped_records"] == 0 and told["cycles"] > 300 and told["processes_lost"] == []
    again = replay(run.log)
    assert again["exact"] and again["mismatches"] == 0 and again["cycles"] == told["cycles"]


def test_without_a_person_publisher_the_robot_rests_and_nothing_arms_it_again(tmp_path: Path) -> None:
    with running(tmp_path, 8) as run:
        run.await_text("ACTIVE")
        run.kill("sim_hil human")
        run.await_text("STOPPED (HUMAN_STALE")
        code, told = run.finish()
    assert code == 0 and told["exit_reason"] == "completed"  # it waits for a person until it is asked to end
    # Somebody who walks in may have come near within the 0.9 s of the age limit here: then that is what stops it first.
    assert told["stops"][-1]["reason"] in ("HUMAN_STALE", "SEPARATION")
    assert "ACTIVE" not in run.err.rpartition("STOPPED (HUMAN_STALE")[2]


def test_a_dead_controller_leaves_the_robot_to_its_own_rule_and_a_whole_log(tmp_path: Path) -> None:
    with running(tmp_path, 60) as run:
        run.await_text("ACTIVE")
        run.kill("asc_rt.control")
        code, told = run.finish()
    assert code == 1 and told["exit_reason"] == "CONTROL_DIED"
    assert "Receiving interval over" in run.err  # the simulated robot stopped itself, and says why
    assert told["dropped_records"] == 0 and not told["truncated"]
    assert replay(run.log)["exact"]


def test_a_dead_robot_ends_the_session_with_its_reason_and_a_whole_log(tmp_path: Path) -> None:
    with running(tmp_path, 60) as run:
        run.await_text("ACTIVE")
        run.kill("sim_hil fanuc")
        code, told = run.finish()
    assert code == 1 and told["exit_reason"] == "ROBOT_SILENT"
    assert told["dropped_records"] == 0 and not told["truncated"]
    assert replay(run.log)["exact"]


@pytest.mark.parametrize("torque", [False, True])
def test_the_loop_keeps_no_pages_of_what_only_the_start_needs(tmp_path: Path, torque: bool) -> None:
    with running(tmp_path, 60, torque=torque) as run:
        run.await_text("ACTIVE")
        kept = as_in_file(run.child("asc_rt.control"))
        run.process.send_signal(signal.SIGINT)
        code, _ = run.finish()
    assert code == 0
    assert any("libllvmlite" in path for path in kept) and any("libpinocchio" in path for path in kept)
    assert not any("/scipy" in path for path in kept), "numba was not started lean"
    assert not {path: kb for path, kb in kept.items() if kb and any(part in path for part in START_ONLY)}


def test_ctrl_c_ends_cleanly_and_a_second_session_is_refused_meanwhile(tmp_path: Path) -> None:
    with running(tmp_path, 60) as run:
        run.await_text("HOLD")
        other = tmp_path / "other"
        other.mkdir()
        with running(other, 5, port=run.port) as second:
            second_code, _ = second.finish()
        assert second_code == 2 and f":{run.port}" in second.err
        run.process.send_signal(signal.SIGINT)
        code, told = run.finish()
    assert code == 0 and told["exit_reason"] == "completed" and not told["truncated"]
