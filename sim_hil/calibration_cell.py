"""A simulated cell to calibrate: an LR Mate carries a printed board before a camera, touches a point, wiggles, holds.

    python -m sim_hil.calibration_cell FOLDER

writes what a real cell would give (pictures, tables of what the robot says, traces on two clocks), and `truth.json` for
the judge. Every error that a result file states is really made: lens, print, robot poses, touches.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from asc_rt.config import load_arm
from asc_rt.core.params import RobotParams
from calibration import files, synthetic, vision
from calibration.geometry import exp, inverse, pose, quaternion_from_matrix
from calibration.hand_eye import SQUARE_SIGMA, RobotNoise
from calibration.payload import flange_poses
from sim_hil.board_camera import Lens, render

BOARD = vision.Board()
LENS_VIEWS, ARM_VIEWS, TOUCHES, HOLDS = 36, 24, 12, 12
DEPTH = np.array([0.4, 0.62])  # m from the camera to the board on the arm
JOGS = 5000  # poses found, of which the most turned are taken
REACHED = np.array([0.8, 1.5, 1.5, 2.5, 2.0, 2.5])  # rad: beyond, the board hardly ever faces the camera
OFFSET = 0.037  # s: t_robot = t_cam + OFFSET


@dataclass(frozen=True, slots=True)
class Cell:
    lens: Lens
    square: float  # m, true
    T_base_cam: np.ndarray
    T_flange_board: np.ndarray
    tip: np.ndarray  # (3,) m, flange frame
    load: np.ndarray  # (4,) kg, m

    def truth(self) -> dict[str, object]:
        lens = self.lens
        return {
            "intrinsics": [lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion],
            "T_base_cam": self.T_base_cam.tolist(),
            "T_flange_board": self.T_flange_board.tolist(),
            "tool": self.tip.tolist(),
            "payload": self.load.tolist(),
            "time-offset": OFFSET,
        }


def write(folder: Path, seed: int, lens: Lens | None = None) -> Cell:
    """All files of one cell in `folder`, which must not exist. `lens`: None draws one."""
    rng = np.random.default_rng([seed, 77])
    robot, _ = load_arm("lrmate_200id", "bare")
    noise = RobotNoise()
    folder.mkdir(parents=True)
    drawn = Lens(fx=560 + 5 * rng.normal(), fy=562 + 5 * rng.normal(), cx=325 + 4 * rng.normal())
    near = 1.0 if lens is None else lens.fx / Lens().fx  # a shorter lens stands nearer, for as many pixels a square
    lens = lens or drawn
    square = BOARD.square * (1 + SQUARE_SIGMA * rng.normal())
    Z = pose(
        exp(0.08 * rng.normal(size=3)) @ LOOKING, np.array([0.6 + 0.5 * near, 0.05, 0.55]) + 0.05 * rng.normal(size=3)
    )
    X = pose(exp(0.15 * rng.normal(size=3)), np.array([-0.13, -0.09, 0.06]) + 0.01 * rng.normal(size=3))
    K = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
    _photograph(folder / "lens", rng, lens, square, synthetic.filling(rng, LENS_VIEWS, BOARD, K, _size(lens)))
    flange = _in_view(rng, robot, Z, X, lens, near * DEPTH, ARM_VIEWS)
    names = _photograph(folder / "arm", rng, lens, square, inverse(Z) @ flange @ X)
    write_poses(folder / "poses.csv", synthetic.poses(rng, flange, noise), names)
    touches, tip = synthetic.touches(rng, TOUCHES, 0.8, 0.5e-3)
    write_poses(folder / "touches.csv", touches)
    q, tau, empty, load = synthetic.held(rng, robot, HOLDS)
    dof = q.shape[1]
    header = ",".join([*(f"q{i + 1}_rad" for i in range(dof)), *(f"tau{i + 1}_Nm" for i in range(dof))])
    files.write(folder / "loaded.csv", header, np.hstack([q, tau]))
    files.write(folder / "empty.csv", header, np.hstack([q, empty]))
    t_cam, p_cam, t_robot, p_robot = synthetic.motion(rng, 2e-3, OFFSET)
    files.write(folder / "robot.csv", "t_s,x_m,y_m,z_m", np.column_stack([t_robot, p_robot]))
    files.write(folder / "camera.csv", "t_s,x_m,y_m,z_m", np.column_stack([t_cam, p_cam]))
    cell = Cell(lens, square, Z, X, tip, load)
    (folder / "truth.json").write_text(json.dumps(cell.truth(), indent=1) + "\n")
    return cell


# columns: the camera's x right, y down, z forward, in base axes: it stands before the robot and looks back at it
LOOKING = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def _size(lens: Lens) -> tuple[int, int]:
    return lens.width, lens.height


def _in_view(
    rng: np.random.Generator, robot: RobotParams, Z: np.ndarray, X: np.ndarray, lens: Lens, depth: np.ndarray, n: int
) -> np.ndarray:
    """(n, 4, 4) flange poses of the arm that show the whole board, turned as far to every side as was found.

    The arm is jogged on from poses that show it: drawn anew each time, hardly any does.
    """
    low, high = np.maximum(robot.q_min, -REACHED), np.minimum(robot.q_max, REACHED)
    corners = BOARD.corners()
    shown = np.zeros((0, len(low)))
    while len(shown) < JOGS:
        drawn = rng.uniform(low, high, (1000, len(low)))
        if len(shown):
            drawn = rng.choice(shown, 1000) + 0.2 * rng.normal(size=drawn.shape)
        q = drawn[((low < drawn) & (drawn < high)).all(1)]
        B = inverse(Z) @ flange_poses(robot, q) @ X
        likely = (B[:, 2, 2] > 0.75) & (depth[0] < B[:, 2, 3]) & (B[:, 2, 3] < depth[1])
        q, B = q[likely], B[likely]
        p = corners @ np.swapaxes(B[:, :3, :3], 1, 2) + B[:, None, :3, 3]
        u, v = lens.fx * p[..., 0] / p[..., 2] + lens.cx, lens.fy * p[..., 1] / p[..., 2] + lens.cy
        whole = (np.minimum(u, v).min(1) > 15) & (u.max(1) < lens.width - 15) & (v.max(1) < lens.height - 15)
        shown = np.concatenate([shown, q[whole]])
    T = flange_poses(robot, shown)
    right, down = (inverse(Z) @ T @ X)[:, :2, 2].T  # of the board's normal
    a_side = n // 4
    sides = [np.argsort(tilt)[-4 * a_side :] for tilt in (right, -right, down, -down)]
    return T[rng.permutation(np.concatenate([rng.choice(side, a_side, replace=False) for side in sides]))]


def _photograph(folder: Path, rng: np.random.Generator, lens: Lens, square: float, T: np.ndarray) -> list[str]:
    folder.mkdir()
    rays, print_ = lens.rays(), BOARD.picture(60)
    names = [f"{i:02d}.png" for i in range(len(T))]
    for name, placed in zip(names, T, strict=True):
        vision.write(folder / name, render(lens, rays, placed, print_, square, BOARD.columns, rng))
    return names


def write_poses(path: Path, T: np.ndarray, names: list[str] | None = None) -> None:
    rows = np.hstack([T[:, :3, 3], quaternion_from_matrix(T[:, :3, :3])])
    header = "x_m,y_m,z_m,qx,qy,qz,qw"
    if names is None:
        files.write(path, header, rows)
    else:
        files.write(path, f"picture,{header}", ([name, *row] for name, row in zip(names, rows, strict=True)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    write(given.folder, given.seed)
    print(f"written to {given.folder}")


if __name__ == "__main__":
    main()
