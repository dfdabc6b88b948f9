"""kill -9 of the controller, the logger, or both, at any moment: not one complete cycle is lost."""

import os
import random
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asc_rt import ring
from asc_rt.bus import open_router
from logs.reader import open_log
from logs.recover import recover
from logs.seal import load_key

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        found = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    with open_router(found):
        yield found


class Session:
    """A producer and a logger at work."""

    def __init__(self, recording: Any, folder: Path, endpoint: str) -> None:
        layout = recording.layout
        self.ring, self.out = folder / "ring", folder / "log.mcap"
        ring.create(self.ring, layout.size, 20_000)
        ring.create(ring.wire_path(self.ring), 600, 40_000)
        (folder / "record").write_bytes(recording.packed(recording.cycles(5))[4])
        offsets = [str(layout.dtype.fields[path][1]) for path in ("inputs.tick", "inputs.t_ns")]
        environment = {**os.environ, "XDG_STATE_HOME": str(folder), "PYTHONPATH": str(ROOT)}
        writer = ["-m", "logs.writer", "--cell", "fanuc-sim-truth", "--ring", self.ring, "--out", self.out]
        self.logger = self._start(*writer, "--set", f"bus.endpoint={endpoint}", env=environment)
        self._wait(self.out.exists)
        produce = Path(__file__).with_name("produce.py")
        self.controller = self._start(produce, self.ring, folder / "record", *offsets, env=environment)
        self._wait(lambda: self.head > 20)

    def _start(self, *arguments: object, env: dict[str, str]) -> subprocess.Popen[bytes]:
        return subprocess.Popen([sys.executable, *map(str, arguments)], cwd=ROOT, env=env, stderr=subprocess.DEVNULL)

    def _wait(self, condition: Any) -> None:
        for _ in range(6000):
            if condition():
                return
            time.sleep(0.005)
        raise AssertionError("it did not happen")

    @property
    def head(self) -> int:
        with ring.RingWatcher(self.ring) as watcher:
            return watcher.head

    def end(self) -> None:
        for process in (self.controller, self.logger):
            process.kill()
            process.wait()


VICTIMS = ("controller", "logger", "both")


@pytest.mark.real_time
@pytest.mark.parametrize("trial", [*range(5), *(pytest.param(k, marks=pytest.mark.slow) for k in range(5, 100))])
def test_no_complete_cycle_is_lost(
    recording: Any, tmp_path: Path, endpoint: str, monkeypatch: pytest.MonkeyPatch, trial: int
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    rng, victim = random.Random(trial), VICTIMS[trial % 3]
    session = Session(recording, tmp_path, endpoint)
    try:
        time.sleep(rng.uniform(0.05, 0.6))
        victims = [session.controller, session.logger] if victim == "both" else [getattr(session, victim)]
        rng.shuffle(victims)
        for process in victims:
            process.send_signal(signal.SIGKILL)
            process.wait()
        if victim == "controller":  # the logger lives: the supervisor closes the ring, and all is in the file
            ring.RingWriter(session.ring).close()
            assert session.logger.wait(timeout=60) == 0
        session.end()
        produced, log = session.head, open_log(session.out)
        assert log.truncated == (victim != "controller")
        if log.truncated:
            whole = tmp_path / "whole.mcap"
            found = recover(session.out, whole, session.ring, load_key())
            assert found.cycles_from_ring + log.cycles == produced
            log = open_log(whole)
            assert log.recovered
        ticks = log.columns("inputs.tick")["inputs.tick"]
        assert np.array_equal(ticks, np.arange(produced))
        assert log.seals.final
        assert all(log.layout.syndrome(log.record(i)) == 0 for i in (0, log.cycles - 1))
        packets = len(list(log.messages("/wire/rx")))
        assert produced <= packets <= produced + 1
    finally:
        session.end()
