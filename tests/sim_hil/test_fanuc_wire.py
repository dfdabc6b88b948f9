"""The simulated controller's codec against bytes made by hand from the packet description."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from sim_hil.fanuc import wire
from sim_hil.fanuc.settings import Settings, thresholds
from sim_hil.fanuc.tables import LR_MATE_200ID


def u32(*numbers: int) -> bytes:
    return struct.pack(f">{len(numbers)}I", *numbers)


def test_sizes() -> None:
    assert {kind: layout.itemsize for kind, (_, layout) in wire.REQUESTS.items()} == {
        0: 8, 1: 64, 2: 8, 3: 16, 4: 8, 5: 104, 6: 8,
    }  # fmt: skip
    assert {kind: layout.itemsize for kind, (_, layout) in wire.REPLIES.items()} == {0: 132, 3: 184, 4: 84, 6: 8}


def test_a_golden_status() -> None:
    data = wire.write_reply("status", 1, sequence=1, status=5, time_stamp=2000, joints=np.arange(9.0))
    assert data[:24] == bytes.fromhex("000000000000000100000001050000000000000000" + "0007d0")
    assert struct.unpack(">9f", data[60:96]) == tuple(range(9))


def test_a_golden_single_command() -> None:
    head = bytes.fromhex("00000001 00000001 00000009 01000000 00000100 00000000 00000000")
    packet = wire.read_request(head + struct.pack(">9f", *range(9)))
    assert (packet.name, packet["sequence"], packet["last_data"], packet["data_style"]) == ("command", 9, 1, 1)
    np.testing.assert_array_equal(packet.axes("position"), np.arange(9.0))


def test_a_golden_double_command() -> None:
    head = bytes.fromhex("00000005 00000002 0000000a 00000000 00000100 00000000 0000ffff 33333333")
    packet = wire.read_request(head + struct.pack(">9d", *range(9)))
    assert (packet.name, packet.version, packet["sequence"]) == ("command", 2, 10)
    np.testing.assert_array_equal(packet.axes("position"), np.arange(9.0))


def test_a_threshold_reply_is_twenty_stages_without_and_with_payload() -> None:
    data = wire.write_reply("thresholds", 3, **thresholds(LR_MATE_200ID, axis=1, kind=1))
    assert len(data) == 184
    assert struct.unpack(">6I", data[:24]) == (3, 3, 1, 1, 4000, 8)
    no_payload, full = struct.unpack(">20f", data[24:104]), struct.unpack(">20f", data[104:])
    assert (no_payload[-1], full[-1]) == (650, 500)
    np.testing.assert_allclose(full[-1] / full[0], 0.8)
    assert list(full) == sorted(full, reverse=True)


COMMAND = wire.write_request("command", 3, sequence=1, data_style=1)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"\0\0\0", "3 bytes"),
        (u32(7, 3), "packet type 7"),
        (u32(0, 0), "version 0"),
        (COMMAND[:-1], "103 bytes instead of 104"),
        (COMMAND[:12] + b"\2" + COMMAND[13:], "last_data is 2"),
        (COMMAND[:18] + b"\2" + COMMAND[19:], "data style 2"),
        (COMMAND[:32] + struct.pack(">d", float("nan")) + COMMAND[40:], "position"),
        (COMMAND[:32] + struct.pack("<d", 45.0001) + COMMAND[40:], "position"),  # wrong byte order
        (u32(5, 1) + COMMAND[8:], "double precision command in version 1"),
        (u32(3, 3, 10, 0), "axis 10"),
        (u32(3, 3, 1, 3), "kind 3"),
    ],
)
def test_what_is_no_packet_is_malformed(data: bytes, says: str) -> None:
    with pytest.raises(wire.Malformed, match=says):
        wire.read_request(data)


@pytest.mark.parametrize(
    ("table", "says"),
    [
        ({"start_mov": 1}, "unknown option 'start_mov'"),
        ({"start_move": 0}, "start_move must be above 0"),
        ({"start_move": 11}, "start_move must not be above capacity"),
        ({"lag_ms": -1}, "lag_ms must be a non-negative float"),
        ({"version": 4}, "version must be one of"),
        ({"start_deg": [0, 0]}, "start_deg must be six angles"),
        ({"program_loops": 1}, "program_loops must be a non-negative bool"),
        ({"brake_deg_s2": float("nan")}, "brake_deg_s2 must be"),
    ],
)
def test_wrong_settings_are_named(table: dict[str, object], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        Settings.parse(table)


def test_settings_of_a_cell() -> None:
    settings = Settings.parse({"lag_ms": 20, "start_deg": [1, 2, 3, 4, 5, 6]})
    assert settings.lag_ms == 20 and settings.start_deg == (1, 2, 3, 4, 5, 6)
