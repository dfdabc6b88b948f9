"""Data with known truth for every method: what the Monte Carlo table and the tests calibrate. Seeded by `rng`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from asc_rt.core.params import RobotParams
from calibration import payload, vision
from calibration.geometry import exp, inverse, perturb, pose
from calibration.hand_eye import RobotNoise, Views
from calibration.vision import Board, Detection

CAM_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # columns: x right, y down, z forward


def camera(rng: np.random.Generator) -> np.ndarray:
    """T_base_cam 1.5 m behind the workspace, looking along base x."""
    return perturb(pose(CAM_AXES, np.array([-0.9, 0.1, 0.5])), 0.1 * rng.normal(size=6))


def board_on_flange(rng: np.random.Generator) -> np.ndarray:
    return pose(exp(0.2 * rng.normal(size=3)), np.array([-0.12, -0.09, 0.05]) + 0.02 * rng.normal(size=3))


def facing(rng: np.random.Generator, n: int, tilt: float, depth: float = 1.3, width: float = 0.25) -> np.ndarray:
    """(n, 4, 4) T_cam_board of boards before the camera, turned by up to `tilt` rad about each axis."""
    t = np.array([-0.12, -0.09, depth]) + rng.uniform(-1, 1, (n, 3)) * np.array([1.4 * width, width, width])
    return pose(exp(rng.uniform(-tilt, tilt, (n, 3))), t)


def poses(rng: np.random.Generator, T: np.ndarray, noise: RobotNoise) -> np.ndarray:
    """What the robot says of true flange poses `T`: off by its error, in the flange's axes."""
    sigma = np.array([noise.translation] * 3 + [noise.rotation] * 3)
    xi = rng.normal(size=(len(T), 6)) * sigma
    return T @ perturb(np.tile(np.eye(4), (len(T), 1, 1)), xi)


def views(
    rng: np.random.Generator, n: int, tilt: float, noise: RobotNoise, pixel: np.ndarray
) -> tuple[Views, np.ndarray, np.ndarray]:
    """Views, and the true T_base_cam and T_flange_board; `pixel` (6, 6): covariance of a board pose in the camera."""
    Z, X = camera(rng), board_on_flange(rng)
    B = facing(rng, n, tilt)
    said = poses(rng, Z @ B @ inverse(X), noise)
    seen = perturb(B, rng.multivariate_normal(np.zeros(6), pixel, n))
    return Views(said, seen, np.tile(pixel, (n, 1, 1)), np.zeros((n, 6, 0))), Z, X


def shared_errors(rng: np.random.Generator, views: Views) -> Views:
    """The same views through a lens and off a print that are wrong by what is stated: 0.1 % in focal length, 0.05 %."""
    lens = np.zeros((len(views), 6, 2))
    lens[:, 2, 0] = 1e-3 * views.board[:, 2, 3]
    lens[:, :3, 1] = 5e-4 * views.board[:, :3, 3]
    return replace(views, board=perturb(views.board, lens @ rng.normal(size=2)), lens=lens)


def touches(rng: np.random.Generator, n: int, tilt: float, sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """(n, 4, 4) T_base_flange with the tip on one point to within `sigma`, and the true tip."""
    tip, point = rng.uniform(-0.2, 0.2, 3), np.array([0.5, 0.1, 0.2])
    R = exp(rng.uniform(-tilt, tilt, (n, 3)))
    return pose(R, point - R @ tip + sigma * rng.normal(size=(n, 3))), tip


def held(
    rng: np.random.Generator, robot: RobotParams, n: int, noise: float = 0.15, bias: float = 0.5
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """q, tau with the load, tau empty (same poses), and the true (m, x, y, z)."""
    load = np.array([rng.uniform(0.8, 2.0), *rng.uniform(-0.08, 0.08, 3)])
    q = rng.uniform(np.maximum(robot.q_min, -1.8), np.minimum(robot.q_max, 1.8), (n, len(robot.joints)))
    Y, bare = payload.regressor(robot, q)
    tau = bare + Y @ np.array([load[0], *(load[0] * load[1:])])
    drift = bias * rng.normal(size=q.shape[1])
    return q, tau + drift + noise * rng.normal(size=q.shape), bare + noise * rng.normal(size=q.shape), load


def motion(rng: np.random.Generator, sigma: float, offset: float, seconds: float = 20.0) -> tuple[np.ndarray, ...]:
    """t_cam, p_cam (30 Hz, noise `sigma` m), t_robot, p_robot (125 Hz): one smooth motion without a period."""
    w, phase = rng.uniform(0.5, 4.0, (5, 3)), rng.uniform(0, 6.28, (5, 3))

    def path(t: np.ndarray) -> np.ndarray:
        return np.asarray(np.sum(0.06 * np.sin(w * t[:, None, None] + phase), axis=1))

    t_robot, t_cam = np.arange(0, seconds, 0.008), np.arange(0.01, seconds, 1 / 30)
    T = camera(rng)
    seen = (path(t_cam + offset) - T[:3, 3]) @ T[:3, :3]
    return t_cam, seen + sigma * rng.normal(size=seen.shape), t_robot, path(t_robot)


def filling(rng: np.random.Generator, n: int, board: Board, K: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(n, 4, 4) T_cam_board of boards held near, tilted, in every part of the picture in turn."""
    boards = []
    for i in range(n):
        z, cell = rng.uniform(0.3, 0.5), divmod(i % 12, 4)
        share = (np.array([cell[1] / 4, cell[0] / 3]) + rng.uniform(0, [1 / 4, 1 / 3])) * 0.9 + 0.05
        u, v = share * size
        centre = z * np.array([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], 1.0])
        R = exp(rng.uniform(-0.55, 0.55, 3))
        middle = board.square / 2 * np.array([board.columns, board.rows, 0])
        boards.append(pose(R, centre - R @ middle))
    return np.array(boards)


def detections(
    rng: np.random.Generator, T: np.ndarray, board: Board, K: np.ndarray, distortion: np.ndarray,
    size: tuple[int, int], sigma: float,
) -> list[Detection]:  # fmt: skip
    """Corners that lie inside the picture, each off by `sigma` px."""
    found = []
    for placed in T:
        pixels = vision.project(board.corners(), placed, K, distortion)
        inside = np.all((pixels > 5) & (pixels < np.array(size) - 5), axis=1)
        ids = np.flatnonzero(inside)
        found.append(Detection(ids, pixels[ids] + sigma * rng.normal(size=(len(ids), 2)), len(ids)))
    return [d for d in found if len(d) >= 12]
