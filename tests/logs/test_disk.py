"""A disk that fills, breaks or refuses: the file ends whole, cycles are counted, the rings are never held up."""

import errno
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from asc_rt import ring
from asc_rt.bus import open_router
from asc_rt.topics import STATE
from logs import mcap_writer
from logs.audit import audit
from logs.context import attachments, session
from logs.mcap_scan import CorruptLog
from logs.reader import open_log
from logs.recording import open_recording
from logs.recover import recover
from logs.session_files import SessionFiles, manifest_path, part_path
from logs.writer import FLUSH_NS, Logger
from tests.ports import free_port

KEY = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))
ROOT = Path(__file__).parents[2]


class Disk:
    """Stands in for `os.pwrite`: `room` bytes are left, beside a reserve that `Appender.release` gives back."""

    def __init__(self, error: int = errno.ENOSPC) -> None:
        self.room, self.error = 10**9, error
        self._pwrite = os.pwrite

    def __call__(self, fd: int, data: Any, offset: int) -> int:
        if self.room <= 0:
            raise OSError(self.error, os.strerror(self.error))
        done = self._pwrite(fd, data[: self.room], offset)
        self.room -= done
        return done


class Bench:
    """A logger whose time and disk are ours."""

    def __init__(self, recording: Any, folder: Path, disk: Disk, rotate_ns: int = 0) -> None:
        self.packed, self.disk, self.now_ns, self.path = (
            recording.packed(recording.cycles(60)),
            disk,
            0,
            folder / "ring",
        )
        ring.create(self.path, recording.layout.size, 100)
        ring.create(ring.wire_path(self.path), 600, 10)
        self.cycles = ring.RingWriter(self.path)
        self.out = folder / "a.mcap"
        files = attachments(recording.cell), session(recording.cell)
        self.files = SessionFiles(self.out, *files, KEY, rotate_ns, clock=lambda: self.now_ns)
        self.reader = ring.RingReader(self.path)
        self.logger = Logger(self.files, recording.layout, self.reader, None, None, clock=lambda: self.now_ns)

    def put(self, start: int, end: int) -> None:
        """Each cycle is polled and flushed."""
        for record in self.packed[start:end]:
            self.cycles.put(record)
            self.now_ns += FLUSH_NS
            self.logger.poll()


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    made = Disk()
    monkeypatch.setattr(mcap_writer.os, "pwrite", made)
    return made


@pytest.fixture
def make(recording: Any, tmp_path: Path, disk: Disk) -> Iterator[Callable[..., Bench]]:
    made: list[Bench] = []

    def build(**options: Any) -> Bench:
        made.append(Bench(recording, tmp_path, disk, **options))
        return made[-1]

    yield build
    for bench in made:
        bench.reader.close()
        bench.cycles.close()


@pytest.mark.parametrize("room", [0, 1, 700, 3000])
@pytest.mark.parametrize("error", [errno.ENOSPC, errno.EROFS, errno.EIO])
def test_on_a_full_disk_the_file_ends_whole_and_cycles_are_counted(
    make: Callable[..., Bench], disk: Disk, tmp_path: Path, room: int, error: int
) -> None:
    bench = make()
    bench.put(0, 20)
    disk.room, disk.error = room, error
    bench.put(20, 50)  # never raises, never waits
    bench.logger.finish("session closed")
    assert bench.logger.failure is not None and bench.logger.failure.errno == error
    log = open_log(bench.out)
    assert log.truncated  # nothing could be written any more, not even the end
    assert [log.record(i) for i in range(log.cycles)] == bench.packed[: log.cycles]
    assert log.cycles >= 20
    assert bench.logger.unrecorded == bench.logger.dropped == 50 - log.cycles
    disk.room = 10**9
    found = recover(bench.out, tmp_path / "whole.mcap", bench.path, KEY)  # the ring still has them
    assert found.cycles == 50


def test_the_reserve_lets_the_file_be_closed_in_good_order(
    make: Callable[..., Bench], disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    release = mcap_writer.Appender.release

    def give_back(self: mcap_writer.Appender) -> None:
        disk.room += 10**6
        release(self)

    monkeypatch.setattr(mcap_writer.Appender, "release", give_back)
    bench = make()
    bench.put(0, 20)
    disk.room = 10
    bench.put(20, 50)
    log = open_log(bench.out)
    assert not log.truncated
    assert log.end["reason"].startswith("the disk failed: No space left")
    assert (log.cycles, log.end["records"], log.end["unrecorded"]) == (20, "20", "1")
    assert log.seals.final


def test_the_reserve_is_real(tmp_path: Path) -> None:
    fd = mcap_writer._reserve(tmp_path)
    assert fd is not None
    assert os.fstat(fd).st_blocks * 512 >= mcap_writer.RESERVE_SIZE
    assert list(tmp_path.iterdir()) == []
    os.close(fd)


def test_a_slow_disk_costs_nothing_that_the_ring_can_hold(make: Callable[..., Bench], disk: Disk) -> None:
    bench = make()
    bench.put(0, 5)
    for record in bench.packed[5:55]:  # the logger hangs in one write meanwhile
        bench.cycles.put(record)
    bench.put(55, 60)
    bench.logger.finish("session closed")
    log = open_log(bench.out)
    assert [log.record(i) for i in range(log.cycles)] == bench.packed
    assert log.end["lost cycle"] == "0"


def test_rotation_makes_whole_files_and_a_manifest(make: Callable[..., Bench]) -> None:
    bench = make(rotate_ns=20 * FLUSH_NS)
    bench.put(0, 60)
    bench.logger.finish("session closed")
    told = json.loads(manifest_path(bench.out).read_text())["parts"]
    names = [part["file"] for part in told]
    assert names[:2] == ["a.mcap", "a.part2.mcap"]
    found: list[bytes] = []
    previous = None
    for part in told:
        log = open_log(bench.out.with_name(part["file"]))
        assert not log.truncated
        assert log.seals.final
        assert (log.cycles, len(found)) == (part["cycles"], part["first_cycle"])
        assert log.session.get("previous_sha256") == previous
        assert log.params.n == 6
        found += [log.record(i) for i in range(log.cycles)]
        previous = part["sha256"]
    assert found == bench.packed
    assert told[0]["reason"] == "rotated"
    assert told[-1]["reason"] == "session closed"


@pytest.fixture
def rotated(make: Callable[..., Bench]) -> Bench:
    bench = make(rotate_ns=20 * FLUSH_NS)
    bench.put(0, 60)
    bench.logger.finish("session closed")
    return bench


def test_a_rotated_session_is_read_as_one(rotated: Bench, tmp_path: Path) -> None:
    link = tmp_path / "latest.mcap"
    link.symlink_to(rotated.out.name)
    for path in (rotated.out, link):
        whole = open_recording(path)
        assert len(whole.parts) == len(json.loads(manifest_path(rotated.out).read_text())["parts"]) > 2
        assert [whole.record(i) for i in range(whole.cycles)] == rotated.packed
        assert b"".join(batch.tobytes() for batch in whole.batches()) == b"".join(rotated.packed)
        assert list(whole.columns("inputs.tick")["inputs.tick"]) == list(range(60))
        assert whole.end["reason"] == "session closed" and not whole.truncated
        with pytest.raises(IndexError):
            whole.record(60)
    t_ns = whole.columns("inputs.t_ns")["inputs.t_ns"]
    near = whole.around(int(t_ns[30]), 24_000_000)
    ticks = near.columns("inputs.tick")["inputs.tick"].tolist()
    assert set(range(27, 33)) <= set(ticks) and ticks == list(range(ticks[0], ticks[-1] + 1)) and len(ticks) < 60
    assert near.record(0) == rotated.packed[ticks[0]] and whole.cycles == 60
    alone = open_recording(part_path(rotated.out, 2))
    assert len(alone.parts) == 1 and alone.cycles < 60
    report, _ = audit(rotated.out, sample=1)
    named = {rule["name"]: rule for rule in report["rules"]}
    assert report["cycles"] == 60 and report["parts"][1] == "a.part2.mcap" and not report["gaps"]
    for name in ("identity", "seals", "closed", "completeness"):
        assert named[name]["holds"], named[name]
    assert "part 3: " in named["seals"]["detail"]


def test_a_part_that_is_missing_exchanged_or_altered_is_seen(rotated: Bench, tmp_path: Path) -> None:
    second, third = part_path(rotated.out, 2), part_path(rotated.out, 3)
    kept = second.read_bytes(), third.read_bytes()
    third.rename(tmp_path / "away")
    with pytest.raises(CorruptLog, match=r"incomplete: a\.part3\.mcap.* are not beside it"):
        open_recording(rotated.out)
    second.write_bytes(kept[1])
    with pytest.raises(CorruptLog, match=r"a\.mcap: altered: a\.part2\.mcap names another SHA-256"):
        open_recording(rotated.out)
    second.unlink()
    with pytest.raises(CorruptLog, match="incomplete"):
        open_recording(rotated.out)
    second.write_bytes(kept[0])
    third.write_bytes(kept[1])
    assert open_recording(rotated.out).cycles == 60


def test_a_part_of_another_session_is_refused(rotated: Bench, recording: Any, tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    files = attachments(recording.cell), session(recording.cell)
    stranger = SessionFiles(other / "a.mcap", *files, KEY, 1, clock=lambda: 0)
    stranger.close({"reason": "rotated"})
    stranger.log = stranger._open()
    stranger.close({"reason": "session closed"})
    part_path(rotated.out, 2).write_bytes(part_path(other / "a.mcap", 2).read_bytes())
    with pytest.raises(CorruptLog, match=r"a\.part2\.mcap: is no part of the session in a\.mcap"):
        open_recording(rotated.out)


def test_one_file_needs_no_manifest(make: Callable[..., Bench]) -> None:
    bench = make()
    bench.put(0, 10)
    bench.logger.finish("session closed")
    assert not manifest_path(bench.out).exists()


# --- the process -----------------------------------------------------------------------------------------------------


@pytest.mark.real_time
@pytest.mark.parametrize("policy", ["stop", "finish"])
def test_the_policy_decides_whether_the_logger_stays(recording: Any, tmp_path: Path, policy: str) -> None:
    """A limit on the size of files is a full disk that needs no disk."""
    packed = recording.packed(recording.cycles(60))
    path, out = tmp_path / "ring", tmp_path / "a.mcap"
    ring.create(path, recording.layout.size, 50_000)
    ring.create(ring.wire_path(path), 600, 10)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    command = [
        sys.executable, "-m", "logs.writer", "--cell", "fanuc-sim-truth", "--ring", str(path), "--out", str(out),
        "--set", f"bus.endpoint={endpoint}", "--set", f"log.on_full={policy}",
    ]  # fmt: skip
    environment = {**os.environ, "XDG_STATE_HOME": str(tmp_path)}
    limit = 200_000
    with open_router(endpoint) as bus, ring.RingWriter(path) as cycles:
        state = bus.queue(STATE.key)
        process = subprocess.Popen(
            command, cwd=ROOT, env=environment, stderr=subprocess.PIPE, text=True,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
        )  # fmt: skip
        try:
            dropped = 0
            while not dropped and process.poll() is None:
                for record in packed if cycles.backlog < 10_000 else []:
                    cycles.put(record)
                while (data := state.take()) is not None:
                    dropped = json.loads(data)["dropped"]
                time.sleep(0.005)
            if policy == "finish":
                assert process.poll() is None
                cycles.close()
            _, errors = process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == 1
    assert "File too large" in errors
    assert errors.count("\n") == 1
    assert out.stat().st_size <= limit
    assert open_log(out).cycles > 0
