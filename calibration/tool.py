"""Where is the tool centre point? The tip rests on one fixed point while the flange turns about it (4-point, sphere).

R_i p + t_i = c for every pose: linear in p (T_flange_tcp translation) and c (the point, base frame), 3 n equations, 6
unknowns. The residual stays small for good and for bad sets alike; what tells them apart is the condition number.
"""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri

from calibration.result import CalibrationError, Result, rows

LEAST_POSES = 4
MOST_CONDITION = 8.0  # MEASURED on synthetic touches: 4 poses at +-10 deg give 6 mm at the 95th percentile, and 11
MOST_REACH = 1.5  # m from flange to tip; more are millimetres taken for metres
CHI2_TAIL = 1e-3


def calibrate(flange: np.ndarray, sigma: float = 0.5e-3) -> Result:
    """The tip in the flange's frame from (n, 4, 4) T_base_flange; `sigma` (m) of one touch, robot and eye together.

    CalibrationError: too few poses.
    """
    n = len(flange)
    if n < LEAST_POSES:
        raise CalibrationError([f"poses: {n} are too few; at least {LEAST_POSES}"])
    H = np.concatenate([flange[:, :3, :3], -np.tile(np.eye(3), (n, 1, 1))], 2).reshape(-1, 6)
    h = -flange[:, :3, 3].ravel()
    condition = float(np.linalg.cond(H))
    x = np.linalg.lstsq(H, h, rcond=None)[0]
    r = H @ x - h
    C = sigma**2 * np.linalg.pinv(H.T @ H) + 1e-18 * np.eye(6)
    dof = 3 * n - 6
    chi2_dof = float(r @ r) / sigma**2 / dof
    reasons = []
    if not condition <= MOST_CONDITION:
        reasons.append(
            f"condition {condition:.3g} is above {MOST_CONDITION:g}: turn the flange farther, about two axes"
        )
    if chi2_dof > chdtri(dof, CHI2_TAIL) / dof:
        reasons.append(
            f"chi2_dof {chi2_dof:.3g}: the tip did not stay on one point within {1e3 * sigma:g} mm; "
            "look for slipped touches or millimetres taken for metres"
        )
    if np.linalg.norm(x[:3]) > MOST_REACH:
        reasons.append(f"the tip is {np.linalg.norm(x[:3]):.3g} m from the flange; lengths are in metres")
    if np.linalg.norm(x[:3]) >= np.linalg.norm(x[3:]):  # swapped frames fit just as well: tip and point change places
        reasons.append(
            "the tip is farther from the flange than the point from the base; swapped frames? base_flange is needed"
        )
    quality = {"poses": n, "rms": float(np.sqrt(3 * np.mean(r**2))), "chi2_dof": chi2_dof, "condition": condition}
    return Result(
        "tool", "T_flange_tcp", tuple(float(v) for v in x[:3]), rows(C[:3, :3]), "fixed point, linear least squares",
        quality=quality, reasons=tuple(reasons),
    )  # fmt: skip
