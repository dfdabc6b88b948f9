"""MIT-mode frames: golden bytes from the manual's layout, every code, and what must never leave."""

from __future__ import annotations

import math
import struct
from typing import cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asc_rt.core.types import CommandKind
from drivers.base import ProtocolError
from drivers.can import mit
from drivers.can.arm import Target
from drivers.can.arms import ARMS
from drivers.can.mit import MOTORS, DriveStatus, MotorType, Register, SetPoint, Special
from drivers.can.mit_arm import MitArm

M4310 = MOTORS["DM4310"]
motors = st.sampled_from(sorted(MOTORS)).map(MOTORS.__getitem__)


@pytest.mark.parametrize(
    ("point", "hexadecimal"),
    [
        (SetPoint(-12.5, -30.0, 0.0, 0.0, -10.0), "0000000000000000"),
        (SetPoint(0.0, 0.0, 0.0, 0.0, 0.0), "8000800000000800"),
        (SetPoint(12.4996, 30.0, 500.0, 5.0, 10.0), "fffeffffffffffff"),
        (SetPoint(1.0, -1.0, 40.0, 1.5, 2.5), "8a3d7bb1484cc9ff"),
    ],
)
def test_golden_commands(point: SetPoint, hexadecimal: str) -> None:
    assert mit.encode(M4310, point).hex() == hexadecimal


def test_golden_answer() -> None:
    told = mit.decode_answer(M4310, 0x05, bytes.fromhex("158a3d7bb9ff2a1f"))
    assert told.status is DriveStatus.ENABLED and (told.power_stage_c, told.coil_c) == (42, 31)
    assert told.q == pytest.approx(1.0, abs=2e-4)
    assert told.dq == pytest.approx(-1.0, abs=8e-3)
    assert told.tau == pytest.approx(2.5, abs=3e-3)


@given(motors, *[st.floats(-1, 1)] * 3, st.floats(0, 1), st.floats(0.01, 1))
def test_what_is_sent_says_the_command_within_half_a_code(
    motor: MotorType, q: float, dq: float, tau: float, kp: float, kd: float
) -> None:
    point = SetPoint(0.999 * q * motor.position, dq * motor.velocity, kp * 500, kd * 5, tau * motor.torque)
    said = mit.decode(motor, mit.encode(motor, point))
    for name, span, bits in (
        ("q", 2 * motor.position, 16), ("dq", 2 * motor.velocity, 12), ("tau", 2 * motor.torque, 12),
        ("kp", 500, 12), ("kd", 5, 12),
    ):  # fmt: skip
        assert abs(getattr(said, name) - getattr(point, name)) <= 0.5001 * span / (2**bits - 1), name


@given(motors, st.floats(-13, 13), *[st.floats(-60, 60)] * 2, st.floats(0, 510), st.floats(0, 6))
def test_no_set_point_is_ever_a_special_frame(
    motor: MotorType, q: float, dq: float, tau: float, kp: float, kd: float
) -> None:
    try:
        data = mit.encode(motor, SetPoint(q, dq, kp, kd, tau))
    except ValueError:
        return
    assert data[:2] != b"\xff\xff" and data not in {mit.special(kind) for kind in Special}


@pytest.mark.parametrize("tau", [9.98, 9.985, 9.99, 9.995, 10.0])
def test_the_saturated_command_that_would_set_zero_is_refused(tau: float) -> None:
    with pytest.raises(ValueError, match="set zero"):
        mit.encode(M4310, SetPoint(12.5, 30.0, 500.0, 5.0, tau))


@pytest.mark.parametrize("name", ["q", "dq", "kp", "kd", "tau"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 501.0, -13.0 * 5])
def test_what_does_not_fit_is_refused_and_not_clipped(name: str, value: float) -> None:
    point = {"q": 0.0, "dq": 0.0, "kp": 1.0, "kd": 1.0, "tau": 0.0, name: value}
    with pytest.raises(ValueError, match="finite number within"):
        mit.encode(M4310, SetPoint(**point))


def test_stiffness_without_damping_is_refused() -> None:
    with pytest.raises(ValueError, match="oscillates"):
        mit.encode(M4310, SetPoint(0.0, 0.0, 1.0, 0.0, 0.0))


def test_special_frames() -> None:
    assert [mit.special(kind).hex() for kind in Special] == [f"{'ff' * 7}{last}" for last in ("fb", "fc", "fd", "fe")]
    for kind in Special:
        with pytest.raises(ProtocolError):
            mit.decode(M4310, mit.special(kind))


def test_the_codes_beside_zero_velocity_are_standstill() -> None:
    answers = [bytes([0x11, 0x80, 0x00, v >> 4, (v & 0xF) << 4 | 8, 0, 30, 30]) for v in (0x7FE, 0x7FF, 0x800, 0x801)]
    speeds = [mit.decode_answer(M4310, 1, data).dq for data in answers]
    assert speeds[1:3] == [0.0, 0.0] and speeds[0] < 0 < speeds[3]


@pytest.mark.parametrize(
    "data", [b"", b"\x11" * 7, b"\x12" + b"\x80" * 7, b"\x71" + b"\x80" * 7, bytes.fromhex("ff" * 7 + "fc")]
)
def test_answers_that_are_none(data: bytes) -> None:
    """Too short, another axis, an unknown status, our own enable frame heard again."""
    with pytest.raises(ProtocolError):
        mit.decode_answer(M4310, 1, data)


@given(st.binary(max_size=64))
def test_any_bytes_give_an_answer_or_a_protocol_error(data: bytes) -> None:
    for motor in MOTORS.values():
        for decode in (lambda: mit.decode_answer(motor, 3, data), lambda: mit.decode(motor, data)):  # noqa: B023
            try:
                told = decode()
            except ProtocolError:
                continue
            assert math.isfinite(told.q) and abs(told.dq) <= motor.velocity + 1e-9
    mit.decode_register(3, data)


@pytest.mark.parametrize("status", [s for s in DriveStatus if s not in (DriveStatus.DISABLED, DriveStatus.ENABLED)])
def test_every_trip_is_a_fault(status: DriveStatus) -> None:
    assert status.is_fault


@pytest.mark.parametrize("axis", range(7))
@pytest.mark.parametrize(("dq", "share"), [(0.0, 0.123), (0.3, -0.4567), (-0.8, 0.00321)])
def test_a_torque_finer_than_its_code_is_right_on_the_mean(axis: int, dq: float, share: float) -> None:
    """What a drive makes of the frames at the speed that was expected: tau + kd (v - dq)."""
    arm = cast(MitArm, ARMS["openarm"])
    motor = arm.axes[axis].type
    tau = share * motor.torque
    targets = [Target(CommandKind.TORQUE, 0.5, dq, tau if i == axis else 0.0) for i in range(7)]
    made = []
    for seq in range(400):
        point = mit.decode(motor, arm.encode(seq, targets, [None] * 7)[axis].data)
        made.append(point.tau + point.kd * (point.dq - dq))
    assert point.kp == 0.0 and np.mean(made) == pytest.approx(tau, abs=motor.torque * 2e-5)
    assert np.ptp(made) < 2.0 * motor.torque / 4095 / 5, "and far within a step of the torque's code"


def test_registers() -> None:
    assert mit.read_register(0x05, Register.POSITION_SPAN).hex() == "05003315" + "00000000"
    assert mit.write_register(0x05, Register.TIMEOUT, 1000).hex() == "05005509" + "e8030000"
    assert mit.write_register(0x05, Register.VELOCITY_SPAN, 10.5).hex() == "05005516" + struct.pack("<f", 10.5).hex()
    answer = struct.pack("<HBBf", 5, 0x33, 21, 12.5)
    assert mit.decode_register(5, answer) == (Register.POSITION_SPAN, 12.5)
    assert mit.decode_register(6, answer) is None
    assert mit.decode_register(5, struct.pack("<HBBI", 5, 0x33, 15, 0xFFFFFFF1)) == (Register.SERIAL, 0xFFFFFFF1)
    assert mit.decode_register(5, struct.pack("<HBBI", 5, 0x33, 200, 1)) is None
