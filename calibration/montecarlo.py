"""Is every method's error bar honest? `python -m calibration.montecarlo -n 100` prints the tables of the README.

Each row calibrates synthetic data with known truth n times. `ratio` is the root mean square of error / stated sigma
over all components: 1 is honest, 2 claims twice what it holds. Hand-eye stands beside the closed form (Shah, which is
OpenCV's CALIB_ROBOT_WORLD_HAND_EYE_SHAH) and beside OpenCV's own methods where the installed version has them (5.0.0
has none; `uv run --with opencv-python-headless==4.14.0.94 python -m calibration.montecarlo` puts one that has over it).
The second table asks whether the tests of acceptance let good data pass and find bad ones.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np

from asc_rt.config import load_arm
from calibration import hand_eye, intrinsics, payload, synthetic, time_offset, tool
from calibration.geometry import difference, inverse, perturb, pose
from calibration.touch import Touch
from calibration.vision import Board

PIXEL = np.diag([2e-4, 2e-4, 1e-3, 1.5e-3, 1.5e-3, 3e-4]) ** 2  # of a board 1.3 m away, corners to 0.15 px
Trial = Callable[[np.random.Generator], tuple[np.ndarray, np.ndarray]]  # errors (k,), stated sigmas (k,)


@dataclass(frozen=True, slots=True)
class Row:
    method: str
    condition: str
    bias: float  # length of the mean error of the leading components, `unit`
    spread: float  # root mean square length of the error about that mean
    ratio: float  # nan: it states no sigma
    unit: str


def row(method: str, condition: str, trial: Trial, n: int, lead: slice, scale: float, unit: str) -> Row:
    """n trials; bias and spread of the components `lead` times `scale`."""
    pairs = [trial(np.random.default_rng([seed, 9])) for seed in range(n)]
    errors, sigmas = (np.array(part) for part in zip(*pairs, strict=True))
    part = scale * errors[:, lead]
    spread = np.sqrt(np.mean(np.sum((part - part.mean(0)) ** 2, axis=1)))
    ratio = np.sqrt(np.mean((errors / sigmas) ** 2))
    return Row(method, condition, float(np.linalg.norm(part.mean(0))), float(spread), float(ratio), unit)


def hand_eye_rows(n: int) -> Iterator[Row]:
    noise = hand_eye.RobotNoise()

    def with_shared_errors(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        data, Z, _ = synthetic.views(rng, 20, 0.52, noise, PIXEL)
        data = synthetic.shared_errors(rng, data)
        found = hand_eye.solve(data, noise)
        return difference(found.T_base_cam, Z), np.sqrt(np.diag(found.covariance)[:6])

    condition = "20 poses, +-30 deg, lens and print wrong"
    yield row("hand-eye, ours", condition, with_shared_errors, n, slice(3), 1e3, "mm")
    for views, tilt in ((10, 0.52), (20, 0.52), (20, 0.14), (40, 0.52)):

        def ours(rng: np.random.Generator, views: int = views, tilt: float = tilt) -> tuple[np.ndarray, np.ndarray]:
            data, Z, _ = synthetic.views(rng, views, tilt, noise, PIXEL)
            found = hand_eye.solve(data, noise)
            return difference(found.T_base_cam, Z), np.sqrt(np.diag(found.covariance)[:6])

        condition = f"{views} poses, +-{np.degrees(tilt):.0f} deg"
        yield row("hand-eye, ours", condition, ours, n, slice(3), 1e3, "mm")
        for name, method in others().items():

            def theirs(
                rng: np.random.Generator, views: int = views, tilt: float = tilt, method: Method = method
            ) -> tuple[np.ndarray, np.ndarray]:
                data, Z, _ = synthetic.views(rng, views, tilt, noise, PIXEL)
                return difference(method(data), Z), np.full(6, np.nan)

            yield row(f"hand-eye, {name}", condition, theirs, n, slice(3), 1e3, "mm")


Method = Callable[[hand_eye.Views], np.ndarray]


def others() -> dict[str, Method]:
    """T_base_cam by the closed form, and by OpenCV where the wheel has its methods (5.0.0 has none of them)."""
    methods: dict[str, Method] = {"closed form": lambda views: hand_eye.start(views)[0]}
    if hasattr(cv2, "calibrateHandEye"):
        for name in ("TSAI", "PARK", "HORAUD", "ANDREFF", "DANIILIDIS"):
            methods[f"OpenCV {name}"] = partial(_opencv, getattr(cv2, f"CALIB_HAND_EYE_{name}"))
        for name in ("SHAH", "LI"):
            methods[f"OpenCV {name}"] = partial(_opencv_world, getattr(cv2, f"CALIB_ROBOT_WORLD_HAND_EYE_{name}"))
    return methods


def _opencv(method: int, views: hand_eye.Views) -> np.ndarray:
    """Camera beside the robot: the flange's poses are given inverted."""
    flange, board = inverse(views.flange), views.board
    R, t = getattr(cv2, "calibrateHandEye")(  # noqa: B009 - this version's stubs lack it
        list(flange[:, :3, :3]), list(flange[:, :3, 3]), list(board[:, :3, :3]), list(board[:, :3, 3]), method=method
    )
    return pose(np.asarray(R), np.asarray(t).reshape(3))


def _opencv_world(method: int, views: hand_eye.Views) -> np.ndarray:
    """T_cam_board T_board_flange = T_cam_base T_base_flange: the board is its world, our flange its base."""
    A, B = views.board, views.flange
    solve = getattr(cv2, "calibrateRobotWorldHandEye")  # noqa: B009 - this version's stubs lack it
    found = solve(list(A[:, :3, :3]), list(A[:, :3, 3]), list(B[:, :3, :3]), list(B[:, :3, 3]), method=method)
    return inverse(pose(np.asarray(found[2]), np.asarray(found[3]).reshape(3)))


def other_rows(n: int) -> Iterator[Row]:
    for count, tilt in ((4, 1.05), (8, 0.8), (12, 0.8)):

        def touch(rng: np.random.Generator, count: int = count, tilt: float = tilt) -> tuple[np.ndarray, np.ndarray]:
            flange, tip = synthetic.touches(rng, count, tilt, 0.5e-3)
            found = tool.calibrate(flange, 0.5e-3)
            return found.value - tip, found.sigma

        yield row("tool", f"{count} poses, +-{np.degrees(tilt):.0f} deg", touch, n, slice(3), 1e3, "mm")
    robot, _ = load_arm("lrmate_200id", "drill")
    for count in (6, 12, 24):

        def weigh(rng: np.random.Generator, count: int = count) -> tuple[np.ndarray, np.ndarray]:
            q, tau, empty, load = synthetic.held(rng, robot, count)
            found = payload.calibrate(robot, q, tau, empty)
            return found.value - load, found.sigma

        yield row("payload, mass", f"{count} poses", weigh, n, slice(0, 1), 1.0, "kg")
        yield row("payload, centre of mass", f"{count} poses", weigh, n, slice(1, 4), 1e3, "mm")
    for sigma in (1e-3, 5e-3):

        def shift(rng: np.random.Generator, sigma: float = sigma) -> tuple[np.ndarray, np.ndarray]:
            offset = rng.uniform(-0.1, 0.1)
            t_cam, p_cam, t_robot, p_robot = synthetic.motion(rng, sigma, offset)
            found = time_offset.calibrate(t_cam, p_cam, t_robot, p_robot)
            return np.array([found.value[0] - offset]), found.sigma

        yield row("time offset", f"20 s, {1e3 * sigma:g} mm", shift, n, slice(1), 1e3, "ms")
    for count in (20, 40):

        def lens(rng: np.random.Generator, count: int = count) -> tuple[np.ndarray, np.ndarray]:
            found, truth = photograph(rng, count)
            return found.value - truth, found.sigma

        yield row("intrinsics, focal length", f"{count} views, 0.15 px", lens, n, slice(2), 1.0, "px")


def photograph(rng: np.random.Generator, count: int, sigma: float = 0.15) -> tuple[intrinsics.Result, np.ndarray]:
    """Intrinsics from `count` synthetic views, and the truth (9,)."""
    size, board = (640, 480), Board()
    truth = np.array([560.0, 562.0, 325.0, 236.0, -0.12, 0.05, 5e-4, -4e-4, 0.0])
    K = np.array([[truth[0], 0, truth[2]], [0, truth[1], truth[3]], [0, 0, 1]])
    T = synthetic.filling(rng, count, board, K, size)
    seen = synthetic.detections(rng, T, board, K, truth[4:], size, sigma)
    return intrinsics.calibrate(intrinsics.Pictures(size, seen, [""] * len(seen), []), board), truth


def table(n: int) -> Iterator[Row]:
    yield from hand_eye_rows(n)
    yield from other_rows(n)


def acceptance(n: int) -> dict[str, float]:
    """What the tests of acceptance do with n good hand-eye sets of 24 views, and with as many bad ones."""
    noise, found = hand_eye.RobotNoise(), []
    for seed in range(n):
        rng = np.random.default_rng([seed, 11])
        data, Z, _ = synthetic.views(rng, 24, 0.52, noise, PIXEL)
        seen = rng.uniform(-0.3, 0.3, (5, 3)) + [0, 0, 1.3]
        tip = seen @ Z[:3, :3].T + Z[:3, 3] + 1e-3 / np.sqrt(3) * rng.normal(size=(5, 3))
        good, solution = hand_eye.calibrate(data, noise)
        error = 1e3 * float(np.linalg.norm(solution.T_base_cam[:3, 3] - Z[:3, 3]))
        touch = Touch(tip, seen, 1e-3 / np.sqrt(3))
        slipped = replace(data, flange=data.flange.copy())
        slipped.flange[12:, :3, 3] += [0, 0, 3e-3]
        found.append(
            {
                "chi2 / dof of good data, mean": solution.chi2_dof,
                "hold-out chi2 / dof of good data, mean": float(good.quality["holdout_chi2_dof"]),
                "good data refused": float(bool(good.reasons)),
                "jack-knife squared": float(good.quality["jack_knife_mm"]) ** 2,
                "error squared": error**2,
                "good data refused by the touch check": float(bool(_touched(touch, solution))),
                "camera 10 mm off refused by the touch check": float(bool(_touched(touch, _moved(solution)))),
                "robot 3 mm off in half of the views refused": float(
                    bool(hand_eye.calibrate(slipped, noise)[0].reasons)
                ),
            }
        )
    mean = {key: float(np.mean([trial[key] for trial in found])) for key in found[0]}
    mean["jack-knife sigma / true error, rms"] = float(
        np.sqrt(mean.pop("jack-knife squared") / mean.pop("error squared"))
    )
    return mean


def _touched(touch: Touch, solution: hand_eye.Solution) -> list[str]:
    return touch.compare(solution.T_base_cam, solution.covariance[:6, :6])[1]


def _moved(solution: hand_eye.Solution) -> hand_eye.Solution:
    return replace(solution, T_base_cam=perturb(solution.T_base_cam, np.array([0.01, 0, 0, 0, 0, 0])))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-n", type=int, default=200, help="trials of each row")
    n = parser.parse_args().n
    print(f"| method | condition | bias | spread | unit | true error / stated sigma |\n|{'---|' * 6}  n = {n}")
    for r in table(n):
        ratio = "states none" if np.isnan(r.ratio) else f"{r.ratio:.2f}"
        print(f"| {r.method} | {r.condition} | {r.bias:.3g} | {r.spread:.3g} | {r.unit} | {ratio} |", flush=True)
    print(f"\n| acceptance of hand-eye, n = {n} | |\n|---|---|")
    for name, value in acceptance(n).items():
        print(f"| {name} | {value:.3g} |")


if __name__ == "__main__":
    main()
