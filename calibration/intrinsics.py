"""Lens and focal length of a camera from views of a ChArUco board, accepted on what the numbers will be used for.

The rms tells nothing: 25 views in the middle of the picture have a better rms than full coverage, and rays at the edge
that are hundreds of pixels off. So the gate asks for coverage, tilt, the error on held-out views, and how far the rays
of two calibrations from half the views each differ anywhere in the picture, after the best rotation between them.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from calibration import vision
from calibration.geometry import perturb
from calibration.result import CalibrationError, Result, rows
from calibration.vision import Board, Detection

CELLS = (6, 8)  # rows, columns of the coverage map
LEAST_CORNERS = 12  # of a view
LEAST_VIEWS = 12
MOST_BLUR = 1.8  # px, sigma of an edge; MEASURED: rendered boards blurred by 2 px keep 2 to 9 of 40 corners
LEAST_TILT_DEG = 30.0
LEAST_COVERAGE = 0.9
MOST_SIGMA_F = 2.0  # px
MOST_HOLDOUT = 0.6  # px
MOST_RAY = 3.0  # px at the picture's edge


@dataclass(frozen=True, slots=True)
class Pictures:
    """Detections of the views that are fit to be used, and why the others are not."""

    size: tuple[int, int]  # width, height
    detections: list[Detection]
    names: list[str]
    dropped: list[str]


def look(images: dict[str, np.ndarray], board: Board) -> Pictures:
    """Find the board in every picture. CalibrationError: pictures of several sizes, or none."""
    sizes = {image.shape[1::-1] for image in images.values()}
    if len(sizes) != 1:
        raise CalibrationError([f"pictures: {len(images)} of the sizes {sorted(sizes)}; at least one, all of one mode"])
    found, names, dropped = [], [], []
    for name, image in images.items():
        detection = vision.detect(image, board)
        fault = unfit(image, detection, board)
        if fault:
            dropped.append(f"{name}: {fault}")
        else:
            found.append(detection)
            names.append(name)
    (size,) = sizes
    return Pictures((int(size[0]), int(size[1])), found, names, dropped)


def unfit(image: np.ndarray, detection: Detection, board: Board) -> str:
    """Why this picture is of no use; empty: it is."""
    if vision.edge_width(image) > MOST_BLUR:
        return "blurred; hold still, focus, shorten the exposure"
    if len(detection) >= LEAST_CORNERS:
        return ""
    if vision.detect(np.ascontiguousarray(image[:, ::-1]), board).markers > max(detection.markers, 3):
        return "the board is mirrored; switch the camera's mirror mode off, or print the board again"
    return f"{len(detection)} corners of this board; at least {LEAST_CORNERS}: show more of it, check its size"


def calibrate(pictures: Pictures, board: Board) -> Result:
    """Intrinsics of the mode of these pictures; every fourth view is held out. CalibrationError: too few views."""
    n = len(pictures.detections)
    if n < LEAST_VIEWS:
        few = f"views: {n} of {n + len(pictures.dropped)} can be used; at least {LEAST_VIEWS}"
        raise CalibrationError([few, *pictures.dropped])
    fit = fitted(pictures)
    held = [d for i, d in enumerate(pictures.detections) if i % 4 == 3]
    K, distortion, poses, rms = vision.calibrate_camera(fit, board, pictures.size)
    C = covariance(fit, board, K, distortion, poses)
    quality = {
        "views": len(fit),
        "rms": rms,
        "coverage": float(np.mean(coverage(pictures) > 0)),
        "tilt_deg": tilt(poses),
        "holdout": float(np.sqrt(np.mean([vision.board_pose(d, board, K, distortion, 1.0)[2] ** 2 for d in held]))),
        "edge_px": float(np.max(ray_difference(fit, board, pictures.size)[1])),
        "dropped": pictures.dropped,
    }
    value = (K[0, 0], K[1, 1], K[0, 2], K[1, 2], *distortion)
    return Result(
        "intrinsics", "cam", tuple(float(v) for v in value), rows(C), "ChArUco, least squares, 5 distortion terms",
        quality=quality, reasons=tuple(_reasons(quality, float(np.sqrt(max(C[0, 0], C[1, 1]))))),
        mode=f"{pictures.size[0]}x{pictures.size[1]}",
    )  # fmt: skip


def _reasons(quality: dict[str, object], sigma_f: float) -> list[str]:
    limits = (
        ("coverage", "below", LEAST_COVERAGE, "show the board in every part of the picture, corners too"),
        ("tilt_deg", "below", LEAST_TILT_DEG, "tilt the board more, about both axes"),
        (
            "holdout",
            "above",
            MOST_HOLDOUT,
            "views not used do not fit (px): is the board flat, is this the right board?",
        ),
        ("edge_px", "above", MOST_RAY, "two halves of the views disagree near the edge (px): more views there"),
    )
    reasons = []
    for key, side, limit, cure in limits:
        value = float(quality[key])  # type: ignore[arg-type]
        if not (value >= limit if side == "below" else value <= limit):
            reasons.append(f"{key} {value:.3g} is {side} {limit:g}: {cure}")
    if not sigma_f <= MOST_SIGMA_F:
        reasons.append(
            f"the focal length is known to {sigma_f:.2g} px only; at most {MOST_SIGMA_F:g}: more tilted views"
        )
    return reasons


def coverage(pictures: Pictures) -> np.ndarray:
    """(rows, columns) of CELLS: corners seen in each part of the picture."""
    counts = np.zeros(CELLS, int)
    for detection in pictures.detections:
        x, y = (detection.pixels / pictures.size).T
        row = np.clip((y * CELLS[0]).astype(int), 0, CELLS[0] - 1)
        np.add.at(counts, (row, np.clip((x * CELLS[1]).astype(int), 0, CELLS[1] - 1)), 1)
    return counts


def tilt(poses: list[np.ndarray]) -> float:
    """deg: the largest angle between two boards' normals."""
    normals = [T[:3, 2] for T in poses]
    return float(np.degrees(max(np.arccos(np.clip(a @ b, -1, 1)) for a, b in combinations(normals, 2))))


def fitted(pictures: Pictures) -> list[Detection]:
    """All but every fourth view, which is held out."""
    return [d for i, d in enumerate(pictures.detections) if i % 4 != 3]


def ray_difference(detections: list[Detection], board: Board, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """(n, 2) px over the picture, and (n,) px by which the rays of the even and of the odd views differ there."""
    grid = np.stack(np.meshgrid(np.linspace(0, size[0], 17), np.linspace(0, size[1], 13)), -1).reshape(-1, 2)
    halves = [vision.calibrate_camera(detections[k::2], board, size)[:2] for k in (0, 1)]
    a, b = (vision.rays(grid, K, d) for K, d in halves)
    U, _, Vt = np.linalg.svd(b.T @ a)
    R = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    return grid, np.linalg.norm(b - a @ R.T, axis=1) * halves[0][0][0, 0]


def covariance(
    detections: list[Detection], board: Board, K: np.ndarray, distortion: np.ndarray, poses: list[np.ndarray]
) -> np.ndarray:
    """(9, 9) over fx fy cx cy k1 k2 p1 p2 k3: the boards' poses are eliminated view by view (Schur complement)."""
    information, square, count = np.zeros((9, 9)), 0.0, -9
    corners = board.corners()
    for view, T in zip(detections, poses, strict=True):
        J_lens, J_pose = jacobians(corners[view.ids], T, K, distortion)
        r = vision.residual(vision.project(corners[view.ids], T, K, distortion), view.pixels)
        information += J_lens.T @ (J_lens - J_pose @ np.linalg.lstsq(J_pose, J_lens, rcond=None)[0])
        square, count = square + float(np.sum(r**2)), count + r.size - 6
    return square / count * np.linalg.inv(information)


def jacobians(
    points: np.ndarray, T: np.ndarray, K: np.ndarray, distortion: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(2n, 9) of the pixels over the intrinsics, (2n, 6) over the board's pose."""
    x = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *distortion])

    def pixels(x: np.ndarray, xi: np.ndarray) -> np.ndarray:
        matrix = np.array([[x[0], 0, x[2]], [0, x[1], x[3]], [0, 0, 1]])
        return vision.project(points, perturb(T, xi), matrix, x[4:]).ravel()

    o = np.zeros(6)
    steps = np.diag([1e-2] * 4 + [1e-5] * 5)
    lens = [(pixels(x + d, o) - pixels(x - d, o)) / (2 * d.sum()) for d in steps]
    pose = [(pixels(x, d) - pixels(x, -d)) / (2 * d.sum()) for d in 1e-6 * np.eye(6)]
    return np.stack(lens, 1), np.stack(pose, 1)
