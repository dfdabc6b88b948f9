"""A recording is read back as it was written; damage is an error, a crash is not."""

import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from asc_rt.core.params import Params
from logs import schema
from logs.log_file import LogFile
from logs.reader import CorruptLog, ForeignFile, LogError, open_log, records


def test_everything_written_is_read_back(recording: Any) -> None:
    packed = recording.packed(recording.cycles(20))
    log = open_log(recording.write(packed, [(schema.GOAL, 77, {"id": 1})]))
    assert log.cycles == 20
    assert [log.record(i) for i in range(20)] == packed
    assert b"".join(batch.tobytes() for batch in log.batches()) == b"".join(packed)
    assert log.params == recording.params
    assert Params.from_canonical(log.attachments[schema.PARAMS]) == recording.params
    assert log.attachments[schema.CELL] == recording.cell.text.encode()
    assert log.attachments["lrmate_200id.urdf"] == recording.params.robot.urdf.encode()
    assert log.fingerprint["packages"]["numpy"] == np.__version__
    assert log.session["cell"] == "fanuc-sim-truth"
    assert log.end["messages /cell/cycle"] == "20"
    assert not log.truncated
    assert [(m.t_ns, m.data) for m in log.messages("/cell/goal")] == [(77, b'{"id": 1}')]
    assert len(list(log.messages("/wire/rx", "/wire/tx"))) == 40


def test_columns_are_of_all_cycles(recording: Any) -> None:
    path = recording.write(recording.packed(recording.cycles(20)))
    assert open_log(path).columns("inputs.tick")["inputs.tick"].tolist() == list(range(20))
    assert records(path)["state.tick"].tolist() == list(range(20))


def test_other_tools_read_it_too(recording: Any) -> None:
    path = recording.write(recording.packed(recording.cycles(20)))
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True)
        found = list(reader.iter_messages(topics=["/cell/cycle"]))
        assert len(found) == 20
        assert {s.name for s, _, _ in found if s} == {"asc.v1.CycleRecord"}
        assert {a.name for a in reader.iter_attachments()} >= {schema.PARAMS, schema.CELL, schema.FINGERPRINT}


def test_a_recording_is_never_overwritten(recording: Any) -> None:
    path = recording.write(recording.packed(recording.cycles(2)))
    before = path.read_bytes()
    with pytest.raises(FileExistsError):
        LogFile(path, {}, {})
    assert path.read_bytes() == before


def prefix_or_error(path: Path, packed: list[bytes]) -> int | None:
    """Number of cycles read from a cut file, which must be the first ones; None: not even its beginning is there."""
    try:
        log = open_log(path)
    except ForeignFile:
        return None
    assert log.truncated
    assert [log.record(i) for i in range(log.cycles)] == packed[: log.cycles]
    return log.cycles


def test_a_cut_file_gives_all_that_is_complete(recording: Any, tmp_path: Path) -> None:
    packed = recording.packed(recording.cycles(30))
    whole = recording.write(packed).read_bytes()
    rng, cut = random.Random(1), tmp_path / "cut.mcap"
    found = []
    for length in sorted(rng.sample(range(1, len(whole)), 60)):
        cut.write_bytes(whole[:length])
        found.append(prefix_or_error(cut, packed))
    assert found[0] is None
    counts = [n for n in found if n is not None]
    assert counts == sorted(counts)
    assert counts[-1] == 30


def test_a_crashed_session_loses_nothing_that_was_flushed(recording: Any) -> None:
    packed = recording.packed(recording.cycles(30))
    log = open_log(recording.write(packed, close=False))
    assert log.truncated
    assert [log.record(i) for i in range(log.cycles)] == packed


def test_every_flipped_bit_is_detected(recording: Any, tmp_path: Path) -> None:
    whole = recording.write(recording.packed(recording.cycles(12))).read_bytes()
    rng, bad = random.Random(2), tmp_path / "bad.mcap"
    for _ in range(200):
        data = bytearray(whole)
        place = rng.randrange(len(data))
        data[place] ^= 1 << rng.randrange(8)
        bad.write_bytes(data)
        if place >= len(whole) - 8:  # without its last mark the file looks like one that was not closed
            assert open_log(bad).truncated
            continue
        with pytest.raises(LogError) as error:
            open_log(bad)
        assert str(error.value).startswith(str(bad))
        assert "\n" not in str(error.value)


def test_a_flipped_bit_in_the_chunks_of_a_crashed_file_is_detected(recording: Any, tmp_path: Path) -> None:
    path = recording.write(recording.packed(recording.cycles(12)), close=False)
    whole, chunk = path.read_bytes(), open_log(path)._chunks[1].raw
    rng, bad = random.Random(4), tmp_path / "bad.mcap"
    head = 8 + 8 + 8 + 4 + 4 + 4 + 8  # of a chunk, before its compressed content
    for _ in range(60):
        data = bytearray(whole)
        data[rng.randrange(chunk.body + head, chunk.end)] ^= 1 << rng.randrange(8)
        bad.write_bytes(data)
        with pytest.raises(CorruptLog, match=f"byte {chunk.start}"):
            open_log(bad)


def test_a_length_that_reaches_beyond_a_closed_file_is_damage_and_not_a_crash(recording: Any, tmp_path: Path) -> None:
    path = recording.write(recording.packed(recording.cycles(12)))
    data, chunk = bytearray(path.read_bytes()), open_log(path)._chunks[1].raw
    data[chunk.start + 5] ^= 1  # a byte of the length that counts gigabytes
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(data)
    with pytest.raises(CorruptLog, match=f"byte {chunk.start}"):
        open_log(bad)


def test_chunks_that_change_places_are_detected(recording: Any, tmp_path: Path) -> None:
    path = recording.write(recording.packed(recording.cycles(12)))
    log = open_log(path)
    first, second = (chunk.raw for chunk in log._chunks[1:3])
    data = path.read_bytes()
    swapped = (
        data[: first.start]
        + data[second.start : second.end]
        + data[first.end : second.start]
        + data[first.start : first.end]
        + data[second.end :]
    )
    bad = tmp_path / "swapped.mcap"
    bad.write_bytes(swapped)
    with pytest.raises(CorruptLog):
        open_log(bad)


@pytest.mark.parametrize("content", [b"", b"x", b"PK\x03\x04 a zip file", b"\x89MCAP0\r\n"])
def test_other_files_are_foreign(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "foreign.mcap"
    path.write_bytes(content)
    with pytest.raises(ForeignFile) as error:
        open_log(path)
    assert str(path) in str(error.value)


def test_an_mcap_of_someone_else_is_foreign(tmp_path: Path) -> None:
    path = tmp_path / "other.mcap"
    writer = Writer(str(path), enable_data_crcs=True)
    writer.start()
    channel = writer.register_channel("/other", "json", writer.register_schema("", "", b""))
    writer.add_message(channel, 0, b"{}", 0)
    writer.finish()
    with pytest.raises(ForeignFile, match="no recording"):
        open_log(path)


def test_a_file_that_is_not_there_is_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="No such file"):
        open_log(tmp_path / "none.mcap")
