"""A crash costs nothing: recovered files hold every complete cycle and every earlier byte."""

import random
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from mcap.reader import make_reader

from asc_rt import ring
from logs import schema
from logs.mcap_scan import LogError
from logs.reader import open_log
from logs.recover import recover

RERUN = Path(sys.executable).with_name("rerun")
KEY = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))


def crashed(recording: Any, count: int = 30, **options: Any) -> tuple[Path, list[bytes]]:
    packed = recording.packed(recording.cycles(count))
    return recording.write(packed, close=False, key=KEY, **options), packed


@pytest.mark.parametrize("seed", range(12))
def test_a_file_cut_anywhere_is_closed_again(recording: Any, tmp_path: Path, seed: int) -> None:
    path, packed = crashed(recording)
    whole = path.read_bytes()
    start = open_log(path)._chunks[0].raw.end
    cut = random.Random(seed).randrange(start, len(whole))
    path.write_bytes(whole[:cut])
    before = open_log(path)
    out = tmp_path / "out.mcap"
    found = recover(path, out)
    made = out.read_bytes()
    assert made.startswith(whole[: before.extent.data_bytes])
    assert found.bytes_cut == cut - before.extent.data_bytes
    log = open_log(out)
    assert not log.truncated
    assert log.cycles == found.cycles == before.cycles
    assert [log.record(i) for i in range(log.cycles)] == packed[: log.cycles]
    assert (log.seals.count, log.seals.sealed_bytes) == (before.seals.count, before.seals.sealed_bytes)
    assert log.recovered["bytes_cut"] == str(found.bytes_cut)
    assert found.seals_valid


def test_other_readers_see_a_whole_file(recording: Any, tmp_path: Path) -> None:
    path, packed = crashed(recording)
    data = path.read_bytes()
    last = open_log(path)._chunks[-1].raw
    path.write_bytes(data[: last.end + 5])  # the crash came between the last chunk and its index
    recover(path, tmp_path / "out.mcap")
    with open(tmp_path / "out.mcap", "rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert [m.data for _, _, m in reader.iter_messages(schema.CYCLE.topic, log_time_order=False)] == packed
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        assert summary.statistics.channel_message_counts[1] == len(packed)
        assert {a.name for a in reader.iter_attachments()} == set(open_log(path).attachments)
        assert {m.name for m in reader.iter_metadata()} >= {"session", "seal.000001", "recovered"}
    done = subprocess.run([str(RERUN), "mcap", "check", str(tmp_path / "out.mcap")], capture_output=True, text=True)
    assert done.returncode == 0
    assert "ok" in done.stdout


def test_what_the_ring_still_holds_is_added(recording: Any, tmp_path: Path) -> None:
    packed = recording.packed(recording.cycles(40))
    path = recording.write(packed[:25], close=False, key=KEY)
    unsealed = bytearray(packed[39])
    unsealed[-4:] = bytes(4)  # as the loop leaves it
    ring.create(tmp_path / "ring", recording.layout.size, 30)
    ring.create(ring.wire_path(tmp_path / "ring"), 600, 30)
    with ring.RingWriter(tmp_path / "ring") as cycles, ring.RingWriter(ring.wire_path(tmp_path / "ring")) as wire:
        for record in [*packed[:39], bytes(unsealed)]:
            cycles.put(record)
        ring.wire_tap(wire)("rx", 2**60, b"late")
    found = recover(path, tmp_path / "out.mcap", tmp_path / "ring", KEY)
    log = open_log(tmp_path / "out.mcap")
    assert [log.record(i) for i in range(log.cycles)] == packed
    assert (found.cycles, found.cycles_from_ring) == (40, 15)
    assert [schema.parse_wire_message(m.data) for m in log.messages("/wire/rx")][-1] == (2**60, 4, b"late")
    assert log.seals.final  # recovered with the session's own key
    with ring.RingReader(tmp_path / "ring") as reader:
        assert reader.take() is not None  # the ring itself is as it was


def test_another_key_does_not_speak_for_the_session(recording: Any, tmp_path: Path) -> None:
    path, _ = crashed(recording)
    recover(path, tmp_path / "out.mcap", key=Ed25519PrivateKey.from_private_bytes(bytes(32)))
    log = open_log(tmp_path / "out.mcap")
    assert not log.seals.final
    assert log.seals.count > 0


def test_a_crash_before_the_first_cycle(recording: Any, tmp_path: Path) -> None:
    path, packed = crashed(recording, 5)
    log = open_log(path)
    path.write_bytes(path.read_bytes()[: log._chunks[0].raw.start])
    ring.create(tmp_path / "ring", recording.layout.size, 10)
    ring.create(ring.wire_path(tmp_path / "ring"), 600, 10)
    with ring.RingWriter(tmp_path / "ring") as cycles:
        for record in packed:
            cycles.put(record)
    assert recover(path, tmp_path / "out.mcap", tmp_path / "ring").cycles == 5


def test_what_needs_no_recovery_is_refused(recording: Any, tmp_path: Path) -> None:
    path = recording.write(recording.packed(recording.cycles(5)))
    with pytest.raises(LogError, match="good order"):
        recover(path, tmp_path / "out.mcap")


def test_nothing_is_overwritten(recording: Any, tmp_path: Path) -> None:
    path, _ = crashed(recording, 5)
    with pytest.raises(FileExistsError):
        recover(path, path)


def test_damage_is_not_recovered(recording: Any, tmp_path: Path) -> None:
    path, _ = crashed(recording)
    data = bytearray(path.read_bytes())
    data[open_log(path)._chunks[2].raw.end - 10] ^= 1
    path.write_bytes(data)
    with pytest.raises(LogError, match="damaged"):
        recover(path, tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()
