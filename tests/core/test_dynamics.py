"""Inertia and bias force against Pinocchio."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from asc_rt.config import load_arm
from asc_rt.core import robot_model
from asc_rt.core.dynamics import inertia_and_bias, inverse
from asc_rt.core.kinematics import forward

ARMS = [("panda", "ee2"), ("panda_6dof", "ee1"), ("lrmate_200id", "bat"), ("ur5e", "bare"), ("openarm", "bare")]


@pytest.fixture(params=ARMS, ids=lambda arm: "-".join(arm))
def model(request: Any) -> robot_model.RobotModel:
    return robot_model.load(*load_arm(*request.param))


def test_inertia_and_bias_are_pinocchios(model: robot_model.RobotModel) -> None:
    rng, data = np.random.default_rng(0), model.pin_model.createData()
    b = model.arm.bounds
    for _ in range(50):
        q, dq = rng.uniform(b.q_min, b.q_max), rng.uniform(-b.dq_max, b.dq_max)
        H, h = inertia_and_bias(forward(model.chain, q, dq), model.arm.bodies)
        oracle = pin.crba(model.pin_model, data, q)
        oracle = np.triu(oracle) + np.triu(oracle, 1).T
        np.testing.assert_allclose(H, oracle, atol=1e-10)
        np.testing.assert_allclose(h, pin.nonLinearEffects(model.pin_model, data, q, dq), rtol=1e-10, atol=1e-10)


def test_the_inverse_is_one(model: robot_model.RobotModel) -> None:
    rng = np.random.default_rng(1)
    n = model.pin_model.nq
    for _ in range(20):
        q = rng.uniform(model.arm.bounds.q_min, model.arm.bounds.q_max)
        H, _ = inertia_and_bias(forward(model.chain, q, np.zeros(n)), model.arm.bodies)
        np.testing.assert_allclose(inverse(H) @ H, np.eye(n), atol=1e-9)
