"""The simulated bus as a process, and what happens when one side is killed: the arm rests, and nothing moves by itself.

Also what strangers see of it: clients of python-can and canopen that know nothing of us.
"""

from __future__ import annotations

import json
import os
import select
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import can
import canopen
import numpy as np
import pytest

from asc_rt import topics
from asc_rt.bus import open_router
from asc_rt.config import load_cell
from sim_hil.can import server as server_module
from sim_hil.can.frames import Frame
from sim_hil.can.line import TICK_NS, Drive, Line
from sim_hil.can.mechanics import Joints
from sim_hil.can.server import Server

ROOT = Path(__file__).parents[2]
MOVER = ROOT / "tests" / "drivers" / "can_mover.py"
pytestmark = pytest.mark.real_time


@contextmanager
def process(*command: str) -> Iterator[subprocess.Popen[str]]:
    started = subprocess.Popen(
        [sys.executable, *command], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    try:
        yield started
    finally:
        started.kill()
        started.wait()


def await_line(started: subprocess.Popen[str], word: str) -> str:
    """AssertionError with all that it said: it ended without saying `word`."""
    assert started.stdout is not None
    said = []
    for line in started.stdout:
        if word in line:
            return line
        said.append(line)
    raise AssertionError(f"ended ({started.wait()}) without saying {word!r}; it said:\n{''.join(said)}")


class Arm:
    """The simulated device of a cell, and what is true of it."""

    def __init__(self, cell: str) -> None:
        self.cell = load_cell(cell)
        self._router = open_router(self.cell.bus_endpoint)
        self._truth = self._router.latest(topics.PLANT_TRUTH.key)
        self._process = process("-m", "sim_hil", "can", cell)
        self.sim = self._process.__enter__()
        await_line(self.sim, "ready")

    def close(self) -> None:
        self._process.__exit__(None, None, None)
        self._router.close()

    def truth(self) -> dict[str, Any]:
        deadline = time.monotonic() + 20
        while (data := self._truth.take()) is None:
            assert time.monotonic() < deadline, "no truth"
            time.sleep(0.005)
        told: dict[str, Any] = json.loads(data)
        return told

    def until(self, holds: Callable[[np.ndarray, np.ndarray], bool]) -> np.ndarray:
        """The pose at which it held."""
        deadline = time.monotonic() + 40
        while time.monotonic() < deadline:
            told = self.truth()
            if holds(np.array(told["q"]), np.array(told["dq"])):
                return np.array(told["q"])
        raise AssertionError(f"it never held: {told}")


@pytest.fixture
def openarm() -> Iterator[Arm]:
    arm = Arm("openarm-sim")
    yield arm
    arm.close()


def test_a_killed_controller_leaves_an_arm_that_holds_and_a_new_one_does_not_move_it(openarm: Arm) -> None:
    with process(str(MOVER)) as mover:
        await_line(mover, "moving")
        openarm.until(lambda q, dq: bool(np.abs(dq).max() > 0.3))
        mover.kill()
        rest = openarm.until(lambda q, dq: bool(np.abs(dq).max() < 0.01))
    time.sleep(1.0)
    np.testing.assert_allclose(openarm.truth()["q"], rest, atol=0.02)
    with process(str(MOVER)) as again:
        told = json.loads(await_line(again, "why"))
    assert "communication lost" in told["why"]
    np.testing.assert_allclose(openarm.truth()["q"], rest, atol=0.02)


def test_a_killed_bus_is_noticed_within_two_cycles(openarm: Arm) -> None:
    """By its silence: the system closes the sockets of a killed process only some cycles later."""
    with process(str(MOVER)) as mover:
        await_line(mover, "moving")
        openarm.until(lambda q, dq: bool(np.abs(dq).max() > 0.3))
        openarm.sim.kill()
        told = json.loads(await_line(mover, "why"))
    assert "interface gone" in told["why"] and told["noticed"] <= 2


def test_a_logger_and_a_player_of_python_can_work_on_it(openarm: Arm, tmp_path: Path) -> None:
    channel, log = openarm.cell.driver["channel"], tmp_path / "candump.log"
    ask = [can.Message(timestamp=0.001 * i, arbitration_id=0x7FF, is_extended_id=False, is_fd=True, bitrate_switch=True,
                       data=bytes([1 + i, 0, 0x33, 21, 0, 0, 0, 0])) for i in range(7)]  # fmt: skip
    with can.Logger(tmp_path / "ask.log") as script:
        for message in ask:
            script.on_message_received(message)
    with can.Bus(interface="asc-sim", channel=channel) as bus, can.Logger(log) as logger:
        heard: list[can.Message] = []
        notifier = can.Notifier(bus, [logger, heard.append])
        with process("-m", "can.player", "-i", "asc-sim", "-c", channel, str(tmp_path / "ask.log")) as player:
            assert player.wait(60) == 0
        deadline = time.monotonic() + 20
        while len(heard) < 14 and time.monotonic() < deadline:
            time.sleep(0.02)
        notifier.stop()
    seen = list(can.LogReader(log))
    assert [m.arbitration_id for m in seen if m.arbitration_id != 0x7FF] == [0x11 + i for i in range(7)]
    assert sum(m.arbitration_id == 0x7FF for m in seen) == 7


class Answering:
    """A drive that answers each frame with where it is."""

    brake_closed, is_enabled = False, True

    def __init__(self) -> None:
        self.q = self.dq = self.age = 0.0

    def hear(self, frame: Frame) -> list[Frame]:
        return [Frame(1, struct.pack("<d", self.q + self.dq * self.age))]

    def speak(self, elapsed_ns: int) -> list[Frame]:
        return []

    def tick(self, q: float, dq: float, elapsed_ns: int) -> float:
        self.q, self.dq = q, dq
        return 0.0


def test_a_late_server_tells_late_what_a_punctual_one_would_have_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else the arm lags behind the stamps of its answers, and who differences positions sees speeds that never were."""
    joint = Joints(np.zeros(1), np.ones(1), np.ones(1), np.zeros(1), np.zeros(1))  # at 1 rad/s
    line = Line([cast(Drive, Answering())], joint)
    channel, stop, ticks = f"late-{os.getpid()}", [], []
    server, tick = Server(line, channel), line.tick
    client = can.Bus(interface="asc-sim", channel=channel)

    def held_up(t_ns: int) -> None:
        ticks.append(t_ns)
        if len(ticks) == 10:  # what is asked meanwhile is answered afterwards, all at once
            for _ in range(5):
                time.sleep(0.004)
                client.send(can.Message(arbitration_id=2, is_extended_id=False))
        elif len(ticks) == 50:
            stop.append(1)
        tick(t_ns)

    monkeypatch.setattr(server_module, "LONGEST_PAUSE_NS", 1 << 60)  # this machine may be held up, too
    line.tick = held_up  # type: ignore[method-assign]
    try:
        server.serve(stop, [], lambda: None)
        told = [message for _ in range(5) if (message := client.recv(1.0)) is not None]
    finally:
        client.shutdown()
        server.close()
    assert set(np.diff(ticks)) == {TICK_NS}
    apart = np.diff([message.timestamp for message in told])
    assert len(told) == 5 and apart.min() > 0.0039
    np.testing.assert_allclose(np.diff([struct.unpack("<d", m.data)[0] for m in told]), apart, atol=1e-6)


def test_frames_of_a_client_that_closes_without_reading_are_on_the_wire(openarm: Arm) -> None:
    channel = openarm.cell.driver["channel"]
    with can.Bus(interface="asc-sim", channel=channel) as listener:
        for i in range(20):
            with can.Bus(interface="asc-sim", channel=channel) as hasty:
                hasty.send(can.Message(arbitration_id=0x7FF, is_extended_id=False, data=[1, 0, 0x33, 21, 0, 0, 0, 0]))
                while not select.select([hasty], [], [], 10)[0]:
                    pass
                for k in range(3):
                    hasty.send(can.Message(arbitration_id=0x700 + k, is_extended_id=False, data=[i]))
            heard: list[int] = []
            while len(heard) < 3 and (told := listener.recv(10)) is not None:
                heard += [told.arbitration_id] * (told.arbitration_id in (0x700, 0x701, 0x702))
            assert heard == [0x700, 0x701, 0x702]


def test_the_scanner_of_canopen_finds_the_drives() -> None:
    arm = Arm("panda-torque-sim")
    try:
        network = canopen.Network()
        network.connect(interface="asc-sim", channel=arm.cell.driver["channel"])
        network.scanner.search(limit=20)
        deadline = time.monotonic() + 20
        while len(network.scanner.nodes) < 7 and time.monotonic() < deadline:
            time.sleep(0.05)
        assert sorted(network.scanner.nodes) == list(range(1, 8))
        network.disconnect()
    finally:
        arm.close()
