"""The plant against Pinocchio and against plain geometry: MuJoCo is the oracle of the cell, so it is checked here."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio
import pytest

from asc_rt.core.params import CapsuleSpec, Params
from asc_rt.core.types import MAX_CAPSULES
from sim_hil.person import Capsules, Person
from sim_hil.plant import ROTOR_INERTIA, MujocoPlant

MakeParams = Callable[[str], Params]
READY = np.radians([0, 20, 0, 0, -80, 0])


def ball(at: Any, radius: float = 0.05, velocity: Any = (0, 0, 0)) -> Capsules:
    point, v = np.array([at], float), np.array([velocity], float)
    return Capsules(("ball",), point, point.copy(), np.array([radius]), v, v)


def pinocchio_model(params: Params) -> Any:
    model = pinocchio.buildModelFromXML(params.robot.urdf)
    xx, xy, xz, yy, yz, zz = params.tool.inertia
    tool = pinocchio.Inertia(
        params.tool.mass, np.array(params.tool.com), np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    )
    frame = model.frames[model.getFrameId(params.robot.flange)]
    model.appendBodyToJoint(frame.parentJoint, tool, frame.placement)
    return model


def robot_capsules(params: Params, q: np.ndarray) -> list[tuple[CapsuleSpec, np.ndarray, np.ndarray]]:
    model = pinocchio_model(params)
    data = model.createData()
    pinocchio.framesForwardKinematics(model, data, q)
    placed = []
    for capsule in (*params.robot.capsules, *params.tool.capsules):
        link = data.oMf[model.getFrameId(capsule.link, pinocchio.FrameType.BODY)]
        placed.append((capsule, link.act(np.array(capsule.p0)), link.act(np.array(capsule.p1))))
    return placed


def segment_distance(a0: np.ndarray, a1: np.ndarray, b0: np.ndarray, b1: np.ndarray) -> float:
    """By alternating projection: slow and plain, converges because the distance is convex in both parameters."""
    a, b, t = a1 - a0, b1 - b0, 0.5
    for _ in range(400):
        s = np.clip((b0 + t * b - a0) @ a / max(a @ a, 1e-12), 0, 1)
        t = np.clip((a0 + s * a - b0) @ b / max(b @ b, 1e-12), 0, 1)
    return float(np.linalg.norm(a0 + s * a - b0 - t * b))


@pytest.mark.parametrize("tool", ["bare", "drill", "bat"])
def test_holding_torque_is_gravity(arm_params: MakeParams, tool: str) -> None:
    params = arm_params(tool)
    plant = MujocoPlant(params, READY)
    for _ in range(50):
        plant.step()
    model = pinocchio_model(params)
    gravity = pinocchio.computeGeneralizedGravity(model, model.createData(), READY)
    assert plant.torque == pytest.approx(gravity, abs=1e-3)
    assert plant.q == pytest.approx(READY, abs=1e-6)


def test_torque_in_motion_is_the_inverse_dynamics(arm_params: MakeParams) -> None:
    params = dataclasses.replace(arm_params("drill"), period_ns=1_000_000)  # one substep per step
    plant, model = MujocoPlant(params, READY), pinocchio_model(params)
    data = model.createData()
    for k in range(400):
        plant.set_target(READY + 0.4 * (1 - np.cos(2.5 * 0.001 * (k + 1))))
        q, dq = plant.q, plant.dq
        plant.step()
        ddq = (plant.dq - dq) / 0.001
        expected = pinocchio.rnea(model, data, q, dq, ddq) + ROTOR_INERTIA * model.effortLimit * ddq
        assert plant.torque == pytest.approx(expected, abs=1e-6)
    assert np.abs(plant.dq).min() > 0.5


@pytest.mark.parametrize("tool", ["bare", "drill", "bat"])
def test_the_servo_follows_closely(arm_params: MakeParams, tool: str) -> None:
    plant = MujocoPlant(arm_params(tool), READY)
    swing, pace = np.radians([60, 10, 20, 40, 30, 90]), np.array([1, 1.7, 2.1, 2.3, 2.9, 3.1])
    for k in range(250):
        target = READY + swing * (1 - np.cos(pace * 0.008 * (k + 1))) / 2
        plant.set_target(target)
        plant.step()
        assert plant.q == pytest.approx(target, abs=np.radians(0.3))


def test_the_torque_is_cut_at_the_efforts_of_the_urdf(arm_params: MakeParams) -> None:
    plant = MujocoPlant(arm_params("drill"), READY)
    plant.set_target(READY + 1.0)
    plant.step()
    assert (np.abs(plant.torque) <= np.array([500, 500, 200, 70, 40, 20]) + 1e-9).all()
    assert np.abs(plant.torque).max() > 39, "the jump asks for far more than the motors have"


@pytest.mark.parametrize("seed", range(8))
def test_distance_and_parts_agree_with_plain_geometry(arm_params: MakeParams, seed: int) -> None:
    params, rng = arm_params("drill"), np.random.default_rng(seed)
    q = rng.uniform(params.robot.q_min, params.robot.q_max)
    plant, person = MujocoPlant(params, q), Person(seed).at(rng.uniform(0, 20))
    plant.set_person(person)
    pairs = {
        (f"tool{i - len(params.robot.capsules)}" if capsule.link == "flange" else capsule.link, label): (
            segment_distance(a0, a1, b0, b1) - capsule.radius - radius
        )
        for i, (capsule, a0, a1) in enumerate(robot_capsules(params, q))
        for label, b0, b1, radius in zip(person.labels, person.p0, person.p1, person.radius, strict=True)
    }
    nearest = plant.distance()
    assert nearest.distance == pytest.approx(min(pairs.values()), abs=1e-4)
    assert pairs[nearest.robot_part, nearest.person_part] == pytest.approx(nearest.distance, abs=1e-4)


@pytest.mark.parametrize("way", [(0, 0, 0.4), (0, 0, -0.4), (1e-9, 0, -0.4), (0.4, 0, 0), (0, 0, 0)])
def test_capsules_point_every_way(arm_params: MakeParams, way: Any) -> None:
    params, a = arm_params("bare"), np.array([[0.9, 0.1, 0.5]])
    plant = MujocoPlant(params, READY)
    b = a + np.array(way)
    plant.set_person(Capsules(("limb",), a, b, np.array([0.05]), np.zeros((1, 3)), np.zeros((1, 3))))
    plant.step()
    expected = min(
        segment_distance(p0, p1, a[0], b[0]) - capsule.radius - 0.05
        for capsule, p0, p1 in robot_capsules(params, plant.q)
    )
    assert plant.distance().distance == pytest.approx(expected, abs=2e-4)


@pytest.mark.parametrize("at", [(0.75, 0.3, 0.5), (0.5, 0.02, 0.36)], ids=["apart", "inside each other"])
def test_approach_speed_is_the_robots_share_of_the_distance_rate(arm_params: MakeParams, at: Any) -> None:
    plant = MujocoPlant(arm_params("drill"), READY)
    person = ball(at, velocity=(9, 9, 9))  # the person's own speed must not count
    for k in range(20):
        plant.set_target(READY + np.array([0.6, 0.5, 0, 0, 0, 0]) * 0.008 * (k + 1))
        plant.step()
    plant.set_person(person)
    before = plant.distance()
    q, dq, h = plant.q, plant.dq, 1e-5
    moved = []
    for sign in (-1, 1):
        plant.reset(q + sign * h * dq)
        plant.set_person(person)
        moved.append(plant.distance().distance)
    assert (before.distance < 0) == (at[0] == 0.5)
    assert before.approach == pytest.approx(-(moved[1] - moved[0]) / (2 * h), abs=1e-3)
    assert abs(before.approach) > 0.05


def test_nobody_there(arm_params: MakeParams) -> None:
    plant = MujocoPlant(arm_params("bare"), READY)
    assert plant.distance().distance == float("inf")
    plant.set_person(ball((0.5, 0, 0.5)))
    assert plant.distance().distance < 1
    empty = np.zeros((0, 3))
    plant.set_person(Capsules((), empty, empty, np.zeros(0), empty, empty))
    plant.step()
    assert plant.distance().distance == float("inf")
    assert plant.contacts == ()


def test_contact_is_seen_and_pushes_neither_the_person_nor_the_arm(arm_params: MakeParams) -> None:
    params, sweep = arm_params("drill"), np.array([1.2, 0, 0, 0, 0, 0])
    plant = MujocoPlant(params, READY)
    _, a0, a1 = robot_capsules(params, READY + sweep / 2)[-2]  # the drill's body on its way
    touched, fastest, deepest = [], 0.0, 0.0
    for k in range(250):
        plant.set_person(ball((a0 + a1) / 2, 0.06))
        plant.set_target(READY + sweep * min(k / 150, 1.0))
        plant.step()
        nearest = plant.distance()
        touched.append(bool(plant.contacts))
        assert touched[-1] or nearest.distance >= 0, "what is inside is in contact"
        fastest, deepest = max(fastest, float(np.abs(plant.dq).max())), min(deepest, nearest.distance)
    assert not touched[0] and any(touched)
    assert deepest < 0
    assert fastest < 1.3, "nobody pushes the arm"
    assert plant.q == pytest.approx(READY + sweep, abs=0.01)


def test_contact_names_parts_and_depth_and_follows_a_capsule_that_grows(arm_params: MakeParams) -> None:
    plant = MujocoPlant(arm_params("drill"), READY)
    _, a0, a1 = robot_capsules(arm_params("drill"), READY)[-2]  # the drill's body
    beside = (a0 + a1) / 2 + np.array([0, 0.15, 0])
    plant.set_person(ball(beside, 0.05))
    plant.step()
    assert plant.contacts == ()
    plant.set_person(ball(beside, 0.13))
    plant.step()
    depth = {(contact.robot_part, contact.person_part): contact.depth for contact in plant.contacts}
    assert 0.001 < depth["tool0", "ball"] < 0.0201
    assert ("base", "ball") not in depth
    end = beside + np.array([0, 1.0, 0])
    long = Capsules(
        ("rod",), end[None], beside[None] - [0, 0.08, 0], np.array([0.05]), np.zeros((1, 3)), np.zeros((1, 3))
    )
    plant.set_person(long)
    plant.step()
    assert {contact.person_part for contact in plant.contacts} == {"rod"}, "a longer capsule is found too"
    plant.set_person(ball(beside + [0, 1, 0], 0.05))
    plant.step()
    assert plant.contacts == ()


@pytest.mark.parametrize("target", [[0, 0, float("nan"), 0, 0, 0], [0, 0, 0], [float("inf")] * 6])
def test_a_target_that_is_no_pose_is_refused(arm_params: MakeParams, target: list[float]) -> None:
    plant = MujocoPlant(arm_params("bare"), READY)
    with pytest.raises(ValueError, match="6 finite angles"):
        plant.set_target(target)
    plant.step()
    assert plant.q == pytest.approx(READY, abs=1e-6)


def test_too_many_capsules_are_refused(arm_params: MakeParams) -> None:
    m = MAX_CAPSULES + 1
    crowd = Capsules(("x",) * m, *(np.zeros((m, 3)),) * 2, np.full(m, 0.1), *(np.zeros((m, 3)),) * 2)
    with pytest.raises(ValueError, match="at most"):
        MujocoPlant(arm_params("bare")).set_person(crowd)


def test_a_joint_list_that_is_not_the_urdfs_is_refused(arm_params: MakeParams) -> None:
    params = arm_params("bare")
    robot = dataclasses.replace(params.robot, joints=("J1", "J2", "J3", "J4", "J6", "J5"))
    with pytest.raises(ValueError, match="joints"):
        MujocoPlant(dataclasses.replace(params, robot=robot))


def test_two_runs_are_equal_to_the_bit(arm_params: MakeParams) -> None:
    ends = []
    for _ in range(2):
        plant, person = MujocoPlant(arm_params("drill"), READY), Person(1)
        for k in range(100):
            plant.set_person(person.at(4 + 0.008 * k))
            plant.set_target(READY + 0.5 * np.sin(0.02 * k))
            plant.step()
        ends.append(plant.q.tobytes() + plant.dq.tobytes())
    assert ends[0] == ends[1]
