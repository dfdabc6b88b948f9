"""Every call into OpenCV for calibration: arrays come back with one shape, (n, 2) or (n, 3), in any version.

OpenCV 5 returns (n, 2) from one function and (n, 1, 2) from the next; their difference broadcasts to (n, n, 2) without
any error. Nobody but this module sees OpenCV's shapes, and `residual` refuses what does not match.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from calibration.geometry import exp, log, perturb, pose

DICTIONARY = cv2.aruco.DICT_5X5_250
SMOOTHING = 1.0  # px, against noise before slopes are measured
MARKER_SHARE = 0.75  # of a square's side


@dataclass(frozen=True, slots=True)
class Board:
    """A ChArUco board. `square`: the side MEASURED on the print, m. Origin at its first corner, z into it."""

    columns: int = 9
    rows: int = 6
    square: float = 0.03

    def detector(self) -> cv2.aruco.CharucoDetector:
        return cv2.aruco.CharucoDetector(self._cv())

    def _cv(self) -> cv2.aruco.CharucoBoard:
        dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARY)
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, MARKER_SHARE * self.square, dictionary)

    def corners(self) -> np.ndarray:
        """(n, 3) m, board frame, by corner number."""
        return points3(self._cv().getChessboardCorners())

    def picture(self, pixels_per_square: int = 80) -> np.ndarray:
        """(rows, columns) grey, without margin: for printing, and for rendering."""
        size = (self.columns * pixels_per_square, self.rows * pixels_per_square)
        return np.asarray(self._cv().generateImage(size, marginSize=0))


@dataclass(frozen=True, slots=True)
class Detection:
    ids: np.ndarray  # (n,) corner numbers
    pixels: np.ndarray  # (n, 2)
    markers: int

    def __len__(self) -> int:
        return len(self.ids)


def points2(array: object) -> np.ndarray:
    return np.asarray(array, float).reshape(-1, 2)


def points3(array: object) -> np.ndarray:
    return np.asarray(array, float).reshape(-1, 3)


def residual(predicted: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """(n, 2) px. ValueError for shapes that would broadcast."""
    if predicted.shape != seen.shape or predicted.ndim != 2 or predicted.shape[1] != 2:
        raise ValueError(f"residual of shapes {predicted.shape} and {seen.shape}; both must be (n, 2)")
    return predicted - seen


def detect(image: np.ndarray, board: Board) -> Detection:
    """Corners of the board in a grey or BGR picture; empty where there are none."""
    corners, ids, _, marker_ids = board.detector().detectBoard(image)
    markers = 0 if marker_ids is None else len(marker_ids)
    if ids is None or len(ids) == 0:
        return Detection(np.zeros(0, int), np.zeros((0, 2)), markers)
    return Detection(np.asarray(ids).reshape(-1), points2(corners), markers)


def read(path: Path) -> np.ndarray | None:
    """(height, width) grey, 8 bits; None: no picture."""
    image = cv2.imdecode(np.frombuffer(path.read_bytes() or b"0", np.uint8), cv2.IMREAD_GRAYSCALE)
    return None if image is None else np.asarray(image)


def read_depth(path: Path) -> np.ndarray | None:
    """(height, width) 16 bits as they stand in the file; None: no picture of 16 bits and one channel."""
    image = cv2.imdecode(np.frombuffer(path.read_bytes() or b"0", np.uint8), cv2.IMREAD_UNCHANGED)
    return np.asarray(image) if image is not None and image.dtype == np.uint16 and image.ndim == 2 else None


def write(path: Path, image: np.ndarray) -> None:
    ok, data = cv2.imencode(path.suffix, image)
    if not ok:
        raise ValueError(f"{path.suffix}: no format for pictures")
    path.write_bytes(data.tobytes())


def blur(image: np.ndarray, sigma: float) -> np.ndarray:
    """Out of focus by `sigma` px."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma))


def edge_width(image: np.ndarray) -> float:
    """px: sigma of the blur of the sharpest edges, from contrast / (sqrt(2 pi) slope); noise hardly matters."""
    smooth = cv2.GaussianBlur(image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), (0, 0), SMOOTHING)
    slope = np.hypot(*(cv2.Sobel(smooth, cv2.CV_64F, *axis, scale=1 / 8) for axis in ((1, 0), (0, 1))))
    low, high = np.quantile(smooth, (0.005, 0.995))
    width = float((high - low) / (np.sqrt(2 * np.pi) * max(np.quantile(slope, 0.999), 1e-9)))
    return float(np.sqrt(max(width**2 - SMOOTHING**2, 0.0)))


def project(points: np.ndarray, T: np.ndarray, K: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """(n, 3) m in a frame placed by T (T_cam_frame) -> (n, 2) px."""
    return points2(cv2.projectPoints(points, log(T[:3, :3]), T[:3, 3], K, distortion)[0])


def rays(pixels: np.ndarray, K: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """(n, 2) px -> (n, 3) unit vectors in the camera frame."""
    flat = points2(cv2.undistortPoints(pixels.reshape(-1, 1, 2), K, distortion))
    full = np.column_stack([flat, np.ones(len(flat))])
    return full / np.linalg.norm(full, axis=1, keepdims=True)


def board_pose(
    detection: Detection, board: Board, K: np.ndarray, distortion: np.ndarray, sigma: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """T_cam_board, its (6, 6) covariance (parent's axes) for corner noise of `sigma` px, and the rms in px."""
    points = board.corners()[detection.ids]
    ok, w, t = cv2.solvePnP(points, detection.pixels.reshape(-1, 1, 2), K, distortion, flags=cv2.SOLVEPNP_ITERATIVE)
    T = pose(exp(points3(w)[0]), points3(t)[0])
    for _ in range(10):
        J, r = _pose_jacobian(points, T, K, distortion), residual(project(points, T, K, distortion), detection.pixels)
        step = np.linalg.lstsq(J, -r.ravel(), rcond=None)[0]
        T = perturb(T, step)
        if np.abs(step).max() < 1e-10:
            break
    r = residual(project(points, T, K, distortion), detection.pixels)
    return T, sigma**2 * np.linalg.inv(J.T @ J), float(np.sqrt(np.mean(np.sum(r**2, axis=1))))


def _pose_jacobian(points: np.ndarray, T: np.ndarray, K: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """(2n, 6) of the pixels over the pose's perturbation."""
    h = 1e-6
    columns = [
        (project(points, perturb(T, d), K, distortion) - project(points, perturb(T, -d), K, distortion)).ravel()
        / (2 * h)
        for d in h * np.eye(6)
    ]
    return np.stack(columns, 1)


def calibrate_camera(
    detections: list[Detection], board: Board, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray], float]:
    """K (3, 3), distortion (5,), T_cam_board per view, rms px; `size` (width, height)."""
    corners = board.corners().astype(np.float32)
    rms, K, d, ws, ts = cv2.calibrateCamera(
        [corners[view.ids].reshape(-1, 1, 3) for view in detections],
        [view.pixels.astype(np.float32).reshape(-1, 1, 2) for view in detections],
        size, None, None,
    )[:5]  # fmt: skip
    poses = [pose(exp(points3(w)[0]), points3(t)[0]) for w, t in zip(ws, ts, strict=True)]
    return np.asarray(K), np.asarray(d).reshape(-1)[:5], poses, float(rms)
