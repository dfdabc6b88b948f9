"""The whole calibration of a simulated cell by the commands that a person types, judged against the truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from typer.testing import CliRunner

from asc_rt.cli import app
from calibration.geometry import skew
from calibration.result import Result, read
from sim_hil import calibration_cell

KINDS = ("intrinsics", "hand-eye", "tool", "payload", "time-offset")
POINTS = np.array([[0.0, 0.0, 0.6], [0.2, 0.15, 0.8], [-0.3, -0.2, 1.0], [0.0, 0.0, 1.6]])  # m, camera frame


@dataclass(frozen=True, slots=True)
class Judged:
    refused: dict[str, str]  # kind -> what was said
    sigmas: dict[str, float]  # error over stated sigma
    end_point_mm: float


def calibrate(folder: Path, cell: calibration_cell.Cell) -> Judged:
    board, serials = ["--square-m", "0.03"], ["--robot-serial", "R1"]
    lens: list[object] = ["--intrinsics", folder / "intrinsics.json"]
    words: dict[str, list[object]] = {
        "intrinsics": [folder / "lens", *board, "--camera", "S1"],
        "hand-eye": [folder / "arm", "--poses", folder / "poses.csv", *lens, *board, *serials],
        "tool": [folder / "touches.csv", *serials],
        "payload": [folder / "loaded.csv", "--empty", folder / "empty.csv"],
        "time-offset": [folder / "robot.csv", folder / "camera.csv", "--camera-serial", "S1"],
    }
    refused = {}
    for kind in KINDS:
        done = CliRunner().invoke(app, ["calibrate", kind, *map(str, words[kind]), "-o", f"{folder}/{kind}.json"])
        if done.exit_code:
            refused[kind] = done.output
    if refused:
        return Judged(refused, {}, float("nan"))
    return judge({kind: read(folder / f"{kind}.json") for kind in KINDS}, cell)


def judge(results: dict[str, Result], cell: calibration_cell.Cell) -> Judged:
    """The end point: where the tool's tip is when it is sent to a point that the camera saw."""
    eye, tool, offset = results["hand-eye"], results["tool"], results["time-offset"]
    slip = np.array(tool.value) - cell.tip
    tip_variance = float(np.trace(np.array(tool.covariance)))
    gaps, sigmas = [], {}
    for i, p in enumerate(POINTS):
        gap = float(np.linalg.norm((eye.pose() - cell.T_base_cam) @ [*p, 1]))
        C = point_covariance(eye, p)
        sigmas[f"camera, point {i}"] = gap / np.sqrt(np.trace(C))
        reached = float(np.linalg.norm((eye.pose() - cell.T_base_cam)[:3] @ [*p, 1] - slip))
        sigmas[f"end point {i}"] = reached / np.sqrt(np.trace(C) + tip_variance)
        gaps.append(reached)
    sigmas["tool"] = float(np.linalg.norm(slip) / np.sqrt(tip_variance))
    sigmas["focal length"] = float(
        np.max(
            np.abs(np.array(results["intrinsics"].value[:2]) - [cell.lens.fx, cell.lens.fy])
            / results["intrinsics"].sigma[:2]
        )
    )
    sigmas["mass"] = abs(results["payload"].value[0] - cell.load[0]) / results["payload"].sigma[0]
    sigmas["time offset"] = abs(offset.value[0] - calibration_cell.OFFSET) / offset.sigma[0]
    return Judged({}, {key: float(value) for key, value in sigmas.items()}, 1e3 * max(gaps))


def point_covariance(eye: Result, p: np.ndarray) -> np.ndarray:
    """(3, 3) of a point seen at `p` in the camera's frame, in the base frame."""
    J = np.hstack([np.eye(3), -skew(eye.pose()[:3, :3] @ p)])
    return np.asarray(J @ np.array(eye.covariance) @ J.T)
