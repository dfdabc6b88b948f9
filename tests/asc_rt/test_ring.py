"""The ring hands over every slot in order, never waits, and counts what a slow reader loses."""

import multiprocessing
import os
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asc_rt import ring
from asc_rt.ring import RingError, RingReader, RingWriter

SLOTS = 8


@pytest.fixture
def path(tmp_path: Path) -> Path:
    made = tmp_path / "ring"
    ring.create(made, slot_size=100, slots=SLOTS)
    return made


def payload(k: int) -> bytes:
    return k.to_bytes(4, "little") * (k % 20 + 1)


def test_what_is_put_is_taken_in_order(path: Path) -> None:
    with RingWriter(path) as writer, RingReader(path) as reader:
        for k in range(3 * SLOTS):
            writer.put(payload(k))
            assert reader.take() == payload(k)
        assert reader.take() is None
        assert reader.lost == 0


def test_a_lapped_reader_gets_the_newest_and_counts_the_rest(path: Path) -> None:
    with RingWriter(path) as writer, RingReader(path) as reader:
        for k in range(SLOTS + 5):
            writer.put(payload(k))
        assert list(reader.drain()) == [payload(k) for k in range(5, SLOTS + 5)]
        assert reader.lost == 5


@settings(max_examples=50, deadline=None)
@given(st.lists(st.integers(0, 2 * SLOTS), max_size=20))
def test_every_slot_is_taken_or_counted(tmp_path_factory: pytest.TempPathFactory, bursts: list[int]) -> None:
    path = tmp_path_factory.mktemp("ring") / "ring"
    ring.create(path, slot_size=100, slots=SLOTS)
    taken: list[bytes] = []
    with RingWriter(path) as writer, RingReader(path) as reader:
        for burst in bursts:
            for _ in range(burst):
                writer.put(payload(writer.head))
            taken += reader.drain()
        assert len(taken) + reader.lost == writer.head
        assert taken == sorted(taken, key=lambda data: int.from_bytes(data[:4], "little"))


class Racing:
    """The reader's memory; the producer laps the reader once, just while a slot is copied."""

    def __init__(self, memory: memoryview, writer: RingWriter) -> None:
        self._memory, self._writer = memory, writer

    def __getitem__(self, place: slice) -> memoryview:
        half = self._memory[place.start : place.start + 2].tobytes()
        while self._writer.head < SLOTS + 1:
            self._writer.put(payload(self._writer.head))
        return memoryview(half + self._memory[place.start + 2 : place.stop].tobytes())

    def release(self) -> None:
        self._memory.release()


def test_a_slot_overwritten_while_it_is_copied_is_lost_not_torn(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with RingWriter(path) as writer, RingReader(path) as reader:
        writer.put(payload(0))
        monkeypatch.setattr(reader, "memory", Racing(reader.memory, writer))
        assert reader.take() == payload(1)
        assert reader.lost == 1


def test_a_slot_that_is_being_overwritten_is_lost(path: Path) -> None:
    with RingWriter(path) as writer, RingReader(path) as reader:
        writer.put(payload(0))
        writer.put(payload(1))
        writer._words[ring.HEADER_SIZE >> 3] = 0  # as the producer leaves it while it writes into this slot
        assert reader.take() == payload(1)
        assert reader.lost == 1


def test_a_successor_begins_after_what_was_made_durable(path: Path) -> None:
    with RingWriter(path) as writer:
        for k in range(4):
            writer.put(payload(k))
        with RingReader(path) as reader:
            assert reader.take() == payload(0)
            reader.commit()
            assert reader.take() == payload(1)  # taken, but not safe when the reader dies
        assert writer.backlog == 3
        with RingReader(path) as successor:
            assert list(successor.drain()) == [payload(k) for k in range(1, 4)]


def test_finished_means_closed_and_drained(path: Path) -> None:
    with RingReader(path) as reader:
        with RingWriter(path) as writer:
            writer.put(b"last")
            assert not reader.finished
        assert reader.closed
        assert not reader.finished
        assert reader.take() == b"last"
        assert reader.finished


def test_a_payload_larger_than_a_slot_is_refused(path: Path) -> None:
    with RingWriter(path) as writer, RingReader(path) as reader:
        with pytest.raises(ValueError, match="101 bytes"):
            writer.put(bytes(101))
        assert reader.take() is None


def test_what_was_begun_and_given_up_was_never_there(path: Path) -> None:
    with RingWriter(path) as writer, RingReader(path) as reader:
        writer.memory[writer.begin(4)] = 1
        assert reader.take() is None
        at = writer.begin(3)
        writer.memory[at : at + 3] = b"two"
        writer.end()
        assert (reader.take(), reader.take(), reader.lost) == (b"two", None, 0)


def test_a_producer_that_comes_again_goes_on(path: Path) -> None:
    with RingReader(path) as reader:
        for k in range(3):
            with RingWriter(path) as writer:
                writer.put(payload(k))
            assert reader.take() == payload(k)


def produce(path: Path, count: int) -> None:
    writer = RingWriter(path)
    for k in range(count):
        writer.put(payload(k))
    os._exit(9)  # no close, no clean-up: as a killed controller


def test_a_producer_that_dies_leaves_all_it_has_put(path: Path) -> None:
    process = multiprocessing.get_context("spawn").Process(target=produce, args=(path, 5))
    process.start()
    with RingReader(path) as reader:
        process.join(30)
        assert process.exitcode == 9
        assert list(reader.drain()) == [payload(k) for k in range(5)]
        assert not reader.closed
    assert path.exists()


def test_an_existing_file_is_not_taken_over(path: Path) -> None:
    before = path.read_bytes()
    with pytest.raises(RingError, match="File exists"):
        ring.create(path, slot_size=100, slots=SLOTS)
    assert path.read_bytes() == before


def test_no_room_is_found_at_once_and_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(RingError):
        ring.create(tmp_path / "huge", slot_size=1 << 40, slots=1 << 20)
    assert not (tmp_path / "huge").exists()


@pytest.mark.parametrize("content", [b"", b"not a ring", bytes(ring.HEADER_SIZE), bytes(2 * ring.HEADER_SIZE)])
def test_another_file_is_no_ring(tmp_path: Path, content: bytes) -> None:
    other = tmp_path / "other"
    other.write_bytes(content)
    with pytest.raises(RingError, match="not a ring"):
        RingReader(other)


def test_the_tap_keeps_direction_time_and_bytes(tmp_path: Path) -> None:
    path = tmp_path / "session"
    ring.create_session(path, record_size=100, period_ns=1_000_000_000)
    with RingWriter(ring.wire_path(path)) as writer, RingReader(ring.wire_path(path)) as reader:
        tap = ring.wire_tap(writer)
        tap("rx", 123, b"status")
        tap("tx", -4, bytes(ring.WIRE_DATA_SIZE + 10))
        assert ring.parse_wire(reader.take() or b"") == ("rx", 123, 6, b"status")
        long = ring.parse_wire(reader.take() or b"")
        assert long == ("tx", -4, ring.WIRE_DATA_SIZE + 10, bytes(ring.WIRE_DATA_SIZE))
    ring.remove_session(path)
    assert not list(tmp_path.iterdir())


def test_a_session_ring_is_as_deep_as_it_says(tmp_path: Path) -> None:
    ring.create_session(tmp_path / "session", record_size=64, period_ns=8_000_000)
    with RingReader(tmp_path / "session") as cycles, RingReader(ring.wire_path(tmp_path / "session")) as wire:
        assert cycles.slots * 0.008 == pytest.approx(ring.DEPTH_S)
        assert wire.slots == 2 * cycles.slots
