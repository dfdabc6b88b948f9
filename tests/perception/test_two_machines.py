"""A session whose perception runs on another machine: by certificate, over the network, by a clock of its own."""

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

import numpy as np
import pytest

from asc_rt import bus_keys
from asc_rt.cell_checks import hash_number
from asc_rt.config import CELLS, load_cell
from asc_rt.core.types import Mode
from logs.recording import open_recording
from tests import other_machine
from tests.other_machine import HERE
from tests.ports import free_port

ROOT = Path(__file__).parents[2]
ASC = [sys.executable, "-m", "asc_rt"]
PATIENCE_S = 240
AHEAD_S = 5_000  # of the other machine's clock

pytestmark = [pytest.mark.slow, pytest.mark.real_time, pytest.mark.timeout(600)]


@pytest.fixture
def machine() -> Iterator[str]:
    with other_machine.made() as name:
        yield name


@pytest.fixture
def cell(machine: str, tmp_path: Path) -> Path:
    """fanuc-sim whose [perception] is on the other machine; its cameras listen on the link between the two."""
    text = (CELLS / "fanuc-sim.toml").read_text()
    bus, door, left, right = (free_port(HERE) for _ in range(4))
    robot = free_port(kind=socket.SOCK_DGRAM)
    changes = {
        r"port = 60015": f"port = {robot}",
        r"17447\"": f'{bus}"\n\n[bus.remote]\nendpoint = "tls/{HERE}:{door}"\nkeys = "keys"',
        r"(?m)^\[perception\]": "[perception]\nremote = true",
        r"port = 60115": f'host = "{HERE}", port = {left}',
        r"port = 60116": f'host = "{HERE}", port = {right}',
        r"(fanuc-sim/\w+\.)": rf"{CELLS}/\1",
        r"age_limit_ms = 200": "age_limit_ms = 900",  # three processes with cameras on the cores of a test machine
    }
    for old, new in changes.items():
        text, changed = re.subn(old, new, text)
        assert changed, old
    path = tmp_path / "cell.toml"
    path.write_text(text)
    (tmp_path / "certificates").symlink_to(CELLS / "certificates")
    bus_keys.make(tmp_path / "keys", HERE, ["person"])
    return path


@contextmanager
def session(cell: Path, duration_s: float) -> Iterator[subprocess.Popen[str]]:
    log = cell.with_name("log.mcap")
    command = [*ASC, "run", str(cell), "--duration", str(duration_s), "--log", str(log), "--json"]
    with cell.with_name("stderr").open("w") as err:
        process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=err, text=True)
    try:
        yield process
    finally:
        process.terminate()
        process.wait(PATIENCE_S)


@contextmanager
def perception(machine: str, cell: Path) -> Iterator[subprocess.Popen[bytes]]:
    command = [*other_machine.there(machine, AHEAD_S), *ASC, "perceive", str(cell), "--remote"]
    process = subprocess.Popen(command, cwd=ROOT, start_new_session=True)
    try:
        yield process
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def await_text(cell: Path, process: subprocess.Popen[str], text: str) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while text not in (said := cell.with_name("stderr").read_text()):
        assert process.poll() is None and time.monotonic() < deadline, said
        time.sleep(0.05)


def summary(process: subprocess.Popen[str]) -> dict[str, Any]:
    out, _ = process.communicate(timeout=PATIENCE_S)
    told: dict[str, Any] = json.loads(out.splitlines()[-1])
    return told


def test_the_cell_sees_through_another_machine_and_rests_without_it(cell: Path, machine: str) -> None:
    with session(cell, 40) as running:
        await_text(cell, running, "start control")
        with perception(machine, cell):
            await_text(cell, running, "goals reached: 1")
        told = summary(running)
    assert told["exit_reason"] == "completed" and told["robot_caused_violations"] == 0, told
    columns = open_recording(cell.with_name("log.mcap")).columns(
        "inputs.human_age_ns", "inputs.human.calibration_hash", "inputs.joint.dq", "state.mode"
    )
    age_ns, hashes, speed, mode = columns.values()
    seen, used = hashes != 0, load_cell(str(cell)).perception
    assert used is not None and set(hashes[seen].tolist()) == {hash_number(used.digest)}
    moving = age_ns[mode == Mode.ACTIVE]
    assert moving.size and 0 < moving.min() <= moving.max() < 1e9  # stamps of another clock, told in the cell's
    alone = age_ns > 1.9e9  # the limit, and a second in which the arm comes to rest
    assert alone.any() and not (mode[alone] == Mode.ACTIVE).any()
    assert np.abs(speed[alone]).max() < 0.01


def test_without_its_certificate_nobody_is_seen_and_nothing_moves(cell: Path, machine: str) -> None:
    keys = cell.with_name("keys")
    with session(cell, 15) as running:
        await_text(cell, running, "start control")
        for path in keys.iterdir():
            path.unlink()
        bus_keys.make(keys, HERE, ["person"])  # of another authority
        with perception(machine, cell):
            told = summary(running)
    assert told["exit_reason"] == "completed" and told["goals_reached"] == 0, told
    assert "ACTIVE" not in cell.with_name("stderr").read_text()
