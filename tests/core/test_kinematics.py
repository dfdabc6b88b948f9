"""The compiled chain against Pinocchio."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from asc_rt.core.kinematics import forward
from asc_rt.core.robot_model import load

WORLD = pin.LOCAL_WORLD_ALIGNED


@pytest.fixture(params=["lrmate", "skew"], scope="module")
def model(request: Any, bench: Any) -> Any:
    if request.param == "lrmate":
        return bench.system().model
    params = bench.skew_arm()
    return load(params.robot, params.tool)


def states(n: int, count: int = 100) -> Any:
    rng = np.random.default_rng(n)
    for _ in range(count):
        yield rng.uniform(-3.0, 3.0, n), rng.uniform(-5.0, 5.0, n)


def test_placements_velocities_and_bias_accelerations_equal_pinocchio(model: Any) -> None:
    m, data = model.pin_model, model.pin_model.createData()
    for q, dq in states(m.nq):
        motion = forward(model.chain, q, dq)
        pin.forwardKinematics(m, data, q, dq, np.zeros(m.nv))
        for i in range(m.nq):
            joint = i + 1
            velocity = pin.getVelocity(m, data, joint, WORLD)
            bias = pin.getClassicalAcceleration(m, data, joint, WORLD)
            for ours, theirs in (
                (motion.rotation[i], data.oMi[joint].rotation),
                (motion.origin[i], data.oMi[joint].translation),
                (motion.omega[i], velocity.angular),
                (motion.velocity[i], velocity.linear),
                (motion.alpha[i], bias.angular),
                (motion.acceleration[i], bias.linear),
            ):
                np.testing.assert_allclose(ours, theirs, rtol=1e-10, atol=1e-10)


def test_point_jacobian_from_axes_and_origins_equals_pinocchio(model: Any) -> None:
    m, data = model.pin_model, model.pin_model.createData()
    local = np.array([0.3, -0.2, 0.1])
    for q, dq in states(m.nq, 30):
        motion = forward(model.chain, q, dq)
        pin.computeJointJacobians(m, data, q)
        for i in range(m.nq):
            point = motion.origin[i] + motion.rotation[i] @ local
            columns = [np.cross(motion.axis[j], point - motion.origin[j]) * (j <= i) for j in range(m.nq)]
            jacobian = pin.getJointJacobian(m, data, i + 1, WORLD)
            expected = jacobian[:3] - pin.skew(motion.rotation[i] @ local) @ jacobian[3:]
            np.testing.assert_allclose(np.array(columns).T, expected, rtol=1e-10, atol=1e-10)


def test_the_locked_joint_stays_in_the_chain(bench: Any) -> None:
    params = bench.skew_arm()
    model = load(params.robot, params.tool)
    full = pin.buildModelFromXML(params.robot.urdf)
    data, q = full.createData(), pin.neutral(full)
    q[[0, 1, 3, 4]] = [0.4, -1.0, 0.7, 2.0]
    pin.forwardKinematics(full, data, q)
    motion = forward(model.chain, q[[0, 1, 3, 4]], np.zeros(4))
    np.testing.assert_allclose(motion.origin[3], data.oMi[full.getJointId("d")].translation, atol=1e-12)
