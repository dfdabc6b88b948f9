"""From pictures of the board and what the robot said: the views that hand-eye calibrates, with honest error bars.

What the lens and the print may be wrong by moves the boards of all views alike; it travels as shared unknowns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration import vision
from calibration.hand_eye import SQUARE_SIGMA, Views, with_square
from calibration.intrinsics import Pictures, jacobians
from calibration.result import CalibrationError, Result

LEAST_SIGMA = 0.05  # px; no detector is better
PRIOR = 10.0  # residuals that all views' scatter counts for in the scatter of one
MOST_SIGMA = 1.0  # px; more is another lens, another board or a bent one


@dataclass(frozen=True, slots=True)
class Sightings:
    """The board in each picture that can be used, in the camera's frame."""

    names: list[str]
    board: np.ndarray  # (n, 4, 4) T_cam_board
    covariance: np.ndarray  # (n, 6, 6) parent's axes
    lens: np.ndarray  # (n, 6, 9) how each moves with the intrinsics' errors, of unit variance
    sigma: float  # px, of a corner along each axis, over all views

    def views(self, flange: dict[str, np.ndarray]) -> Views:
        """With what the robot said, T_base_flange by picture name."""
        used = [i for i, name in enumerate(self.names) if name in flange]
        if not used:
            raise CalibrationError(["poses: none belongs to a picture that can be used; the names must be equal"])
        T = np.array([flange[self.names[i]] for i in used])
        return with_square(Views(T, self.board[used], self.covariance[used], self.lens[used]), SQUARE_SIGMA)


def sight(pictures: Pictures, board: vision.Board, intrinsics: Result) -> Sightings:
    """Where the board is in every picture. CalibrationError: no picture of use, or the lens does not fit them."""
    if not pictures.detections:
        raise CalibrationError(["views: none can be used", *pictures.dropped])
    K, distortion = intrinsics.camera_matrix(), intrinsics.distortion()
    found = [vision.board_pose(d, board, K, distortion, 1.0) for d in pictures.detections]
    squares = np.array([rms**2 * len(d) for d, (_, _, rms) in zip(pictures.detections, found, strict=True)])
    freedom = np.array([2 * len(d) - 6 for d in pictures.detections])
    sigma = max(float(np.sqrt(squares.sum() / freedom.sum())), LEAST_SIGMA)
    if sigma > MOST_SIGMA:
        words = "the intrinsics are of another camera or mode, or the board is another one or bent"
        raise CalibrationError([f"corners are off by {sigma:.2g} px; at most {MOST_SIGMA:g}: {words}"])
    of_view = (squares + PRIOR * sigma**2) / (freedom + PRIOR)  # a tilted board's corners are found less exactly
    corners = board.corners()
    T = np.array([t for t, _, _ in found])
    lens = [lens_effect(corners[d.ids], t, intrinsics) for d, t in zip(pictures.detections, T, strict=True)]
    return Sightings(
        pictures.names, T, of_view[:, None, None] * np.array([C for _, C, _ in found]), np.array(lens), sigma
    )


def lens_effect(points: np.ndarray, T: np.ndarray, intrinsics: Result) -> np.ndarray:
    """(6, 9) how a board's pose moves with the intrinsics' errors, each of unit variance."""
    J_lens, J_pose = jacobians(points, T, intrinsics.camera_matrix(), intrinsics.distortion())
    root = np.linalg.cholesky(np.array(intrinsics.covariance))
    return np.asarray(-np.linalg.lstsq(J_pose, J_lens @ root, rcond=None)[0])
