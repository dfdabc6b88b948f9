"""Spoiled packets by the thousand: a typed error, or something that the simulated robot's own codec accepts as well."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from drivers.base import ProtocolError
from drivers.fanuc_stream_motion import codec, codec_b
from drivers.fanuc_stream_motion.packets import Window
from sim_hil.fanuc import wire, wire_b
from sim_hil.fanuc.tables import LR_MATE_200ID

DEFAULT, MANY = 20_000, 1_000_000
COUNTS = [DEFAULT, pytest.param(MANY, marks=[pytest.mark.slow, pytest.mark.timeout(1800)])]
SPECIAL = [b"\x7f\xc0\0\0", b"\x7f\x80\0\0", b"\xff\xf8\0\0\0\0\0\0", b"\xff\xff", b"\xff", b"\0", b"\1", b"\2"]
POSE = np.radians([10.0, 20.0, -10.0, 40.0, -50.0, 60.0])

Random = np.random.Generator
Packets = Callable[[Random], bytes]


def pick(random: Random, options: list[Any]) -> Any:
    return options[int(random.integers(len(options)))]


def replies_a(random: Random) -> bytes:
    name = pick(random, ["status", "status", "version", "thresholds", "commanded"])
    values: dict[str, Any] = {"joints": random.uniform(-360, 360, 9)} if name in ("status", "commanded") else {}
    if name == "thresholds":
        values = {"axis": int(random.integers(0, 11)), "kind": int(random.integers(0, 4)), "max_speed": 4000}
        values |= {"no_payload": LR_MATE_200ID.no_payload[1, 0], "full_payload": LR_MATE_200ID.full_payload[1, 0]}
    return wire.write_reply(name, int(random.integers(0, 5)), **values)


def requests_a(random: Random) -> bytes:
    version, seq = int(random.integers(1, 4)), int(random.integers(2**32))
    name = pick(random, ["command", "command", "start", "stop", "version", "thresholds", "commanded"])
    if name == "command":
        window = pick(random, [None, Window("RI", 3, 4)])
        return codec.encode_command(version, seq, random.uniform(-6, 6, 6), bool(random.integers(2)), window)
    return wire.write_request(name, version)


def replies_b(random: Random) -> bytes:
    name = pick(random, ["status", "status", "status_force", "get_capability", "thresholds", "gpio"])
    values: dict[str, Any] = {}
    if name.startswith("status"):
        values = {"joints": random.uniform(-360, 360, 9), "contact_stop": int(random.integers(0, 6))}
    elif name == "get_capability":
        values = {"sampling_rate": 8, "available_version": int(random.integers(0, 5))}
    return wire_b.write_reply(name, int(random.integers(0, 6)), **values)


def requests_b(random: Random) -> bytes:
    version, seq = int(random.integers(3, 5)), int(random.integers(2**32))
    name = pick(random, ["command", "command", "start", "stop", "get_capability", "thresholds", "gpio", "force"])
    if name == "command":
        return codec_b.encode_command(version, seq, random.uniform(-6, 6, 6), bool(random.integers(2)))
    return wire_b.write_request(name, version)


def spoiled(data: bytes, random: Random) -> bytes:
    spoilt = bytearray(data)
    for _ in range(int(random.integers(0, 4))):
        at, patch = int(random.integers(len(spoilt))), pick(random, SPECIAL)
        spoilt[at : at + len(patch)] = patch
    cut = pick(random, [0, 0, 0, 0, 1, 4, 8, 64])
    return bytes(spoilt[: max(0, len(spoilt) - cut)]) + pick(random, [b"", b"", b"", b"\0", b"\0" * 8])


CODECS: dict[str, tuple[Packets, Callable[[bytes], object], Callable[[bytes], object]]] = {
    "classic, from the robot": (replies_a, lambda data: codec.decode(data, 3), wire.read_reply),
    "classic, to the robot": (requests_a, codec.decode_command, wire.read_request),
    "ROS 2, from the robot": (replies_b, lambda data: codec_b.decode(data, 3), wire_b.read_reply),
    "ROS 2, from the robot, version 4": (replies_b, lambda data: codec_b.decode(data, 4), wire_b.read_reply),
    "ROS 2, to the robot": (requests_b, codec_b.decode_command, wire_b.read_request),
}


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("name", CODECS)
def test_a_spoiled_packet_is_a_typed_error_or_good_for_both(name: str, count: int) -> None:
    packets, ours, theirs = CODECS[name]
    random = np.random.default_rng(1)
    accepted = 0
    for _ in range(count):
        data = spoiled(packets(random), random)
        try:
            ours(data)
        except ProtocolError:
            continue
        theirs(data)  # raises wire.Malformed: the two do not agree
        accepted += 1
    assert 0.02 * count < accepted < 0.98 * count  # both ways were tried


GOOD: dict[str, tuple[Callable[[bytes], object], list[bytes]]] = {
    "classic": (
        lambda data: codec.decode(data, 3),
        [
            wire.write_reply("status", 3, sequence=7, status=0x4D, joints=np.arange(9.0)),
            wire.write_reply("version", 3),
            wire.write_reply("commanded", 3, joints=np.arange(9.0)),
            wire.write_reply("thresholds", 3, axis=9, kind=2, max_speed=1),
        ],
    ),
    "ROS 2": (
        lambda data: codec_b.decode(data, 3),
        [
            wire_b.write_reply("status", 3, sequence=7, status=13, robot_status=7, contact_stop=4),
            wire_b.write_reply("get_capability", 3, sampling_rate=8, available_version=3),
            wire_b.write_reply("set_capability", 3, sampling_rate=2, start_move=9, available_version=4),
            wire_b.write_reply("thresholds", 3, axis=1, kind=0, max_speed=2000),
            wire_b.write_reply("gpio", 3, result=1),
        ],
    ),
    "ROS 2, version 4": (lambda data: codec_b.decode(data, 4), [wire_b.write_reply("status_force", 4, sequence=7)]),
}


@pytest.mark.parametrize("name", GOOD)
def test_what_the_robot_says_is_understood(name: str) -> None:
    ours, packets = GOOD[name]
    for data in packets:
        ours(data)


def test_what_the_driver_says_is_understood() -> None:
    for version in codec.VERSIONS:
        for data in (
            codec.encode_start(version),
            codec.encode_stop(version),
            codec.encode_version_request(version),
            codec.encode_threshold_request(version, 9, 2),
            codec.encode_commanded_request(version),
            codec.encode_command(version, 2**32 - 1, POSE, True, Window("RI", 3, 4)),
        ):
            wire.read_request(data)
    for version in codec_b.VERSIONS:
        for data in (
            codec_b.encode_start(version),
            codec_b.encode_stop(version),
            codec_b.encode_capability_request(version),
            codec_b.encode_threshold_request(version, 9, 2),
            codec_b.encode_gpio(version, Window("RI", 3, 4)),
            codec_b.encode_command(version, 2**32 - 1, POSE, True),
        ):
            wire_b.read_request(data)


# --- golden bytes of the ROS 2 wire, from the packet description -----------------------------------------------------


@pytest.mark.parametrize(
    ("data", "golden", "size"),
    [
        (codec_b.encode_start(3), "000000c8 00000003", 8),
        (codec_b.encode_stop(3), "00000002 00000003", 8),
        (codec_b.encode_capability_request(3), "00000007 00000003 00000001" + 4 * "00000000", 28),
        (codec_b.encode_command(3, 42, POSE, False), "000000c9 00000003 0000002a 0001ffff", 344),
        (codec_b.encode_command(3, 42, POSE, True), "000000c9 00000003 0000002a 0101ffff", 344),
        (codec_b.encode_gpio(3, Window("RI", 3, 4)), "000000cb 00000003 00000002 00000003 00000003 00000004", 520),
    ],
    ids=["start", "stop", "capability", "command", "last command", "signals"],
)
def test_golden_bytes(data: bytes, golden: str, size: int) -> None:
    head = bytes.fromhex(golden)
    assert data[: len(head)] == head and len(data) == size


def test_golden_capability_and_sizes() -> None:
    data = bytes.fromhex("00000007 00000003 00000001 00000008 00000000 00000003 00000000")
    assert codec_b.decode(data, 3) == codec_b.Capability(8, 0, 3)
    sizes = {name: layout.itemsize for name, layout in wire_b.REPLIES.values()}
    assert sizes == {
        "thresholds": 184, "get_capability": 28, "set_capability": 28, "status": 388, "gpio": 12, "status_force": 416,
    }  # fmt: skip


def test_the_ros_wire_carries_urdf_joints_unchanged() -> None:
    data = codec_b.encode_command(3, 1, POSE, False)
    np.testing.assert_allclose(np.frombuffer(data[16:64], ">f8"), [10, 20, -10, 40, -50, 60], atol=1e-12)
    status = wire_b.write_reply("status", 3, joints=[10, 20, -10, 40, -50, 60, 0, 0, 0])
    got = codec_b.decode(status, 3)
    np.testing.assert_allclose(np.degrees(got.q), [10, 20, -10, 40, -50, 60], atol=1e-5)  # type: ignore[union-attr]
