"""What each `asc calibrate` command does between its files: read, call the pure method, label the result, draw it."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from datetime import date, timedelta
from pathlib import Path

import numpy as np

from asc_rt.core import robot_model
from calibration import drift as drift_method
from calibration import files, report, sightings, vision
from calibration import hand_eye as hand_eye_method
from calibration import intrinsics as intrinsics_method
from calibration import payload as payload_method
from calibration import time_offset as time_offset_method
from calibration import tool as tool_method
from calibration.geometry import inverse
from calibration.hand_eye import RobotNoise
from calibration.result import CalibrationError, Result, file_hash, load
from calibration.touch import Touch

SQUARES_M = (0.002, 0.3)  # what a board's squares may measure; beyond are other units
MOST_DAYS = 365
OVERLAYS = 2


@dataclass(frozen=True, slots=True)
class Label:
    """What the numbers belong to, and for how long."""

    camera: str
    robot: str
    operator: str
    days: int

    def put(self, result: Result, inputs: Iterable[Path], **more: str) -> Result:
        if not 1 <= self.days <= MOST_DAYS:
            raise CalibrationError([f"--days: {self.days} is not possible; 1 to {MOST_DAYS}"])
        serials = {"camera": self.camera, "robot": self.robot}
        return replace(
            result,
            serials=result.serials | {device: serial for device, serial in serials.items() if serial},
            inputs={path.name: file_hash(path) for path in inputs} | more,
            operator=self.operator,
            valid_until=(date.today() + timedelta(days=self.days)).isoformat(),
        )


def board(size: str, square: float) -> vision.Board:
    match = re.fullmatch(r"(\d{1,2})x(\d{1,2})", size)
    faults = []
    if match is None or min(int(match[1]), int(match[2])) < 3:
        faults.append(f"--board: {size!r} is no board; columns x rows of squares, at least 3 each, for example 9x6")
    if not SQUARES_M[0] <= square <= SQUARES_M[1]:
        faults.append(
            f"--square-m: {square:g} m is no square of a board; {SQUARES_M[0]:g} to {SQUARES_M[1]:g} m, not millimetres"
        )
    if faults or match is None:
        raise CalibrationError(faults)
    return vision.Board(int(match[1]), int(match[2]), square)


def robot_noise(millimetres: float, degrees: float) -> RobotNoise:
    if not (0.01 <= millimetres <= 10 and 0.001 <= degrees <= 2):
        raise CalibrationError(
            [f"--robot-mm, --robot-deg: {millimetres:g} mm, {degrees:g} deg are no robot's; 0.01 to 10, 0.001 to 2"]
        )
    return RobotNoise(millimetres * 1e-3, float(np.radians(degrees)))


def intrinsics(folder: Path, board: vision.Board, label: Label, picture: Path) -> Result:
    images = files.pictures(folder)
    pictures = intrinsics_method.look(images, board)
    result = label.put(intrinsics_method.calibrate(pictures, board), (folder / name for name in images))
    report.draw_intrinsics(picture, result, pictures, images, board)
    return result


@dataclass(frozen=True, slots=True)
class HandEyeFiles:
    pictures: Path
    poses: Path
    lens: Path
    touch: Path | None


def hand_eye(given: HandEyeFiles, board: vision.Board, noise: RobotNoise, label: Label, picture: Path) -> Result:
    images = files.pictures(given.pictures)
    flange = _named_poses(given.poses, images)
    pictures = intrinsics_method.look(images, board)
    lens = load(given.lens, "intrinsics", mode=f"{pictures.size[0]}x{pictures.size[1]}")
    touch = None if given.touch is None else _touch(given.touch)
    seen = sightings.sight(pictures, board, lens)
    views = seen.views(flange)
    try:
        result, solution = hand_eye_method.calibrate(views, noise, touch=touch)
    except CalibrationError as error:
        raise CalibrationError([*error.lines, *pictures.dropped]) from error
    result = replace(
        result,
        quality=result.quality | {"corner_px": seen.sigma, "dropped": pictures.dropped},
        serials=lens.serials,
        mode=lens.mode,
    )
    inputs = [*(given.pictures / name for name in images), given.poses, *([given.touch] if given.touch else [])]
    result = label.put(result, inputs, intrinsics=lens.digest.hex())
    K, distortion = lens.camera_matrix(), lens.distortion()
    predicted = inverse(solution.T_base_cam) @ views.flange @ solution.T_flange_board
    used = [i for i, name in enumerate(pictures.names) if name in flange]
    worst = np.argsort(np.linalg.norm(predicted[:, :3, 3] - views.board[:, :3, 3], axis=1))
    shown = []
    for i in (int(worst[len(worst) // 2]), int(worst[-1]))[:OVERLAYS]:
        name, detection = pictures.names[used[i]], pictures.detections[used[i]]
        expected = vision.project(board.corners()[detection.ids], predicted[i], K, distortion)
        shown.append((f"{name}: where the robot says", images[name], detection, expected))
    report.draw_hand_eye(picture, result, solution, views, noise, shown)
    return result


def _named_poses(path: Path, images: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    table = files.Table(path)
    return _by_picture(table, table.poses(), images)


def _by_picture(table: files.Table, rows: np.ndarray, images: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The rows by the picture that each belongs to; one for every picture."""
    path, names = table.path, table.words("picture")
    faults = [
        f"{path}: picture {name!r} stands in several lines" for name in sorted(set(names)) if names.count(name) > 1
    ]
    faults += [f"{path}: picture {name!r} is not in the folder" for name in names if name not in images]
    faults += [f"{path}: no line for picture {name!r}" for name in images if name not in names]
    if faults:
        raise CalibrationError(faults)
    return dict(zip(names, rows, strict=True))


def _touch(path: Path) -> Touch:
    table = files.Table(path)
    return Touch(table.positions(), table.numbers(("cx", "cy", "cz"), ("m", "mm")))


def tool(poses: Path, touch_mm: float, label: Label, picture: Path) -> Result:
    if not 0.01 <= touch_mm <= 10:
        raise CalibrationError([f"--touch-mm: {touch_mm:g} mm is no touch's error; 0.01 to 10"])
    flange = files.Table(poses).poses()
    result = label.put(tool_method.calibrate(flange, touch_mm * 1e-3), [poses])
    report.draw_tool(picture, result, flange)
    return result


def payload(loaded: Path, empty: Path | None, robot: str, label: Label, picture: Path) -> Result:
    from asc_rt.config import load_arm

    arm, _ = load_arm(robot, "bare")
    dof = len(arm.joints)
    table = files.Table(loaded)
    q, tau = table.joints(dof), table.torques(dof)
    tau_empty = None if empty is None else _empty_torques(empty, q)
    result = payload_method.calibrate(arm, q, tau, tau_empty)
    result = label.put(result, [loaded, *([empty] if empty else [])])
    report.draw_payload(picture, result, payload_method.unexplained(arm, q, tau, tau_empty, result))
    return replace(result, quality=result.quality | {"tool_lines": payload_method.tool_lines(result)})


def _empty_torques(path: Path, q: np.ndarray) -> np.ndarray:
    table = files.Table(path)
    there = table.joints(q.shape[1])
    if there.shape != q.shape or np.abs(there - q).max() > 0.01:
        raise CalibrationError([f"{path}: not the poses of the loaded table, in its order, to within 0.01 rad"])
    return table.torques(q.shape[1])


def time_offset(robot: Path, camera: Path, tool: Path | None, span: float, label: Label, picture: Path) -> Result:
    if not 0.01 <= span <= 5:
        raise CalibrationError([f"--span-s: {span:g} s is not possible; 0.01 to 5"])
    t_robot, p_robot = _robot_trace(robot, tool)
    seen = files.Table(camera)
    t_cam, p_cam = seen.times(), seen.positions()
    result = label.put(time_offset_method.calibrate(t_cam, p_cam, t_robot, p_robot, span), [robot, camera])
    offsets, costs, left = time_offset_method.fits(t_cam, p_cam, t_robot, p_robot, span, result.value[0])
    report.draw_time_offset(picture, result, offsets, costs, left)
    return result


def _robot_trace(path: Path, tool: Path | None) -> tuple[np.ndarray, np.ndarray]:
    """(n,) s and (n, 3) m of a point of the robot: what the table says, or the tip of `tool` in a recording."""
    if path.suffix != ".mcap":
        table = files.Table(path)
        return table.times(), table.positions()
    from logs.reader import open_log

    log = open_log(path)
    found = log.columns("inputs.joint.t_rx_ns", "inputs.joint.q")
    t, q = found["inputs.joint.t_rx_ns"], found["inputs.joint.q"]
    fresh = np.flatnonzero(np.diff(t, prepend=t[0] - 1) > 0)  # a cycle without news repeats the last sample
    flange = payload_method.flange_poses(log.params.robot, q[fresh])
    tip = np.zeros(3) if tool is None else np.array(load(tool, "tool").value)
    return 1e-9 * t[fresh], flange[:, :3, :3] @ tip + flange[:, :3, 3]


@dataclass(frozen=True, slots=True)
class DriftFiles:
    depth: Path  # folder
    joints: Path
    lens: Path
    eye: Path


def drift(given: DriftFiles, robot: str, tool: str, unit: float, margin: float, picture: Path) -> drift_method.Drift:
    from asc_rt.config import load_arm

    model = robot_model.load(*load_arm(robot, tool))
    images = files.depths(given.depth, unit)
    table = files.Table(given.joints)
    q = _by_picture(table, table.joints(len(model.chain.axis)), images)
    height, width = next(iter(images.values())).shape
    mode = f"{width}x{height}"
    lens = load(given.lens, "intrinsics", mode=mode)
    eye = load(given.eye, "hand-eye", mode=mode, serials={k: v for k, v in lens.serials.items() if k == "camera"})
    frames = {name: drift_method.Frame(image, q[name]) for name, image in images.items()}
    K, distortion = lens.camera_matrix(), lens.distortion()
    found = drift_method.check(model, list(frames.values()), K, distortion, eye.pose(), margin)
    scenes = [drift_method.place(model, frame.q) for frame in frames.values()]
    report.draw_drift(picture, found, frames, scenes, eye.pose(), K, distortion)
    return found
