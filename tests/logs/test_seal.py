"""Whoever changes a sealed recording, by however little and however cleverly, is found out."""

import dataclasses
import os
import random
import zlib
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from mcap.records import Chunk, Metadata

from logs import seal
from logs.mcap_scan import CorruptLog, Extent, LogError, Op, Raw, chunk_data, frames, parse
from logs.mcap_writer import Appender, McapWriter, encode
from logs.reader import open_log
from logs.recover import recover

KEY = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))
THIEF = Ed25519PrivateKey.from_private_bytes(bytes(32))


@pytest.fixture
def sealed(recording: Any) -> Path:
    path: Path = recording.write(recording.packed(recording.cycles(36)), key=KEY)
    return path


def test_seals_cover_the_file(sealed: Path) -> None:
    log = open_log(sealed)
    assert log.seals.count >= 3
    assert log.seals.final
    assert log.seals.public_key == seal.raw_hex(KEY.public_key())
    assert log.seals.sealed_bytes > 0.9 * log.extent.data_bytes
    assert seal.check_file(sealed, log.seals.public_key) is True


def test_a_session_without_a_key_has_no_seals(recording: Any) -> None:
    path = recording.write(recording.packed(recording.cycles(6)))
    log = open_log(path)
    assert (log.seals.count, log.seals.public_key) == (0, "")
    assert not seal.signature_path(path).exists()


def test_the_detached_signature_is_over_every_byte(sealed: Path) -> None:
    public = seal.raw_hex(KEY.public_key())
    data = bytearray(sealed.read_bytes())
    data[-20] ^= 1  # in the footer, behind the last seal
    sealed.write_bytes(data)
    assert seal.check_file(sealed, public) is False
    seal.signature_path(sealed).write_text("{}")
    assert seal.check_file(sealed, public) is False
    seal.signature_path(sealed).unlink()
    assert seal.check_file(sealed, public) is None


def test_the_detached_signature_of_another_key_does_not_hold(sealed: Path) -> None:
    assert seal.check_file(sealed, seal.raw_hex(THIEF.public_key())) is False


# --- attacks by somebody who repairs every checksum ----------------------------------------------------------------


def parts(path: Path) -> list[bytes]:
    """The data section record by record."""
    data = path.read_bytes()
    return [data[raw.start : raw.end] for raw in frames(data, str(path), Extent())]


def rebuilt(path: Path, records: list[bytes]) -> Path:
    """A closed file of these records with every checksum right; the summary is of no interest to our reader."""
    path.unlink(missing_ok=True)
    writer = McapWriter(Appender(path, os.O_CREAT))
    writer.file.append(b"\x89MCAP0\r\n")
    for record in records:
        writer.file.append(record)
    writer.finish()
    return path


def op(record: bytes) -> int:
    return record[0]


def body(kind: Any, record: bytes) -> Any:
    return parse(kind, record, "record", Raw(record[0], 0, 9, len(record)))


def other_cycle(chunk: bytes) -> bytes:
    """The chunk with one bit of its content changed and every checksum repaired."""
    found: Chunk = body(Chunk, chunk)
    content = bytearray(chunk_data(chunk, "chunk", Raw(Op.CHUNK, 0, 9, len(chunk))))
    content[-100] ^= 4
    return encode(dataclasses.replace(found, compression="", data=bytes(content), uncompressed_crc=zlib.crc32(content)))


def is_seal(record: bytes) -> bool:
    return op(record) == Op.METADATA and bool(body(Metadata, record).name.startswith(seal.PREFIX))


def chunks(records: list[bytes]) -> list[int]:
    return [i for i, record in enumerate(records) if op(record) == Op.CHUNK]


def test_a_changed_chunk_with_repaired_checksums_breaks_the_seal_after_it(sealed: Path, tmp_path: Path) -> None:
    records = parts(sealed)
    rebuilt(tmp_path / "same.mcap", records)
    assert open_log(tmp_path / "same.mcap").cycles == 36  # the attack itself is sound
    for place in chunks(records)[1:]:
        altered = [*records[:place], other_cycle(records[place]), *records[place + 1 :]]
        with pytest.raises(CorruptLog, match="altered: seal"):
            open_log(rebuilt(tmp_path / "bad.mcap", altered))


def test_swapped_chunks_with_repaired_checksums_break_the_seal(sealed: Path, tmp_path: Path) -> None:
    records = parts(sealed)
    first, second = chunks(records)[1:3]
    records[first], records[second] = records[second], records[first]
    with pytest.raises(CorruptLog, match="altered: seal"):
        open_log(rebuilt(tmp_path / "bad.mcap", records))


@pytest.mark.parametrize("victim", [0, 1, -1])
def test_a_missing_seal_is_noticed(sealed: Path, tmp_path: Path, victim: int) -> None:
    records = parts(sealed)
    places = [i for i, record in enumerate(records) if is_seal(record)]
    del records[places[victim]]
    with pytest.raises(CorruptLog, match="altered"):
        open_log(rebuilt(tmp_path / "bad.mcap", records))


def test_no_seals_at_all_is_noticed(sealed: Path, tmp_path: Path) -> None:
    with pytest.raises(CorruptLog, match="seals are missing"):
        open_log(rebuilt(tmp_path / "bad.mcap", [r for r in parts(sealed) if not is_seal(r)]))


def resealed(records: list[bytes], key: Ed25519PrivateKey, session: dict[str, str], target: Path) -> Path:
    """All seals made anew with `key`."""
    target.unlink(missing_ok=True)
    writer = McapWriter(Appender(target, os.O_CREAT))
    writer.file.append(b"\x89MCAP0\r\n")
    sealer = seal.Sealer(key, session[seal.SESSION_ID])
    for record in records:
        if is_seal(record):
            final = body(Metadata, record).metadata["final"] == "true"
            made = sealer.seal(writer.file.size, writer.file.sha.hexdigest(), final)
            writer.metadata(*made)
        else:
            writer.file.append(record)
    writer.finish()
    return target


def test_chunks_signed_anew_with_another_key_are_noticed(sealed: Path, tmp_path: Path) -> None:
    records, session = parts(sealed), open_log(sealed).session
    place = chunks(records)[2]
    records[place] = other_cycle(records[place])
    with pytest.raises(CorruptLog, match="altered: seal 1"):  # the key in the session is still the true one
        open_log(resealed(records, THIEF, session, tmp_path / "bad.mcap"))


def test_a_whole_new_identity_has_another_key(sealed: Path, tmp_path: Path) -> None:
    """Then only the key tells, which the auditor must know."""
    records = parts(sealed)
    place = next(i for i, r in enumerate(records) if op(r) == Op.METADATA and body(Metadata, r).name == "session")
    session = {**body(Metadata, records[place]).metadata, seal.PUBLIC_KEY: seal.raw_hex(THIEF.public_key())}
    records[place] = encode(Metadata(name="session", metadata=session))
    log = open_log(resealed(records, THIEF, session, tmp_path / "bad.mcap"))
    assert log.seals.public_key != seal.raw_hex(KEY.public_key())


# --- random damage ---------------------------------------------------------------------------------------------------


def damage(whole: bytes, rng: random.Random) -> tuple[str, bytes]:
    kind = rng.choice(["bit", "bit", "cut", "swap", "hole", "zeros"])
    at = rng.randrange(len(whole))
    data = bytearray(whole)
    if kind == "bit":
        data[at] ^= 1 << rng.randrange(8)
    elif kind == "cut":
        del data[at:]
    elif kind == "hole":
        del data[at : at + rng.randrange(1, 400)]
    elif kind == "zeros":
        data[at : at + 200] = bytes(len(data[at : at + 200]))
    else:
        other, size = rng.randrange(len(whole)), rng.randrange(1, 200)
        a, b = sorted((at, other))
        size = min(size, b - a, len(whole) - b)
        data[a : a + size], data[b : b + size] = data[b : b + size], data[a : a + size]
    return kind, bytes(data)


@pytest.mark.parametrize("count", [60, pytest.param(1000, marks=pytest.mark.slow)])
def test_random_damage_is_always_detected_and_crashes_no_reader(sealed: Path, tmp_path: Path, count: int) -> None:
    """Detected: an error that names the file, or a file that says that it was not closed."""
    whole, rng, bad = sealed.read_bytes(), random.Random(count), tmp_path / "bad.mcap"
    for _ in range(count):
        kind, data = damage(whole, rng)
        if data == whole:
            continue
        bad.write_bytes(data)
        try:
            log = open_log(bad)
        except LogError as error:
            assert str(error).startswith(str(bad))
            assert "\n" not in str(error)
        else:
            assert log.truncated, kind
            assert not log.seals.final or log.extent.data_bytes == open_log(sealed).extent.data_bytes


def test_random_damage_of_a_recovered_file_is_detected(recording: Any, tmp_path: Path) -> None:
    crashed = recording.write(recording.packed(recording.cycles(24)), key=KEY, close=False)
    recover(crashed, tmp_path / "whole.mcap", key=KEY)
    whole, rng, bad = (tmp_path / "whole.mcap").read_bytes(), random.Random(5), tmp_path / "bad.mcap"
    for _ in range(30):
        data = bytearray(whole)
        data[rng.randrange(len(whole) - 8)] ^= 1 << rng.randrange(8)
        bad.write_bytes(data)
        with pytest.raises(LogError):
            open_log(bad)


# --- keys ------------------------------------------------------------------------------------------------------------


def test_a_key_is_made_at_first_use_and_kept(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    first, again = seal.load_key(), seal.load_key()
    file = tmp_path / "asc" / "log.key"
    assert first.private_bytes_raw() == again.private_bytes_raw()
    assert file.stat().st_mode & 0o777 == 0o600
    public = seal.load_public_key(file.with_name("log.key.pub"))
    assert seal.raw_hex(public) == seal.raw_hex(first.public_key())
    assert not list(file.parent.glob("*.[0-9]*"))


@pytest.mark.parametrize("what", ["none", "open", "text", "other"])
def test_a_key_that_cannot_be_used_is_one_clear_line(tmp_path: Path, what: str) -> None:
    file = tmp_path / "key"
    if what != "none":
        file.touch(0o644 if what == "open" else 0o600)
    if what in ("text", "other"):
        file.write_bytes(b"no key" if what == "text" else seal.public_pem(KEY.public_key()))
    with pytest.raises(seal.KeyFileError) as error:
        seal.load_key(file)
    assert str(file) in str(error.value)
    assert error.value.hint


def test_a_seal_signs_every_field(sealed: Path) -> None:
    records = parts(sealed)
    fields = body(Metadata, next(r for r in records if is_seal(r))).metadata
    for name in ("session", "seq", "offset", "sha256", "time", "final"):
        seals = seal.Seals("file")
        seals.begin(open_log(sealed).session)
        changed = {**fields, name: "true" if name == "final" else fields[name] + "1"}
        with pytest.raises(CorruptLog):
            seals.check(changed, int(changed["offset"]), changed["sha256"])
