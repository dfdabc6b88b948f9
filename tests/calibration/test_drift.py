"""A camera that was moved is found by the robot in its depth picture. MuJoCo casts the rays: an independent oracle."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest
from typer.testing import CliRunner

from asc_rt.cli import app
from asc_rt.config import load_arm
from asc_rt.core import robot_model
from calibration import drift, files, vision
from calibration.geometry import exp, perturb, pose
from calibration.result import CalibrationError, Result, pose_value
from calibration.result import rows as rows_of
from sim_hil.calibration_cell import LOOKING

ROBOT = robot_model.load(*load_arm("lrmate_200id", "drill"))
K = np.array([[400.0, 0, 320], [0, 400, 240], [0, 0, 1]])
STRAIGHT = np.zeros(5)
T = pose(exp(np.array([0.05, -0.3, -0.1])) @ LOOKING, np.array([1.5, 0.1, 0.9]))
POSES = np.array([[0.0, 0.3, -0.2, 0.0, -0.8, 0.0], [0.5, 0.6, 0.1, 0.3, -1.0, 0.5], [-0.5, 0.0, 0.2, -0.4, -0.5, 0.0]])


def photographed(q: np.ndarray, T_base_cam: np.ndarray, rng: np.random.Generator, wall: bool = True) -> drift.Frame:
    scene = drift.place(ROBOT, q)
    spec = mujoco.MjSpec()
    for p0, p1, radius in zip(scene.p0, scene.p1, scene.radius, strict=True):
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[*p0, *(p1 + [0, 0, 1e-6])], size=[radius, 0, 0]
        )
    if wall:
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=[-1.5, 0, 0], size=[0.05, 3, 3])
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    depth = np.zeros((480, 640))
    v, u, flat = drift.grid(depth.shape, K, STRAIGHT)
    scale = np.linalg.norm(flat, axis=1)
    rays = (flat / scale[:, None]) @ T_base_cam[:3, :3].T
    found, hit = np.zeros(len(u)), np.zeros(len(u), np.int32)
    mujoco.mj_multiRay(
        model, data, T_base_cam[:3, 3].copy(), rays.ravel().copy(), None, 1, -1, hit, found, None, len(u), 10.0
    )
    depth[v, u] = np.where(hit >= 0, found / scale + 2e-3 * rng.normal(size=len(u)), 0.0)
    return drift.Frame(depth, q)


def frames(T_base_cam: np.ndarray, poses: np.ndarray = POSES) -> list[drift.Frame]:
    rng = np.random.default_rng(4)
    return [photographed(q, T_base_cam, rng) for q in poses]


def test_a_camera_that_stands_still_passes() -> None:
    found = drift.check(ROBOT, frames(T), K, STRAIGHT, T)
    assert not found.reasons
    assert found.shift < 2e-3
    assert found.outside < 0.01


MOVED = ([0.025, 0, 0, 0, 0, 0], [0, -0.03, 0, 0, 0, 0], [0, 0, 0.025, 0, 0, 0], [0, 0, 0, 0.005, 0.02, 0])


@pytest.mark.parametrize("xi", MOVED)
def test_a_camera_that_was_moved_is_found_and_how(xi: list[float]) -> None:
    truth = perturb(T, np.array(xi))
    found = drift.check(ROBOT, frames(truth), K, STRAIGHT, T)
    assert any("calibrate again" in reason for reason in found.reasons)
    np.testing.assert_allclose(found.xi, xi, atol=6e-3)


def test_less_than_half_the_margin_passes() -> None:
    found = drift.check(ROBOT, frames(perturb(T, np.array([0, 0, 0.008, 0, 0, 0.003]))), K, STRAIGHT, T)
    assert not found.reasons
    assert 0.006 < found.shift < 0.014


def test_a_robot_that_is_elsewhere_or_out_of_view_is_refused() -> None:
    elsewhere = [drift.Frame(frame.depth, frame.q + [0.9, 0, 0, 0, 0, 0]) for frame in frames(T)]
    assert "not where it is drawn" in drift.check(ROBOT, elsewhere, K, STRAIGHT, T).reasons[0]
    away = pose(T[:3, :3] @ exp(np.array([0, 2.0, 0])), T[:3, 3])
    with pytest.raises(CalibrationError, match="before the camera"):
        drift.check(ROBOT, frames(T), K, STRAIGHT, away)


def test_the_command_draws_and_judges(tmp_path: Path) -> None:
    seen = frames(perturb(T, np.array([0.03, 0, 0, 0, 0, 0])))
    (tmp_path / "depth").mkdir()
    for i, frame in enumerate(seen):
        full = np.repeat(np.repeat(frame.depth[2::4, 2::4], 4, 0), 4, 1)
        vision.write(tmp_path / "depth" / f"{i}.png", np.round(full * 1000).astype(np.uint16))
    rows = [[f"{i}.png", *frame.q] for i, frame in enumerate(seen)]
    files.write(tmp_path / "q.csv", "picture,q1_rad,q2_rad,q3_rad,q4_rad,q5_rad,q6_rad", rows)
    lens = (K[0, 0], K[1, 1], K[0, 2], K[1, 2], 0.0, 0.0, 0.0, 0.0, 0.0)
    Result("intrinsics", "cam", lens, rows_of(np.eye(9)), "test", mode="640x480").save(tmp_path / "lens.json")
    for name, pose_ in (("old", T), ("new", perturb(T, np.array([0.03, 0, 0, 0, 0, 0])))):
        value = pose_value(pose_)
        Result("hand-eye", "T_base_cam", value, rows_of(1e-6 * np.eye(6)), "test", mode="640x480").save(
            tmp_path / f"{name}.json"
        )

    def asc(eye: str, *more: str) -> tuple[int, str]:
        words = ["calibrate", "drift", tmp_path / "depth", "--joints", tmp_path / "q.csv", "--tool", "drill", *more]
        words += ["--intrinsics", tmp_path / "lens.json", "--hand-eye", tmp_path / eye, "-o", tmp_path / "d.png"]
        done = CliRunner().invoke(app, [*map(str, words), "--json"])
        return done.exit_code, done.output

    code, text = asc("old.json")
    shown = json.loads(text.splitlines()[-1])
    assert (code, shown["ok"]) == (1, False)
    assert shown["shift_mm"] == pytest.approx(30, abs=5)
    assert asc("new.json")[0] == 0
    assert (tmp_path / "d.png").stat().st_size > 10_000
    assert asc("lens.json")[0] == 2
    assert "is --unit-mm" in asc("new.json", "--unit-mm", "0.01")[1]
