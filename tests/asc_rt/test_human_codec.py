"""A human message is used whole or not at all."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asc_rt import human_state_pb2 as pb
from asc_rt.core.types import MAX_CAPSULES, Health, MessageFault, Visibility
from asc_rt.human_codec import HumanCodecError, clock_id, decode

CLOCK = "HOST_MONO:test"


def capsule(**changes: object) -> pb.Capsule:
    values: dict[str, object] = {
        "label": "torso", "p0": [1, 2, 3], "p1": [1, 2, 4], "radius": 0.2, "v0": [0.1, 0, 0], "v1": [0.2, 0, 0],
        "position_bound": 0.02, "velocity_bound": 0.3, "visibility": pb.PREDICTED,
    }  # fmt: skip
    return pb.Capsule(**(values | changes))  # type: ignore[arg-type]


def message(**changes: object) -> pb.HumanState:
    values: dict[str, object] = {
        "schema_version": 1, "sensor_id": 7, "session_uuid": "s", "seq": 5, "clock_id": CLOCK, "t_capture_ns": 123,
        "frame_id": "robot_base", "calibration_hash": bytes(range(32)), "health": pb.HEALTH_DEGRADED, "coverage": 0.9,
        "bodies": [pb.Body(id=1, capsules=[capsule()]), pb.Body(id=2, capsules=[capsule(radius=0.1)])],
    }  # fmt: skip
    return pb.HumanState(**(values | changes))  # type: ignore[arg-type]


def one(**changes: object) -> pb.HumanState:
    return message(bodies=[pb.Body(capsules=[capsule(**changes)])])


def test_everything_arrives() -> None:
    heard = decode(message().SerializeToString(), CLOCK)
    state = heard.state
    assert (heard.session, heard.sigma_ns) == ("s", 0)
    assert (state.t_capture_ns, state.seq, state.sensor_id) == (123, 5, 7)
    assert state.calibration_hash == 0x0001020304050607
    assert state.health is Health.DEGRADED and state.coverage == 0.9 and not state.empty_certified
    assert state.p0.tolist() == [[1, 2, 3]] * 2 and state.p1.tolist() == [[1, 2, 4]] * 2
    assert state.v0.tolist() == [[0.1, 0, 0]] * 2 and state.v1.tolist() == [[0.2, 0, 0]] * 2
    assert state.radius.tolist() == [0.2, 0.1]
    assert state.position_bound.tolist() == [0.02] * 2 and state.velocity_bound.tolist() == [0.3] * 2
    assert state.visibility.tolist() == [Visibility.PREDICTED] * 2
    assert not any(array.flags.writeable for array in (state.p0, state.radius, state.visibility))


def test_nobody_is_an_empty_state_of_the_right_shapes() -> None:
    state = decode(message(bodies=[], empty_certified=True).SerializeToString(), CLOCK).state
    assert state.p0.shape == state.v1.shape == (0, 3) and state.radius.shape == (0,)
    assert state.empty_certified


BAD: dict[str, Callable[[], pb.HumanState]] = {
    "schema version 2": lambda: message(schema_version=2),
    "clock": lambda: message(clock_id="HOST_MONO:other"),
    "frame": lambda: message(frame_id="camera"),
    "safety rated": lambda: message(safety_rated=True),
    "calibration hash": lambda: message(calibration_hash=b"short"),
    "unknown health": lambda: message(health=9),
    "sequence number": lambda: message(seq=0),
    "capture stamp -1": lambda: message(t_capture_ns=-1),
    "may be off": lambda: message(t_capture_sigma_ns=2**63),
    "coverage": lambda: message(coverage=1.1),
    "not finite": lambda: one(p0=[float("nan"), 0, 0]),
    "radius or bound is not finite": lambda: one(radius=float("inf")),
    "radius is not above 0": lambda: one(radius=0.0),
    "bound is below 0": lambda: one(velocity_bound=-0.1),
    "3 coordinates": lambda: one(v1=[0, 0]),
    "visibility": lambda: one(visibility=9),
    f"at most {MAX_CAPSULES}": lambda: message(bodies=[pb.Body(capsules=[capsule()] * (MAX_CAPSULES + 1))]),
}


@pytest.mark.parametrize("words", BAD)
def test_a_bad_message_says_what_is_bad(words: str) -> None:
    with pytest.raises(HumanCodecError, match=words):
        decode(BAD[words]().SerializeToString(), CLOCK)


FAULTS = {"schema version 2": MessageFault.SCHEMA, "clock": MessageFault.CLOCK, "safety rated": MessageFault.SENDER}


@pytest.mark.parametrize("words", BAD)
def test_what_the_decision_is_told_of_a_bad_message(words: str) -> None:
    with pytest.raises(HumanCodecError) as refused:
        decode(BAD[words]().SerializeToString(), CLOCK)
    assert refused.value.fault is FAULTS.get(words, MessageFault.UNREADABLE)


def test_a_stamp_that_may_be_off_grows_the_people_by_what_they_move_in_that_time() -> None:
    heard = decode(message(t_capture_sigma_ns=50_000_000).SerializeToString(), CLOCK)
    assert heard.sigma_ns == 50_000_000
    assert heard.state.position_bound == pytest.approx([0.02 + 0.05 * (0.2 + 0.3)] * 2)


@given(st.binary(max_size=200))
def test_foreign_bytes_are_a_typed_error(data: bytes) -> None:
    with pytest.raises(HumanCodecError):
        decode(data, CLOCK)


@given(st.data())
def test_a_damaged_message_is_an_error_or_a_usable_state(data: st.DataObject) -> None:
    good = bytearray(message().SerializeToString())
    for _ in range(data.draw(st.integers(1, 3))):
        good[data.draw(st.integers(0, len(good) - 1))] = data.draw(st.integers(0, 255))
    try:
        state = decode(bytes(good[: data.draw(st.integers(0, len(good)))]), CLOCK).state
    except HumanCodecError:
        return
    assert np.isfinite(state.p0).all() and (state.radius > 0).all() and (state.position_bound >= 0).all()


def test_our_own_clock_is_that_of_this_boot() -> None:
    assert clock_id().startswith("HOST_MONO:") and clock_id() == clock_id()
    decode(message(clock_id=clock_id()).SerializeToString(), clock_id())
