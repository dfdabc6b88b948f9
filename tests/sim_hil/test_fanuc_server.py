"""`python -m sim_hil fanuc CELL` as a process on loopback."""

from __future__ import annotations

import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from asc_rt.config import CELLS
from drivers.fanuc_stream_motion.link import StreamMotion
from sim_hil.fanuc import wire
from tests.ports import free_port

pytestmark = pytest.mark.real_time


@pytest.fixture
def port() -> int:
    return free_port(kind=socket.SOCK_DGRAM)


@pytest.fixture
def cell(port: int, tmp_path: Path) -> Path:
    text, changed = re.subn(r"(?m)^port = \d+", f"port = {port}", (CELLS / "fanuc-sim-truth.toml").read_text())
    assert changed == 1
    path = tmp_path / "cell.toml"
    path.write_text(text)
    return path


def command(cell: Path | str, *options: str) -> list[str]:
    return [sys.executable, "-m", "sim_hil", "fanuc", str(cell), "--plant", "kinematic", *options]


@contextmanager
def server(cell: Path, *options: str) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(command(cell, *options), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None and process.stdout.readline().startswith("ready fanuc 127.0.0.1:")
        yield process
    finally:
        process.kill()
        process.communicate()


def end(process: subprocess.Popen[str], with_signal: signal.Signals = signal.SIGTERM) -> tuple[int, str, str]:
    process.send_signal(with_signal)
    out, err = process.communicate(timeout=60)
    return process.returncode, out, err


@pytest.mark.parametrize("with_signal", [signal.SIGTERM, signal.SIGINT])
def test_a_session_over_udp_and_a_clean_end(cell: Path, port: int, tmp_path: Path, with_signal: signal.Signals) -> None:
    with server(cell, "--strict") as process:
        driver = StreamMotion({"host": "127.0.0.1", "port": port, "lock_dir": str(tmp_path)})
        assert driver.configure().identity.endswith(f"127.0.0.1:{port}")
        joint = driver.activate(8_000_000)
        np.testing.assert_allclose(joint.q, np.radians([0, 0, 0, 0, -90, 0]), atol=1e-6)
        driver.close()
        code, out, err = end(process, with_signal)
    assert code == 0
    assert "0 offences, alarms: none" in out
    assert "Traceback" not in err


@pytest.mark.parametrize(("options", "code"), [(("--strict",), 1), ((), 0)])
def test_an_offence_is_printed_with_its_bytes(cell: Path, port: int, options: tuple[str, ...], code: int) -> None:
    with server(cell, *options) as process, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as pc:
        pc.settimeout(30.0)
        pc.sendto(bytes.fromhex("c0ffee"), ("127.0.0.1", port))
        pc.sendto(wire.write_request("start", 3), ("127.0.0.1", port))
        assert wire.read_reply(pc.recv(200)).name == "status"
        returned, out, err = end(process)
    assert returned == code
    assert "offence: malformed packet: 3 bytes: c0ffee" in err
    assert "1 offences" in out


def test_a_script_of_faults_runs(cell: Path, port: int, tmp_path: Path) -> None:
    script = tmp_path / "faults.toml"
    script.write_text('[[faults]]\nat_s = 0.2\nfault = "emergency_stop"\n')
    with server(cell, "--faults", str(script)) as process, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as pc:
        pc.settimeout(30.0)
        pc.sendto(wire.write_request("start", 3), ("127.0.0.1", port))
        while wire.read_reply(pc.recv(200))["status"] & 4:  # servo power
            pass
        _, out, _ = end(process)
    assert "alarms: SRVO-002" in out
    script.write_text("[[faults]]\nat_s = 0.2\n")
    done = subprocess.run(command(cell, "--faults", str(script)), capture_output=True, text=True, timeout=60)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "faults.toml: fault 1: a fault has" in done.stderr


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda text: text, "cannot listen on 127.0.0.1"),
        (lambda text: text.replace("start_move = 5", "start_mvoe = 5"), "unknown option 'start_mvoe'"),
        (lambda text: text.replace("period_ms = 8", "period_ms = "), "malformed TOML"),
    ],
    ids=["port in use", "unknown option", "malformed"],
)
def test_bad_input_is_one_clear_line(cell: Path, port: int, spoil: object, says: str) -> None:
    assert callable(spoil)
    cell.write_text(spoil(cell.read_text()))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", port))
        done = subprocess.run(command(cell), capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert says in done.stderr
    assert done.stderr.count("\n") == 1 and done.stdout == ""


def test_an_unknown_device_gets_the_usage() -> None:
    done = subprocess.run([sys.executable, "-m", "sim_hil", "toaster"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert done.stderr.startswith("usage: python -m sim_hil")
