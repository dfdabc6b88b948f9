"""The independent check of a camera: points it sees, touched by the robot with its calibrated tip."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.geometry import skew


@dataclass(frozen=True, slots=True)
class Touch:
    """The independent check: corners of a board lying in the cell, touched with the calibrated tool tip."""

    tip: np.ndarray  # (m, 3) m in the base frame
    seen: np.ndarray  # (m, 3) m in the camera frame
    sigma: float = 1e-3  # m, of one touch

    def compare(self, Z: np.ndarray, covariance: np.ndarray) -> tuple[float, list[str]]:
        """mm rms, and the reason against T_base_cam `Z` if it is outside 3 sigma of camera and touch together."""
        p = self.seen @ Z[:3, :3].T
        gaps = np.linalg.norm(p + Z[:3, 3] - self.tip, axis=1)
        worst = 0.0
        for gap, point in zip(gaps, p, strict=True):
            J = np.hstack([np.eye(3), -skew(point)])
            C = J @ covariance @ J.T + self.sigma**2 * np.eye(3)
            worst = max(worst, gap / np.sqrt(np.trace(C)))
        rms = float(1e3 * np.sqrt(np.mean(gaps**2)))
        return rms, [f"touch check: {worst:.1f} sigma ({rms:.1f} mm) off; at most 3"] if worst > 3 else []
