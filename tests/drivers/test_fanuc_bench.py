"""The bench runs; what it finds is for people to judge."""

from __future__ import annotations

import socket
import threading
from pathlib import Path

import pytest

from drivers.fanuc_stream_motion import bench
from sim_hil.fanuc.arm import KinematicPlant
from sim_hil.fanuc.controller import Controller
from sim_hil.fanuc.faults import FaultyController
from sim_hil.fanuc.server import serve


@pytest.mark.parametrize("version", [1, 3])
def test_the_codec_is_timed(version: int) -> None:
    times = bench.bench_codec(version, repetitions=50)
    assert len(times) == 50 and min(times) > 0
    assert len(bench.bench_codec_ros(repetitions=50)) == 50


def test_a_session_is_timed_from_the_kernels_stamp(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))  # of the owner lock
    controller = Controller(KinematicPlant([0.0] * 6, 0.008))
    stop: list[int] = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as robot:
        robot.bind(("127.0.0.1", 0))
        robot.setblocking(False)
        thread = threading.Thread(target=serve, args=(robot, FaultyController(controller), (lambda: None, None), stop))
        thread.start()
        try:
            rows = bench.bench_session("127.0.0.1", robot.getsockname()[1], 3, bench.WARM_UP + 20)
        finally:
            stop.append(1)
            thread.join()
    assert {len(times) for times in rows.values()} == {20}
    assert all(0 < wake < 10**9 for wake in rows["wake"])
