"""The driver's codec against hand-made bytes, against itself, and against the simulated controller's own codec."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asc_rt.core.types import Vector
from drivers.base import ProtocolError
from drivers.fanuc_stream_motion import codec, packets
from sim_hil.fanuc import wire

HALF_TURN_DOWN = np.radians([0.0, 0.0, 0.0, 0.0, -90.0, 0.0])
NAMES = {
    packets.Status: "status",
    packets.VersionReply: "version",
    packets.Thresholds: "thresholds",
    packets.Commanded: "commanded",
}
VERSIONS = st.sampled_from(codec.VERSIONS)
SEQUENCES = st.integers(0, 2**32 - 1)
AXES = st.lists(st.floats(-360, 360, width=32), min_size=9, max_size=9)
POSES = st.lists(st.floats(-360, 360), min_size=6, max_size=6).map(lambda degrees: np.radians(degrees))


def status(version: int = 3, **values: object) -> bytes:
    return wire.write_reply("status", version, **values)


# --- golden bytes: computed by hand from the packet description ------------------------------------------------------


@pytest.mark.parametrize(
    ("data", "golden"),
    [
        (codec.encode_start(1), "00000000 00000001"),
        (codec.encode_stop(1), "00000002 00000001"),
        (codec.encode_version_request(3), "00000006 00000003"),
        (
            codec.encode_command(1, 1, HALF_TURN_DOWN, last=False),
            "00000001 00000001 00000001 00000000 00000100 00000000 00000000"
            + 4 * "00000000"
            + "c2b40000"
            + 4 * "00000000",
        ),
        (
            codec.encode_command(3, 1, HALF_TURN_DOWN, last=False),
            "00000005 00000003 00000001 00000000 00000100 00000000 0000ffff 33333333"
            + 4 * "0000000000000000"
            + "c056800000000000"
            + 4 * "0000000000000000",
        ),
    ],
    ids=["start v1", "stop v1", "version request v3", "command v1", "command v3"],
)
def test_golden_bytes(data: bytes, golden: str) -> None:
    assert data == bytes.fromhex(golden)


def test_last_data_is_byte_12() -> None:
    for version in codec.VERSIONS:
        on, off = (codec.encode_command(version, 7, HALF_TURN_DOWN, last) for last in (True, False))
        assert [i for i in range(len(on)) if on[i] != off[i]] == [12]


def test_golden_status() -> None:
    head = bytes.fromhex("00000000 00000001 00000001 05000000 00000000 000007d0")
    angles = [10.0, 20.0, -30.0, 40.0, 50.0, 60.0, 0.0, 0.0, 0.0]
    got = codec.decode(head + struct.pack(">9f", *[0.0] * 9) + struct.pack(">9f", *angles) + bytes(36), version=1)
    assert isinstance(got, packets.Status)
    assert (got.seq, got.ready, got.servo_on, got.moving, got.t_ms) == (1, True, True, False, 2000)
    np.testing.assert_allclose(np.degrees(got.q), [10, 20, -10, 40, 50, 60], atol=1e-12)


# --- J3 --------------------------------------------------------------------------------------------------------------


def test_moving_only_j2_keeps_j3_on_the_wire_if_the_forearm_keeps_its_angle_to_the_ground() -> None:
    level = codec.joints_from_wire(np.array([0.0, 0.0, -30.0, 0, 0, 0, 0, 0, 0]))
    leaning = codec.joints_from_wire(np.array([0.0, 25.0, -30.0, 0, 0, 0, 0, 0, 0]))
    np.testing.assert_allclose(np.degrees(leaning - level), [0, 25, 25, 0, 0, 0], atol=1e-12)


@given(POSES)
def test_joints_come_back_from_the_wire(q: Vector) -> None:
    np.testing.assert_allclose(codec.joints_from_wire(codec.joints_to_wire(q)), q, atol=1e-12)


# --- round trips -----------------------------------------------------------------------------------------------------


@given(VERSIONS, SEQUENCES, POSES, st.booleans())
def test_a_command_reads_back_as_the_wire_rounds_it(version: int, seq: int, q: Vector, last: bool) -> None:
    data = codec.encode_command(version, seq, q, last)
    told = codec.decode_command(data)
    assert (told.seq, told.last) == (seq, last)
    np.testing.assert_allclose(told.q, q, atol=1e-6 if version == 1 else 1e-12)
    assert codec.encode_command(version, seq, told.q, last)[:28] == data[:28]


@given(VERSIONS, SEQUENCES, POSES, st.booleans())
def test_the_controller_reads_what_the_driver_means(version: int, seq: int, q: Vector, last: bool) -> None:
    packet = wire.read_request(codec.encode_command(version, seq, q, last))
    assert (packet.name, packet.version, packet["sequence"], packet["last_data"]) == ("command", version, seq, last)
    assert packet["data_style"] == 1
    degrees = np.degrees(q)
    degrees[2] -= degrees[1]
    np.testing.assert_allclose(packet.axes("position"), [*degrees, 0, 0, 0], atol=5e-5 if version == 1 else 1e-9)


@given(VERSIONS, SEQUENCES, st.integers(0, 255), st.integers(0, 2**32 - 1), AXES)
def test_the_driver_reads_what_the_controller_means(
    version: int, seq: int, bits: int, t_ms: int, axes: list[float]
) -> None:
    got = codec.decode(
        status(version, sequence=seq, status=bits, time_stamp=t_ms, joints=axes, current=axes[::-1]), version
    )
    assert isinstance(got, packets.Status)
    assert (got.seq, got.t_ms) == (seq, t_ms)
    assert (got.ready, got.servo_on, got.moving) == (bool(bits & 1), bool(bits & 4), bool(bits & 8))
    np.testing.assert_array_equal(got.current, axes[::-1][:6])
    degrees = np.array(axes[:6])
    degrees[2] += degrees[1]
    np.testing.assert_allclose(np.degrees(got.q), degrees, atol=1e-10)


@given(SEQUENCES, st.integers(-(2**31), 2**31 - 1))
def test_sequence_distance_is_the_signed_way_round_the_circle(seq: int, steps: int) -> None:
    assert packets.sequence_distance((seq + steps) % 2**32, seq) == steps


# --- bad bytes -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("version", codec.VERSIONS)
@pytest.mark.parametrize("q", [[np.nan] * 6, [np.inf] * 6, [0.0] * 5, [1e300] * 6, [1e5] * 6])
def test_a_set_point_that_is_no_pose_is_never_encoded(version: int, q: list[float]) -> None:
    with pytest.raises(ValueError, match="set-point"):
        codec.encode_command(version, 1, np.array(q), last=False)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "0 bytes"),
        (status()[:-1], "131 bytes"),
        (status() + b"\0", "133 bytes"),
        (status(2), "version 2"),
        (bytes.fromhex("000000ca") + status()[4:], "type 202"),
        (status(pose=[np.nan] * 9), "pose"),
        (status(joints=[0, 0, 0, np.inf, 0, 0, 0, 0, 0]), "joint angle"),
        (status(current=[0, 0, 0, 0, 0, np.nan, 0, 0, 0]), "motor current"),
        (status(joints=[1e30] * 9), "joint angle"),
        (wire.write_reply("version", 0), "without a version"),
    ],
)
def test_what_is_no_status_is_refused(data: bytes, says: str) -> None:
    with pytest.raises(ProtocolError, match=says):
        codec.decode(data, version=3)


def mutated(seed: st.SearchStrategy[bytes]) -> st.SearchStrategy[bytes]:
    """Packets with bytes overwritten, cut or added: close enough to the real ones to reach every check."""

    @st.composite
    def draw(draw: st.DrawFn) -> bytes:
        data = bytearray(draw(seed))
        for _ in range(draw(st.integers(0, 4))):
            if data:
                start = draw(st.integers(0, len(data) - 1))
                patch = draw(st.sampled_from([b"\x7f\xc0\0\0", b"\x7f\x80\0\0", b"\xff", b"\0", b"\x01", b"\x02"]))
                data[start : start + len(patch)] = patch
        cut = draw(st.sampled_from([0, 0, 0, 1, 4, 64]))
        return bytes(data[: len(data) - cut]) + draw(st.sampled_from([b"", b"", b"", b"\0", b"\0" * 8]))

    return draw()


REPLIES = st.builds(
    wire.write_reply, st.sampled_from(["status", "version", "thresholds", "commanded"]), st.integers(0, 4)
)
REQUESTS = st.builds(
    wire.write_request, st.sampled_from(["start", "stop", "command", "version", "thresholds"]), st.integers(0, 4)
) | st.builds(codec.encode_command, VERSIONS, SEQUENCES, POSES, st.booleans())


@given(st.binary(max_size=200) | mutated(REPLIES), VERSIONS)
def test_any_reply_is_a_typed_error_or_one_that_the_controllers_codec_accepts(data: bytes, version: int) -> None:
    try:
        got = codec.decode(data, version)
    except ProtocolError:
        return
    packet = wire.read_reply(data)
    assert packet.name == (NAMES[type(got)])
    if isinstance(got, packets.Status):
        assert np.isfinite(got.q).all() and got.seq == packet["sequence"]


@given(st.binary(max_size=200) | mutated(REQUESTS))
def test_any_command_is_a_typed_error_or_one_that_the_controllers_codec_accepts(data: bytes) -> None:
    try:
        told = codec.decode_command(data)
    except ProtocolError:
        return
    packet = wire.read_request(data)
    assert packet.name == "command" and packet["sequence"] == told.seq
