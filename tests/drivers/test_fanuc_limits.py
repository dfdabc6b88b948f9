"""The limit tables by flange speed: the box for the core and the check before sending, against the robot's own."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import ruckig
from fanuc_rig import A, B, Rig
from hypothesis import given, settings
from hypothesis import strategies as st

from asc_rt.core.types import vector
from drivers.base import HandshakeError, JointLimits
from drivers.fanuc_stream_motion.arms import ARMS
from drivers.fanuc_stream_motion.limits import LimitCheck, Tables, joint_limits
from drivers.fanuc_stream_motion.packets import Thresholds
from sim_hil.fanuc import arm as robot
from sim_hil.fanuc import tables as robot_tables

T = 0.008
SEEDS = st.integers(0, 2**32 - 1)
TABLES = robot_tables.LR_MATE_200ID


def told(tables: robot_tables.Tables = TABLES, payload: float = 1.0) -> Tables:
    rows = [
        Thresholds(
            axis + 1,
            kind,
            tables.max_speed * 1e-3,
            vector(np.radians(tables.no_payload[kind, axis])),
            vector(np.radians(tables.full_payload[kind, axis])),
        )
        for kind in range(3)
        for axis in range(6)
    ]
    return Tables(rows, payload)


# --- where the flange is ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arm", "degrees", "place"),
    [  # published vectors
        ("lrmate_200id", [0, 0, 0, 0, -90, 0], [385, 0, 285]),
        ("lrmate_200id", [30, 20, -10, 40, -50, 60], [445.3873, 211.6582, 106.5416]),
        ("lrmate_200id", [-45, 60, 35, -120, 75, -200], [416.9870, -511.6280, 11.3761]),
        ("lrmate_200id_7l", [30, 20, -10, 40, -50, 60], [541.7191, 267.2754, 167.4078]),
        ("lrmate_200id_7l", [-45, 60, 35, -120, 75, -200], [538.8208, -633.4618, 30.4535]),
    ],
)
def test_the_flange_is_where_it_was_published(arm: str, degrees: list[float], place: list[float]) -> None:
    np.testing.assert_allclose(ARMS[arm].place(vector(np.radians(degrees))), np.array(place) * 1e-3, atol=1e-7)


@settings(max_examples=50, deadline=None)
@given(SEEDS)
def test_driver_and_simulated_robot_agree_on_the_flange(seed: int) -> None:
    q = np.random.default_rng(seed).uniform(-3, 3, 6)
    for name, arm in robot.ARMS.items():
        np.testing.assert_allclose(ARMS[name].place(vector(q)), arm.place(q), atol=1e-9)


@pytest.mark.parametrize("wire", [A, B])
def test_a_robot_that_is_another_arm_is_refused(wire: str) -> None:
    rig = Rig(wire, {"arm": "lrmate_200id_7l"})
    with pytest.raises(HandshakeError, match=r"mm from where a lrmate_200id_7l would have it") as caught:
        rig.begin()
    assert "driver.arm" in caught.value.hint


@pytest.mark.parametrize("wire", [A, B])
def test_a_robot_with_the_other_j3_is_refused(wire: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The most frequent mistake with these arms: the wire's J3 taken for the mechanical one, or the other way round."""
    if wire == A:
        monkeypatch.setattr("sim_hil.fanuc.controller.to_wire", lambda q: np.degrees([*q, 0, 0, 0]))
    else:
        monkeypatch.setattr("sim_hil.fanuc.controller_b.np.degrees", lambda q: robot.to_wire(np.array(q)).tolist()[:6])
    with pytest.raises(HandshakeError, match="mm from where"):
        Rig(wire).begin()


# --- tables ----------------------------------------------------------------------------------------------------------


@settings(max_examples=50, deadline=None)
@given(st.floats(0.0, 6.0), st.floats(0.0, 1.0))
def test_driver_and_simulated_robot_agree_on_the_limits_at_a_speed_and_payload(speed: float, payload: float) -> None:
    for tables in (robot_tables.LR_MATE_200ID, robot_tables.CRX_10IA_L):
        ours = np.degrees(told(tables, payload).at(speed))
        np.testing.assert_allclose(ours, tables.at(1e3 * speed, payload), rtol=1e-12)


def motion(box: JointLimits, seed: int, period: float) -> np.ndarray[Any, Any]:
    """Set-points (k, 6) of a time-optimal way inside the box, from rest to rest."""
    random = np.random.default_rng(seed)
    request = ruckig.InputParameter(6)
    request.current_position = random.uniform(-1, 1, 6).tolist()
    request.target_position = random.uniform(-1, 1, 6).tolist()
    request.max_velocity, request.max_acceleration, request.max_jerk = (
        limit.tolist() for limit in (box.dq_max, box.ddq_max, box.dddq_max)
    )
    way = ruckig.Trajectory(6)
    assert ruckig.Ruckig(6).calculate(request, way) == ruckig.Result.Working
    return np.array([way.at_time(t)[0] for t in np.arange(0.0, way.duration + 4 * period, period)])


@settings(max_examples=30, deadline=None)
@given(SEEDS, st.sampled_from([0.008, 0.004, 0.002]))
def test_whatever_the_box_allows_passes_the_robots_check_at_every_flange_speed_up_to_its_own(
    seed: int, period: float
) -> None:
    """The box is conservative: also where the robot would allow more because the flange is slow."""
    greatest = 4.0
    box = joint_limits(told(), greatest, 0.0, period)
    speed = 0.0

    def place(pendant: Any) -> Any:  # a flange as fast as the box covers, whatever the joints do
        nonlocal speed
        speed += 1e3 * greatest * period
        return np.array([speed, 0.0, 0.0])

    check = robot_tables.LimitCheck(TABLES, 1.0, period, place)
    for row in motion(box, seed, period):
        assert check.excess(np.degrees([row[0], row[1], row[2] - row[1], *row[3:]])) is None


def test_the_check_goes_by_the_speed_of_the_flange() -> None:
    """Turning J1 with the arm stretched moves the flange; a jerk of J4 that is good at rest is not good then."""
    for rate, good in ((0.0, True), (3.0, False)):
        check = LimitCheck(told(), ARMS["lrmate_200id"], T)
        q = np.radians([0.0, 90.0, 90.0, 0.0, -10.0, 0.0])
        for k in range(200):
            q[0] = rate * T * k * min(1.0, k / 100)  # rad/s
            check.sent(vector(q))
        q[0] = rate * T * 200
        q[3] += np.radians(4700.0) * T**3
        assert (check.breach(vector(q)) is None) is good


def test_beyond_the_last_stage_the_tables_fall_on() -> None:
    tables = told()
    last, beyond = tables.at(4.0), tables.at(4.4)
    np.testing.assert_allclose(beyond[1:], last[1:] * (1 - 2 * 0.25 / 19))
    np.testing.assert_allclose(tables.least_up_to(4.4), beyond)
    np.testing.assert_allclose(tables.least_up_to(0.1), tables.at(0.0))
