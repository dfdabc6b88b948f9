from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_hil.fanuc.arm import LR_MATE_200ID, Servo, from_wire, to_wire

PERIOD = 0.008


@pytest.mark.parametrize(
    ("degrees", "want"),
    [  # computed from the published joint origins, independently of this code
        ([0, 0, 0, 0, -90, 0], [385, 0, 285, 180, 0, 0]),
        ([30, 20, -10, 40, -50, 60], [445.3873, 211.6582, 106.5416, 159.1520, 27.4119, 108.5336]),
        ([-45, 60, 35, -120, 75, -200], [416.9870, -511.6280, 11.3761, 123.1684, 0.2831, -42.7295]),
    ],
)
def test_the_face_plate_is_where_the_data_sheet_has_it(degrees: list[float], want: list[float]) -> None:
    np.testing.assert_allclose(LR_MATE_200ID.pose(np.radians(degrees)), [*want, 0, 0, 0], atol=1e-4)


def test_j3_of_the_wire_is_against_the_horizontal() -> None:
    np.testing.assert_allclose(to_wire(np.radians([30, 20, -10, 40, -50, 60])), [30, 20, -30, 40, -50, 60, 0, 0, 0])


@given(st.lists(st.floats(-360, 360), min_size=9, max_size=9))
def test_joints_come_back_from_the_wire(axes: list[float]) -> None:
    np.testing.assert_allclose(to_wire(from_wire(np.array(axes), 6))[:6], axes[:6], atol=1e-9)


def servo(filter_cycles: int = 3, lag_s: float = 0.012, brake: float = 20.0) -> Servo:
    return Servo(np.zeros(2), PERIOD, filter_cycles, lag_s, np.full(2, brake))


def test_filter_and_lag_delay_a_ramp_by_their_sum() -> None:
    arm = servo(filter_cycles=5, lag_s=0.040)
    for k in range(400):
        arm.follow(np.full(2, 0.001 * k))
    lag = PERIOD / (1 - np.exp(-PERIOD / 0.040)) - PERIOD
    np.testing.assert_allclose((0.001 * 399 - arm.q) * PERIOD / 0.001, 2 * PERIOD + lag, rtol=1e-6)


def test_the_last_set_point_is_reached() -> None:
    arm = servo()
    arm.follow(np.array([0.01, -0.02]))
    for _ in range(60):
        arm.hold()
    np.testing.assert_allclose(arm.q, [0.01, -0.02], atol=1e-9)


def test_braking_ends_at_rest_on_the_path_within_the_deceleration() -> None:
    arm = servo(brake=20.0)
    for k in range(100):
        arm.follow(np.array([0.008, -0.004]) * k)  # 1 and -0.5 rad/s
    start, speeds = arm.q, [arm.dq]
    for _ in range(20):
        arm.brake()
        speeds.append(arm.dq)
    assert np.max(np.abs(np.diff(speeds, axis=0))) <= 20.0 * PERIOD * (1 + 1e-6)
    np.testing.assert_array_equal(speeds[-1], 0)
    way = arm.q - start
    np.testing.assert_allclose(way[0] / way[1], -2.0, rtol=1e-6)
    np.testing.assert_allclose(way[0], 1.0**2 / (2 * 20.0), rtol=0.2)  # v2 / 2a, less the step of the cycle


def test_hold_finishes_a_brake_instead_of_jumping_to_rest() -> None:
    arm = servo(brake=5.0)
    for k in range(100):
        arm.follow(np.full(2, 0.008) * k)
    arm.brake()
    speed = arm.dq
    arm.hold()
    assert np.all(arm.dq > 0.9 * speed)
