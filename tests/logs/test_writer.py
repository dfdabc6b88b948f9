"""The logger moves rings and bus into a file, and nothing is lost whoever dies."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asc_rt import ring, topics
from asc_rt.bus import open_router
from asc_rt.human_state_pb2 import HumanState
from logs import schema
from logs.context import attachments, session
from logs.reader import open_log
from logs.session_files import SessionFiles
from logs.writer import FLUSH_NS, Logger, joints_message, state_message
from tests.ports import free_port


class Clock:
    """Time that passes when it is told to."""

    now_ns = 1_000_000_000

    def __call__(self) -> int:
        return self.now_ns


@pytest.fixture
def session_ring(recording: Any, tmp_path: Path) -> Iterator[Path]:
    path = tmp_path / "ring"
    ring.create(path, recording.layout.size, 50)
    ring.create(ring.wire_path(path), 600, 100)
    yield path


def logger(recording: Any, path: Path, out: Path, clock: Clock) -> tuple[Logger, ring.RingReader]:
    cycles, wire = ring.RingReader(path), ring.RingReader(ring.wire_path(path))
    log = SessionFiles(out, attachments(recording.cell), session(recording.cell))
    return Logger(log, recording.layout, cycles, wire, None, clock=clock), cycles


def test_rings_become_channels(recording: Any, session_ring: Path, tmp_path: Path) -> None:
    packed = recording.packed(recording.cycles(30))
    made, _ = logger(recording, session_ring, tmp_path / "a.mcap", Clock())
    with ring.RingWriter(session_ring) as cycles, ring.RingWriter(ring.wire_path(session_ring)) as wire:
        tap = ring.wire_tap(wire)
        for k, record in enumerate(packed):
            cycles.put(record)
            tap("rx", 100 + k, b"status")
            tap("tx", 200 + k, b"command")
            made.poll()
        assert not made.finished
    assert made.finished
    made.finish("session closed")
    with ring.RingWriter(session_ring) as cycles:
        assert cycles.backlog == 0
    log = open_log(tmp_path / "a.mcap")
    assert [log.record(i) for i in range(log.cycles)] == packed
    packets = {
        topic: [schema.parse_wire_message(m.data) for m in log.messages(topic)] for topic in ("/wire/rx", "/wire/tx")
    }
    assert packets["/wire/rx"] == [(100 + k, 6, b"status") for k in range(30)]
    assert packets["/wire/tx"] == [(200 + k, 7, b"command") for k in range(30)]
    assert (log.end["reason"], log.end["records"], log.end["lost cycle"]) == ("session closed", "30", "0")


def test_what_a_lapped_logger_lost_is_in_the_log(recording: Any, session_ring: Path, tmp_path: Path) -> None:
    packed = recording.packed(recording.cycles(60))
    made, _ = logger(recording, session_ring, tmp_path / "a.mcap", Clock())
    with ring.RingWriter(session_ring) as cycles:
        for record in packed:  # 10 more than the ring is deep
            cycles.put(record)
    made.finish("session closed")
    log = open_log(tmp_path / "a.mcap")
    assert [log.record(i) for i in range(log.cycles)] == packed[10:]
    assert [json.loads(m.data) for m in log.messages("/cell/dropout")] == [{"cycle": 10, "wire": 0}]
    assert log.end["lost cycle"] == "10"


def test_a_logger_that_dies_and_its_successor_have_every_cycle(
    recording: Any, session_ring: Path, tmp_path: Path
) -> None:
    packed, clock = recording.packed(recording.cycles(40)), Clock()
    made, _ = logger(recording, session_ring, tmp_path / "a.mcap", clock)
    with ring.RingWriter(session_ring) as cycles:
        for record in packed[:20]:
            cycles.put(record)
            made.poll()
            clock.now_ns += FLUSH_NS // 3
        # Here the first logger is killed: nothing more is flushed, nothing is closed.
        crashed = tmp_path / "crashed.mcap"
        crashed.write_bytes((tmp_path / "a.mcap").read_bytes())
        for record in packed[20:]:
            cycles.put(record)
    successor, _ = logger(recording, session_ring, tmp_path / "b.mcap", Clock())
    successor.finish("session closed")
    first, second = open_log(crashed), open_log(tmp_path / "b.mcap")
    assert first.truncated
    assert 0 < first.cycles < 20
    found = [first.record(i) for i in range(first.cycles)] + [second.record(i) for i in range(second.cycles)]
    assert found == packed


def test_only_what_is_flushed_is_called_safe(recording: Any, session_ring: Path, tmp_path: Path) -> None:
    clock = Clock()
    made, _ = logger(recording, session_ring, tmp_path / "a.mcap", clock)
    with ring.RingWriter(session_ring) as cycles:
        made.poll()
        for record in recording.packed(recording.cycles(5)):
            cycles.put(record)
        made.poll()
        assert cycles.backlog == 5
        clock.now_ns += FLUSH_NS
        made.poll()
        assert cycles.backlog == 0
        assert open_log(tmp_path / "a.mcap").cycles == 5


def test_the_state_message_is_the_newest_cycle(recording: Any) -> None:
    cycles = recording.cycles(50)
    message = state_message(recording.layout, recording.packed(cycles)[45], dropped=3)
    assert message["tick"] == 45
    assert (message["mode"], message["reason"]) == ("ACTIVE", "NONE")
    assert (message["goal_id"], message["reached_id"], message["dropped"]) == (1, 1, 3)
    assert message["d_min_now"] == cycles[45][2].decision.d_measured
    nobody = state_message(recording.layout, recording.packed(cycles)[0], dropped=0)
    assert nobody["d_min_now"] is None


def test_the_joints_message_is_every_sample_of_the_cycles(recording: Any) -> None:
    cycles = recording.cycles(5)
    message = joints_message(recording.layout, recording.packed(cycles))
    heard = [x.joint for _, x, *_ in cycles if x.joint is not None]
    assert message["t_ns"] == [joint.t_rx_ns for joint in heard]
    assert np.array_equal(message["q"], [joint.q for joint in heard])
    silent = recording.packed([(b, dataclasses.replace(x, joint=None), *rest) for b, x, *rest in cycles])
    assert joints_message(recording.layout, silent) == {}


# --- the process -----------------------------------------------------------------------------------------------------


def start(path: Path, out: Path, *options: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "logs.writer", "--cell", "fanuc-sim-truth", "--ring", str(path), "--out", str(out)]
    return subprocess.Popen([*command, *options], stderr=subprocess.PIPE, text=True, cwd=Path(__file__).parents[2])


def wait_until(condition: Any) -> None:
    for _ in range(3000):
        if condition():
            return
        time.sleep(0.01)
    raise AssertionError("it did not happen")


@pytest.mark.real_time
@pytest.mark.parametrize("ending", ["closed", "terminated"])
def test_the_process_records_a_session(recording: Any, session_ring: Path, tmp_path: Path, ending: str) -> None:
    packed, out, endpoint = recording.packed(recording.cycles(40)), tmp_path / "a.mcap", f"tcp/127.0.0.1:{free_port()}"
    human = HumanState(seq=7).SerializeToString()
    with open_router(endpoint) as bus, ring.RingWriter(session_ring) as cycles:
        state = bus.queue(topics.STATE.key)
        process = start(session_ring, out, "--set", f"bus.endpoint={endpoint}")
        try:
            cycles.put(packed[0])
            wait_until(lambda: state.take() is not None)  # so it runs, and listens
            for record in packed[1:]:
                cycles.put(record)
            bus.publisher(topics.human("person").key).put(human)
            bus.publisher(topics.PLANT_TRUTH.key).put_json({"distance_m": None, "approach_m_s": 0.0, "contact": False})
            for name in ("left", "left", "no good name", "right"):
                image = schema.CompressedImage(frame_id=name, format="png", data=b"image of " + name.encode())
                bus.publisher(topics.CAMERA.key).put(image.SerializeToString())
                lens = schema.CameraCalibration(frame_id=name, width=640, height=480, K=range(9))
                bus.publisher(topics.CAMERA_CALIBRATION.key).put(lens.SerializeToString())
            bus.publisher(topics.CAMERA.key).put(b"\xff")
            bus.publisher(topics.CAMERA_CALIBRATION.key).put(b"\xff")
            bus.event_publisher(topics.OPERATOR.key).put_json({"id": 1, "kind": "ARM"})
            wait_until(lambda: '"tick": 39' in (state.take() or b"").decode())
            wait_until(lambda: b"".join(m.data for m in open_log(out).messages("/cell/operator")))
            process.send_signal(signal.SIGINT)  # Ctrl-C reaches the whole group; the logger leaves last
            if ending == "terminated":
                process.send_signal(signal.SIGTERM)
            else:
                cycles.close()
            _, errors = process.communicate(timeout=30)
        finally:
            process.kill()
    assert (process.returncode, errors) == (0, "")
    log = open_log(out)
    assert [log.record(i) for i in range(log.cycles)] == packed
    assert [m.data for m in log.messages("/cell/human")] == [human]
    assert [json.loads(m.data)["id"] for m in log.messages("/cell/operator")] == [1]
    assert len(list(log.messages("/sim/truth"))) == 1
    eyes = [f"/cell/camera/{name}" for name in ("left", "left/calibration", "right", "right/calibration")]
    assert sorted(t for t in log.topics if t.startswith(schema.CAMERAS)) == eyes
    lens, _ = (schema.CameraCalibration.FromString(m.data) for m in log.messages(eyes[1]))
    assert (lens.width, lens.height, list(lens.K)) == (640, 480, list(range(9)))
    seen = [schema.CompressedImage.FromString(m.data) for m in log.messages("/cell/camera/left")]
    assert [(image.format, image.data) for image in seen] == [("png", b"image of left")] * 2
    assert not log.truncated
    assert log.end["reason"] == ("terminated" if ending == "terminated" else "session closed")
    assert np.frombuffer(log.record(39), log.layout.dtype)["inputs.tick"] == 39
    assert session_ring.exists()


def test_bad_input_is_one_clear_line(recording: Any, session_ring: Path, tmp_path: Path) -> None:
    cases = {
        "no such cell file": ["--cell", "none.toml"],
        "made by the session's supervisor": ["--ring", str(tmp_path / "none")],
        "bus.endpoint": ["--set", "bus.endpoint=nowhere"],
    }
    started = {want: start(session_ring, tmp_path / "a.mcap", *options) for want, options in cases.items()}
    for want, process in started.items():
        _, errors = process.communicate(timeout=30)
        assert process.returncode == 2
        assert want in errors
        assert errors.count("\n") == 1
    assert not os.path.exists(tmp_path / "a.mcap")


@given(t_ns=st.integers(-(2**63), 2**63 - 1), data=st.binary(max_size=300), more=st.integers(0, 70_000))
def test_a_packet_is_written_as_the_protobuf_library_would(t_ns: int, data: bytes, more: int) -> None:
    length = len(data) + more
    expected = schema._Wire(t_ns=t_ns, length=length, data=data).SerializeToString()
    assert schema.wire_message(t_ns, length, data) == expected
