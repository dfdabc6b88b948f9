"""CiA 402 frames: golden bytes, the whole table of states, scales, and bytes of any kind."""

from __future__ import annotations

import math
import struct
from fractions import Fraction
from typing import cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.base import ProtocolError
from drivers.can import cia402
from drivers.can.arm import Brake, Emergency, Feedback, Power, Wish
from drivers.can.arms import ARMS
from drivers.can.cia402 import Control, Mode, Nmt, NodeState, PowerState, Scale, StatusFlag, Target
from drivers.can.cia402_arm import Cia402Arm
from drivers.can.frame import Frame
from drivers.can.stream import hold, look

SCALE = Scale(resolution=4096, gear=Fraction(101), rated_torque=12.0)
TURN = 4096 * 101


def test_golden_set_point() -> None:
    data = cia402.encode_target(SCALE, Target(Control.ENABLE_OPERATION, math.pi, -6.0))
    assert data.hex() == "0f00" + (TURN // 2).to_bytes(4, "little").hex() + "0cfe"


def test_golden_actual_values() -> None:
    told = cia402.decode_actual(SCALE, bytes.fromhex("3716" + "00800600" + "f401"))
    assert told.state is PowerState.OPERATION_ENABLED
    assert told.flags == StatusFlag.VOLTAGE | StatusFlag.FOLLOWS
    assert told.q == pytest.approx(0x68000 / TURN * 2 * math.pi) and told.tau == pytest.approx(6.0)


def test_the_maps_fill_the_frames() -> None:
    for entries in (cia402.RPDO1_MAP, cia402.TPDO1_MAP):
        assert sum(entry & 0xFF for entry in entries) == 64


@pytest.mark.parametrize(
    ("statusword", "state"),
    [
        (0x0000, PowerState.NOT_READY), (0x0250, PowerState.SWITCH_ON_DISABLED), (0x0231, PowerState.READY),
        (0x0233, PowerState.SWITCHED_ON), (0x1637, PowerState.OPERATION_ENABLED), (0x0017, PowerState.QUICK_STOP),
        (0x021F, PowerState.FAULT_REACTION), (0x0218, PowerState.FAULT), (0x0238, PowerState.FAULT),
    ],
)  # fmt: skip
def test_states(statusword: int, state: PowerState) -> None:
    assert PowerState.of(statusword) is state


def test_every_statusword_is_one_state_or_refused() -> None:
    for statusword in range(0x10000):
        states = [s for s in PowerState if statusword & s.value[0] == s.value[1]]
        assert len(states) <= 1
        if not states:
            with pytest.raises(ProtocolError):
                PowerState.of(statusword)


def test_the_way_up_and_down_and_no_way_out_of_a_fault() -> None:
    up = [PowerState.SWITCH_ON_DISABLED, PowerState.READY, PowerState.SWITCHED_ON, PowerState.OPERATION_ENABLED]
    assert [cia402.towards_enabled(s) for s in up] == [0x06, 0x07, 0x0F, 0x0F]
    assert [cia402.towards_disabled(s) for s in reversed(up)] == [0x06, 0x06, 0x00, None]
    for stuck in set(PowerState) - set(up):
        assert cia402.towards_enabled(stuck) is None
    assert all(not word & cia402.FAULT_RESET for word in Control)


@given(
    st.integers(1, 1 << 20),
    st.fractions(Fraction(1, 10), 160, max_denominator=50),
    st.sampled_from([-1, 1]),
    st.integers(-100000, 100000),
    st.floats(-3.1, 3.1),
    st.floats(-20, 20),
)
def test_what_is_sent_says_the_command_within_half_a_unit(
    resolution: int, gear: Fraction, sign: int, zero: int, q: float, tau: float
) -> None:
    scale = Scale(resolution, gear, 12.0, sign, zero)
    said = cia402.decode_target(scale, cia402.encode_target(scale, Target(Control.ENABLE_OPERATION, q, tau)))
    assert abs(said.q - q) <= 0.501 / abs(scale.counts_per_radian) and abs(said.tau - tau) <= 0.00601
    assert said.control == Control.ENABLE_OPERATION


@pytest.mark.parametrize("target", [(math.nan, 0.0), (0.0, math.inf), (1e6, 0.0), (0.0, 400.0)])
def test_what_does_not_fit_is_refused(target: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="finite|fit"):
        cia402.encode_target(SCALE, Target(0x0F, *target))


@given(st.binary(max_size=12))
def test_any_bytes_give_values_or_a_protocol_error(data: bytes) -> None:
    for decode in (
        lambda: cia402.decode_actual(SCALE, data),
        lambda: cia402.decode_target(SCALE, data),
        lambda: cia402.decode_heartbeat(data),
        lambda: cia402.decode_emergency(data),
    ):
        try:
            decode()
        except ProtocolError:
            continue


def test_brakes_are_told_and_asked_in_turn_one_frame_a_cycle() -> None:
    arm = cast(Cia402Arm, ARMS["panda"])
    most = sum(frame.length for frame in arm.budget())
    for wish, close in ((Wish.BRAKE, 1), (Wish.ENABLE, 0)):
        said = []
        for seq in range(14):
            frames = arm.encode(seq, hold([0.0] * 7, [0.0] * 7, wish), [None] * 7)
            said += [frame for frame in frames if 0x600 <= frame.id < 0x680]
            answered = 7 * 8 + 8  # TPDOs, and what the drive says to it
            assert sum(len(frame.data) for frame in frames) + answered <= most
        assert [frame.id for frame in said] == 2 * [0x601 + i for i in range(7)]
        assert {frame.data.hex() for frame in said[:7]} == {f"23fe6001{close:02x}000000"}
        assert {frame.data.hex() for frame in said[7:]} == {"40fd600000000000"}
    assert not [frame for frame in arm.encode(0, look(7), [None] * 7) if 0x600 <= frame.id < 0x680]


@pytest.mark.parametrize(
    ("state", "wish", "word"),
    [
        (PowerState.OPERATION_ENABLED, Wish.KEEP, 0x0F), (PowerState.OPERATION_ENABLED, Wish.BRAKE, 0x0F),
        (PowerState.OPERATION_ENABLED, Wish.ENABLE, 0x0F), (PowerState.OPERATION_ENABLED, Wish.DISABLE, 0x06),
        (PowerState.QUICK_STOP, Wish.KEEP, 0x02), (PowerState.QUICK_STOP, Wish.BRAKE, 0x02),
        (PowerState.SWITCHED_ON, Wish.KEEP, 0x00), (PowerState.FAULT, Wish.KEEP, 0x00),
        (PowerState.FAULT, Wish.ENABLE, 0x00), (PowerState.SWITCH_ON_DISABLED, Wish.ENABLE, 0x06),
    ],
)  # fmt: skip
def test_a_drive_that_has_stopped_by_itself_is_left_holding_and_none_is_led_out_of_a_fault(
    state: PowerState, wish: Wish, word: int
) -> None:
    arm = ARMS["panda"]
    told = Feedback(Power.ENABLED, 0.0, None, 0.0, None, False, "", raw=state.value[1])
    frames = arm.encode(1, hold([0.0] * 7, [0.0] * 7, wish), [told] * 7)
    assert {frame.data[0] for frame in frames if 0x200 <= frame.id < 0x400} == {word}


def test_an_emergency_message_that_tells_of_an_end_is_none() -> None:
    heard = {code: ARMS["panda"].decode(Frame(0x83, struct.pack("<HB5x", code, 0))) for code in (0, 0x0010, 0x0100)}
    assert heard == {0: (2, Emergency("")), 0x0010: (2, Emergency("")), 0x0100: (2, Emergency("EMCY 0100h"))}


@pytest.mark.parametrize(
    ("data", "closed"),
    [("43fd600000000100", True), ("43fd60000000feff", False), ("43fd600000000000", False), ("60fe600100000000", None),
     ("80fd600000000206", None), ("43fd600100000100", None), ("43fd6000000001", None), ("", None)],
)  # fmt: skip
def test_what_a_brake_tells(data: str, closed: bool | None) -> None:
    """Bit 16 of the digital inputs; a refusal, the answer to an order, or another object says nothing of it."""
    assert ARMS["panda"].decode(Frame(0x583, bytes.fromhex(data))) == (2, Brake(closed))


def test_what_just_fits_and_what_just_does_not() -> None:
    """One count a radian and a thousandth of a newton metre a unit: the figures are the wire's."""
    plain = Scale(resolution=1, gear=Fraction(1), rated_torque=1.0)
    for most, say in (
        ((1 << 31) - 1, lambda v: plain.counts(v * 2 * math.pi)),
        ((1 << 31) - 1, lambda v: plain.counts_per_second(v * 2 * math.pi)),
        ((1 << 15) - 1, lambda v: plain.per_mille(v * 1e-3)),
    ):
        assert say(most) == most and say(-most - 1) == -most - 1
        for beyond in (most + 1, -most - 2):
            with pytest.raises(ValueError, match="does not fit"):
                say(beyond)


def test_a_speed_in_counts_of_the_motor() -> None:
    scale = Scale(resolution=4096, gear=Fraction(101), rated_torque=12.0, sign=-1, zero=5000)
    assert scale.counts_per_second(2 * math.pi) == -TURN, "the zero is of positions only"


def test_node_control_and_its_news() -> None:
    assert cia402.encode_nmt(Nmt.START, 3) == b"\x01\x03"
    assert cia402.decode_heartbeat(b"\x05") is NodeState.OPERATIONAL
    assert cia402.decode_heartbeat(b"\x00") is NodeState.BOOT_UP
    told = cia402.decode_emergency(bytes.fromhex("3081110102030405"))
    assert (told.code, told.register, told.vendor) == (0x8130, 0x11, bytes([1, 2, 3, 4, 5]))
    assert [1 << mode - 1 for mode in Mode] == [0x80, 0x100, 0x200]
