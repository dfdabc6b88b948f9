"""M_dot: of an arm with torque limits against linear programs a moment before and after, and at jumps of M by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from scipy.optimize import linprog

from asc_rt.config import load_arm
from asc_rt.core import robot_model
from asc_rt.core.abstraction import People, Separation, picked, separation
from asc_rt.core.dynamics import Inertias
from asc_rt.core.kinematics import Chain
from asc_rt.core.limits import Bounds, acceleration_box
from asc_rt.core.radius import DIFFERENCE_STEP, radii
from asc_rt.core.robot_model import Arm, Capsules, RobotModel

H = 1e-4  # s, of the oracle's differences


def M_at(t: float, model: RobotModel, arm: Arm, people: People, q: Any, dq: Any, pair: Separation) -> tuple[float, Any]:
    """(M, the same without torque limits) of one pair, `t` seconds on: inertia and bias by Pinocchio, the program by
    scipy; nan: none."""
    then = people._replace(p0=people.p0 + t * people.v0, p1=people.p1 + t * people.v1)
    there = separation(arm.chain, arm.capsules, then, q, dq, np.inf, 3.0)
    i = int(np.flatnonzero((there.robot == pair.robot[0]) & (there.human == pair.human[0]))[0])
    data = model.pin_model.createData()
    inertia = pin.crba(model.pin_model, data, q)
    inertia = np.triu(inertia) + np.triu(inertia, 1).T
    bias = pin.nonLinearEffects(model.pin_model, data, q, dq)
    rows, ends = np.vstack((inertia, -inertia)), np.concatenate((arm.effort - bias, arm.effort + bias))
    lower, upper = acceleration_box(arm.bounds, q, dq)
    best = linprog(-there.C[i], A_ub=rows, b_ub=ends, bounds=list(zip(lower, upper, strict=True)))
    free = there.drift[i] + np.maximum(there.C[i] * lower, there.C[i] * upper).sum()
    return float(there.drift[i] - best.fun) if best.status == 0 else np.nan, free


def test_M_dot_of_an_arm_whose_torque_limits_count() -> None:
    """Each pair on its own, so that it is its own torque limits that count, or none."""
    model = robot_model.load(*load_arm("panda", "ee2"), "torque")
    arm = model.arm._replace(effort=0.35 * model.arm.effort)
    rng, b = np.random.default_rng(0), arm.bounds
    middle, free, limited, v = 0.5 * (b.q_min + b.q_max), 0, 0, np.full((1, 3), 0.3)
    for _ in range(60):
        q, dq = middle + 0.3 * rng.uniform(b.q_min - middle, b.q_max - middle), rng.uniform(-0.3, 0.3, 7) * b.dq_max
        ddq, p0 = rng.uniform(-3.0, 3.0, 7), rng.uniform([-0.7, -0.7, 0.0], [0.7, 0.7, 0.9], (1, 3))
        people = People(p0, p0, v, v, np.full(1, 0.05), np.zeros(1))
        found = separation(arm.chain, arm.capsules, people, q, dq, np.inf, 3.0)
        pair = picked(found, rng.integers(len(found.d), size=1))
        (behind, _), (now, without), (ahead, _) = (
            M_at(t, model, arm, people, q + t * dq, dq + t * ddq, pair) for t in (-H, 0.0, H)
        )
        left, right = (now - behind) / H, (ahead - now) / H
        if not abs(right - left) < 0.1 + 0.02 * abs(left):  # a kink, or empty
            continue
        M, M_dot = radii(arm, people, q, dq, ddq, 3.0, pair)
        assert M[0] == pytest.approx(now, abs=1e-6)
        assert M_dot[0] == pytest.approx(0.5 * (left + right), rel=0.02, abs=0.1)
        free, limited = free + (now > without - 1e-9), limited + (now < without - 1e-3)
    assert free > 10 and limited > 20


STEP = DIFFERENCE_STEP / 2.0


@pytest.mark.parametrize(
    ("alongside", "jumps"),
    [
        ((-0.1, 0.1), "never"),
        ((-0.1, STEP), "up ahead"),
        ((-0.1, -STEP), "up behind"),
        ((STEP, 0.1), "down ahead"),
        ((-STEP, 0.1), "down behind"),
        ((-STEP, STEP), "on both sides"),
    ],
)
@pytest.mark.parametrize("ddq", [4.0, -4.0])
def test_a_jump_of_M_is_no_slope(alongside: tuple[float, float], jumps: str, ddq: float) -> None:
    """A point 0.5 m from a joint about z, near the joint's limit, and somebody who passes it 0.4 m away at 1 m/s: M is
    larger by (1 m/s)^2 / 0.4 m while nothing of them is alongside.

    `alongside`: seconds from and until when. M = 0.5 m upper, and near its limit a joint that begins to move has
    upper = (v_limit - dq) J / A, so that M_dot = -0.5 ddq J / A.
    """
    A, J, point, x = 8.0, 80.0, np.array([[0.5, 0.0, 0.0]]), np.array([[1.0, 0.0, 0.0]])
    room = A**3 / (8.0 * J * J)  # upper = A / 2
    bounds = Bounds(*(np.array([value]) for value in (-1.0, room, 2.0, A, J)))
    chain = Chain(np.eye(3)[None], np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]))
    capsules = Capsules(np.array([0]), point, point, np.array([0.05]))
    bodies = Inertias(np.zeros(1), np.zeros((1, 3)), np.zeros((1, 3, 3)))
    arm = Arm(chain, capsules, bodies, bounds, np.zeros(0))
    first, last = (point - [0.0, 0.4, 0.0] - time * x for time in alongside)
    people = People(first, last, x, x, np.array([0.05]), np.zeros(1))
    still = np.zeros(1)
    found = separation(chain, capsules, people, still, still, np.inf, 0.0)
    M, M_dot = radii(arm, people, still, still, np.array([ddq]), 0.0, found)
    beside = alongside[0] < 0.0 < alongside[1]
    assert M[0] == pytest.approx(0.5 * A / 2.0 + (0.0 if beside else 1.0 / 0.4))
    assert M_dot[0] == pytest.approx(0.0 if jumps == "on both sides" else -0.5 * ddq * J / A, rel=1e-3)
