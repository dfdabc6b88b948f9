"""Closed-form derivatives with respect to the joint speeds against central differences, kinks included."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from asc_rt.config import load_arm
from asc_rt.core import robot_model
from asc_rt.core.abstraction import People, separation
from asc_rt.core.dynamics import inertia_and_bias
from asc_rt.core.gradient import bias_gradient, drift_gradient, support_gradient
from asc_rt.core.kinematics import forward
from asc_rt.core.limits import acceleration_box
from asc_rt.core.polytope import greatest, support
from asc_rt.core.realizable import control_set


@pytest.fixture(params=[("panda", "ee2", "torque"), ("lrmate_200id", "drill", "acceleration")], ids=lambda arm: arm[0])
def model(request: Any) -> robot_model.RobotModel:
    robot, tool, control = request.param
    return robot_model.load(*load_arm(robot, tool), control)


def states(model: robot_model.RobotModel, count: int, seed: int) -> Iterator[tuple[Any, Any, Any, People]]:
    rng, b = np.random.default_rng(seed), model.arm.bounds
    for _ in range(count):
        q, dq = rng.uniform(b.q_min, b.q_max), rng.uniform(-b.dq_max, b.dq_max)
        p0 = rng.uniform([-0.7, -0.7, -0.2], [0.9, 0.7, 0.9], (3, 3))
        p1 = p0 + rng.normal(0.0, 0.3, (3, 3)) * np.array([[0.0], [1.0], [1.0]])  # a point and two capsules
        v0, v1 = rng.normal(0.0, 1.0, (2, 3, 3))
        v1[0] = v0[0]
        yield rng, q, dq, People(p0, p1, v0, v1, np.full(3, 0.05), np.zeros(3))


def central(f: Any, x: Any, h: float) -> Any:
    return np.array([(f(x + h * e) - f(x - h * e)) / (2.0 * h) for e in np.eye(len(x))])


def test_the_drift_gradient(model: robot_model.RobotModel) -> None:
    checked = 0
    for _, q, dq, people in states(model, 20, 0):
        args = (model.chain, model.capsules, people, q)
        found = separation(*args, dq, np.inf, 0.0)
        # quadratic in dq between the switches of the slip term: a step of any size is exact there
        slopes = np.array(
            [central(lambda v, a=args: separation(*a, v, np.inf, 0.0).drift, dq, h) for h in (1e-3, 2e-3)]
        )
        motion = forward(model.chain, q, dq)
        for i, (c, h) in enumerate(zip(found.robot, found.human, strict=True)):
            oracle, other = slopes[0, :, i], slopes[1, :, i]
            if not np.allclose(oracle, other, rtol=1e-6, atol=1e-6):
                continue
            joint = model.capsules.joint[c]
            ends = (
                p[c] @ motion.rotation[joint].T + motion.origin[joint] for p in (model.capsules.p0, model.capsules.p1)
            )
            mine = drift_gradient(motion, joint, *ends, people, h)
            np.testing.assert_allclose(mine, oracle, rtol=1e-6, atol=1e-6 * (1.0 + np.abs(oracle).max()))
            checked += 1
    assert checked > 300


def test_the_bias_gradient_is_exact(model: robot_model.RobotModel) -> None:
    for rng, q, dq, _ in states(model, 50, 1):
        y = rng.normal(size=len(q))

        def torque(v: Any, q: Any = q, y: Any = y) -> float:
            return float(y @ inertia_and_bias(forward(model.chain, q, v), model.arm.bodies)[1])

        mine = bias_gradient(forward(model.chain, q, dq), model.arm.bodies, y)
        np.testing.assert_allclose(mine, central(torque, dq, 1.0), rtol=1e-9, atol=1e-9)


def test_the_support_gradient_in_and_out_of_braking_zones(model: robot_model.RobotModel) -> None:
    """At fixed c; where the two one-sided differences disagree it is a kink, and the slope is between them."""
    smooth = kinks = braking = rows = 0
    arm = model.arm._replace(effort=0.5 * model.arm.effort)  # so that torque rows are active too
    b = arm.bounds
    for rng, q, dq, _ in states(model, 60, 2):
        # half of the joints close to where they have to brake
        room = np.where(rng.random(len(q)) < 0.5, rng.uniform(0.0, 2.0, len(q)), np.inf) * b.ddq_max**2 / b.dddq_max
        dq = np.where(np.isfinite(room), b.dq_max - room, 0.5 * dq)
        q = 0.5 * (b.q_min + b.q_max) + 0.1 * (q - 0.5 * (b.q_min + b.q_max))
        c = rng.normal(size=len(q))

        def value(v: Any, q: Any = q, c: Any = c) -> float:
            return greatest(c, control_set(arm, forward(model.chain, q, v), q, v))

        motion = forward(model.chain, q, dq)
        lower, upper = acceleration_box(b, q, dq)
        best = support(c, control_set(arm, motion, q, dq))
        if best.value == -np.inf:
            continue
        mine = support_gradient(arm, motion, lower, upper, best.y)
        h = 1e-6
        right = np.array([(value(dq + h * e) - best.value) / h for e in np.eye(len(q))])
        left = np.array([(best.value - value(dq - h * e)) / h for e in np.eye(len(q))])
        slack = 1e-4 * (1.0 + np.abs(left) + np.abs(right))
        assert np.all(mine >= np.minimum(left, right) - slack)
        assert np.all(mine <= np.maximum(left, right) + slack)
        smooth += np.count_nonzero(np.abs(left - right) < slack)
        kinks += np.count_nonzero(np.abs(left - right) >= slack)
        braking += np.count_nonzero((upper < b.ddq_max) & (c > 0.0))
        rows += np.count_nonzero(best.y[len(q) :])
    assert smooth > 200
    assert braking > 20
    assert rows > 20 or not len(model.arm.effort)


def test_at_a_kink_the_slope_is_one_of_its_sides(model: robot_model.RobotModel) -> None:
    """A joint that enters its braking zone right now: no slope before, -J / A times its share after."""
    b, n = model.arm.bounds, len(model.arm.bounds.q_min)
    q, dq, c = 0.5 * (b.q_min + b.q_max), np.zeros(n), np.zeros(n)
    fastest = min(b.dq_max[0], np.sqrt(2.0 * b.ddq_max[0] * (b.q_max[0] - q[0])))
    dq[0], c[0] = fastest - b.ddq_max[0] ** 2 / b.dddq_max[0], 1.0
    for offset, slope in ((-1e-6, 0.0), (1e-6, -b.dddq_max[0] / b.ddq_max[0])):
        speeds = dq + offset * np.eye(n)[0]
        lower, upper = acceleration_box(b, q, speeds)
        y = np.concatenate((c, np.zeros(len(model.arm.effort))))
        mine = support_gradient(model.arm, forward(model.chain, q, speeds), lower, upper, y)
        assert mine[0] == pytest.approx(slope)
