"""Calibration files of the cameras of a simulated cell, as a good calibration would have left them.

    python -m sim_hil mount CELL.toml

Each camera's pose is the true one of [sim.camera.NAME] with one error drawn from the covariance that the file states.
Such a file does not expire: nobody bumps into a simulated camera.
"""

from __future__ import annotations

import argparse
import tomllib
from pathlib import Path

import numpy as np

from calibration.geometry import inverse, perturb
from calibration.result import Result, pose_value, rows
from sim_hil.camera import true_pose

SIGMA = np.array([1e-3] * 3 + [5e-4] * 3)  # m, rad: what `asc calibrate hand-eye` reaches with 20 to 40 poses
FOR_EVER = "2099-12-31"


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m sim_hil mount")
    parser.add_argument("cell", type=Path, help="cell file with [sim.camera.NAME] and [perception.camera.NAME]")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args(argv)
    table = tomllib.loads(given.cell.read_text(encoding="utf-8"))
    for i, (name, camera) in enumerate(sorted(table["perception"]["camera"].items())):
        entry = table["sim"]["camera"][name]
        T = true_pose(entry)
        drawn = np.random.default_rng([given.seed, i]).normal(size=6) * SIGMA
        said = T @ inverse(perturb(T, drawn)) @ T
        path = given.cell.parent / camera["calibration"]
        path.parent.mkdir(parents=True, exist_ok=True)
        Result(
            kind="hand-eye",
            frame="T_base_cam",
            value=pose_value(said),
            covariance=rows(np.diag(SIGMA**2)),
            method="simulated: the true pose and one error drawn from this covariance",
            serials={"camera": entry["serial"]},
            valid_until=FOR_EVER,
        ).save(path)
        print(f"written {path}")
    return 0
