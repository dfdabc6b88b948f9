"""The record is held against the raw packets: made here by the simulator's own codec."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.base import ReplayCodec
from drivers.registry import driver_class
from logs import schema
from logs.context import attachments, session
from logs.log_file import LogFile
from logs.reader import open_log
from logs.wire import codec_of, replay_wire
from sim_hil.fanuc import wire as peer

Packets = list[tuple[schema.Channel, int, bytes]]


def status(seq: int, joints: Any, current: Any) -> bytes:
    return peer.write_reply("status", 3, sequence=seq, status=0x0F, joints=joints, current=current)


def codec() -> ReplayCodec:
    made = driver_class("fanuc-j519")({"host": "127.0.0.1", "version": 3})
    assert isinstance(made, ReplayCodec)
    return made


@pytest.fixture
def make(recording: Any, tmp_path: Path) -> Callable[..., Path]:
    """A session whose packets are true, and `spoil` to change them or the cycles."""

    def build(spoil: Callable[[Packets], None] = lambda packets: None, cell: Any = None) -> Path:
        packets: Packets = []
        cycles = []
        for state, x, out, receipt, timings in recording.cycles(12):
            joints = np.float32(np.linspace(-20, 30, 9) + x.tick)
            data = status(x.tick, joints, joints / 10)
            told = codec().decode_sample(data)
            assert told is not None
            joint = dataclasses.replace(x.joint, seq=told[0], q=told[1], current=told[2])
            packets.append((schema.WIRE_RX, joint.t_rx_ns, data))
            sent = codec().encode_set_point(receipt.seq, out.command.q, out.command.is_last)
            packets.append((schema.WIRE_TX, receipt.t_tx_ns, sent))
            cycles.append((state, dataclasses.replace(x, joint=joint), out, receipt, timings))
        spoil(packets)
        log = LogFile(tmp_path / "a.mcap", attachments(recording.cell), session(cell or recording.cell))
        for cycle, record in zip(cycles, recording.packed(cycles), strict=True):
            log.message(schema.CYCLE, cycle[1].t_ns, record)
        for channel, t_ns, data in packets:
            log.message(channel, t_ns, schema.wire_message(t_ns, len(data), data))
        log.close({})
        return tmp_path / "a.mcap"

    return build


def test_true_packets_match(make: Callable[..., Path]) -> None:
    report = replay_wire(open_log(make()))
    assert (report.packets, report.decoded, report.mismatches, report.first) == (24, True, 0, "")


def flipped(data: bytes, byte: int) -> bytes:
    changed = bytearray(data)
    changed[byte] ^= 1
    return bytes(changed)


@pytest.mark.parametrize(
    ("which", "byte", "words"),
    [
        (6, -60, "its sample decodes otherwise"),  # a joint angle
        (6, 11, "its sample decodes otherwise"),  # the sequence
        (6, -25, "its sample decodes otherwise"),  # a motor current
        (6, 3, "another kind|does not decode"),  # the type
        (6, 7, "does not decode"),  # the version
        (7, -3, "other bytes than were sent"),
        (7, 11, "other bytes than were sent"),
    ],
)
def test_one_changed_bit_is_a_mismatch(make: Callable[..., Path], which: int, byte: int, words: str) -> None:
    def spoil(packets: Packets) -> None:
        channel, t_ns, data = packets[which]
        packets[which] = (channel, t_ns, flipped(data, byte))

    report = replay_wire(open_log(make(spoil)))
    assert report.mismatches == 1
    assert report.first.startswith("cycle 3: ")
    assert any(word in report.first for word in words.split("|"))


@pytest.mark.parametrize("which", [6, 7])
def test_a_missing_packet_is_a_mismatch(make: Callable[..., Path], which: int) -> None:
    assert replay_wire(open_log(make(lambda packets: packets.pop(which)))).mismatches == 1


def test_a_driver_without_a_codec_is_checked_for_presence_only(make: Callable[..., Path], recording: Any) -> None:
    cell = dataclasses.replace(recording.cell, driver={"name": "loopback"})

    def spoil(packets: Packets) -> None:
        packets[:] = [(channel, t_ns, b"x") for channel, t_ns, _ in packets]

    report = replay_wire(open_log(make(spoil, cell)))
    assert (report.decoded, report.mismatches) == (False, 0)


@pytest.mark.parametrize("driver", ["{}", "no json", '{"name": "gone"}', '{"name": "fanuc-j519"}', "[1]"])
def test_a_driver_that_cannot_be_made_has_no_codec(recording: Any, driver: str) -> None:
    log = open_log(recording.write(recording.packed(recording.cycles(3))))
    log.metadata[schema.SESSION]["driver"] = driver
    assert codec_of(log) is None
