"""The record is held against the raw packets: made here by the simulator's own codec."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from logs import schema
from logs.recording import open_recording
from logs.wire import codec_of, replay_wire

Packets = list[tuple[schema.Channel, int, bytes]]


def test_true_packets_match(wire_session: Callable[..., Path]) -> None:
    report = replay_wire(open_recording(wire_session()))
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
def test_one_changed_bit_is_a_mismatch(wire_session: Callable[..., Path], which: int, byte: int, words: str) -> None:
    def spoil(packets: Packets) -> None:
        channel, t_ns, data = packets[which]
        packets[which] = (channel, t_ns, flipped(data, byte))

    report = replay_wire(open_recording(wire_session(spoil)))
    assert report.mismatches == 1
    assert report.first.startswith("cycle 3: ")
    assert any(word in report.first for word in words.split("|"))


@pytest.mark.parametrize("which", [6, 7])
def test_a_missing_packet_is_a_mismatch(wire_session: Callable[..., Path], which: int) -> None:
    assert replay_wire(open_recording(wire_session(lambda packets: packets.pop(which)))).mismatches == 1


def test_a_driver_without_a_codec_is_checked_for_presence_only(
    wire_session: Callable[..., Path], recording: Any
) -> None:
    cell = dataclasses.replace(recording.cell, driver={"name": "loopback"})

    def spoil(packets: Packets) -> None:
        packets[:] = [(channel, t_ns, b"x") for channel, t_ns, _ in packets]

    report = replay_wire(open_recording(wire_session(spoil, cell)))
    assert (report.decoded, report.mismatches) == (False, 0)


@pytest.mark.parametrize("driver", ["{}", "no json", '{"name": "gone"}', '{"name": "fanuc-j519"}', "[1]"])
def test_a_driver_that_cannot_be_made_has_no_codec(recording: Any, driver: str) -> None:
    log = open_recording(recording.write(recording.packed(recording.cycles(3))))
    log.session["driver"] = driver
    assert codec_of(log) is None
