"""How much later does the camera's clock read than the robot's? From one smooth motion that both of them see.

t_robot = t_cam + offset. The camera's trace is the robot's at the other time, moved rigidly (the extrinsics may be
unknown): p_cam(t) = R p_robot(t + offset) + s. First on a grid over offsets, each with its best R and s; then
Gauss-Newton in all 7 unknowns, with the robot's trace as a cubic spline.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from calibration.geometry import skew
from calibration.result import CalibrationError, Result

GRID = 5e-3  # s
LEAST_SAMPLES = 50
LEAST_MOTION = 0.02  # m, standard deviation of the position
MOST_SHARE = 0.25  # of the motion that may stay unexplained
MOST_SIGMA = 2e-3  # s; the self-filter needs 5 ms
RIVAL = 1.3  # a second offset this close in cost: the motion repeats itself


def calibrate(
    t_cam: np.ndarray, p_cam: np.ndarray, t_robot: np.ndarray, p_robot: np.ndarray, span: float = 0.3
) -> Result:
    """Offset (s) within +-`span` from (n,) s, (n, 3) m and (m,) s, (m, 3) m. CalibrationError: no usable traces."""
    _check(t_cam, p_cam, t_robot, p_robot)
    inside = (t_cam > t_robot[0] + span) & (t_cam < t_robot[-1] - span)
    t, p = t_cam[inside], p_cam[inside]
    if len(t) < LEAST_SAMPLES:
        raise CalibrationError(
            [f"samples: {len(t)} of the camera lie within the robot's trace; at least {LEAST_SAMPLES}"]
        )
    path = CubicSpline(t_robot, p_robot)
    offsets = np.arange(-span, span + GRID / 2, GRID)
    costs = np.array([_rigid(path(t + o), p)[2] for o in offsets])
    best = int(np.argmin(costs))
    offset, covariance, rms = _refine(path, t, p, float(offsets[best]))
    motion = float(np.sqrt(np.mean(np.sum((p - p.mean(0)) ** 2, axis=1))))
    reasons = []
    if motion < LEAST_MOTION:
        reasons.append(f"motion of {1e3 * motion:.1f} mm; at least {1e3 * LEAST_MOTION:g}: move faster and farther")
    if rms > MOST_SHARE * motion:
        share = f"{rms / motion:.0%} of the motion"
        reasons.append(f"{share} stays unexplained: other frames or units (metres), or not the same motion")
    if best in (0, len(offsets) - 1) or abs(offset) > span:
        reasons.append(f"the best offset is at the end of +-{span:g} s; is it the same clock?")
    if _rival(costs, best):
        reasons.append("another offset fits as well: the motion repeats itself; move without a period")
    if covariance > MOST_SIGMA**2:
        reasons.append(f"known to {1e3 * np.sqrt(covariance):.1f} ms only; at most {1e3 * MOST_SIGMA:g}")
    quality = {"samples": len(t), "rms": rms, "motion": motion}
    return Result(
        "time-offset", "cam-robot", (offset,), ((covariance,),), "rigid motion correlation, then least squares",
        quality=quality, reasons=tuple(reasons),
    )  # fmt: skip


def fits(
    t_cam: np.ndarray, p_cam: np.ndarray, t_robot: np.ndarray, p_robot: np.ndarray, span: float, best: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Trial offsets (s), the rms (m) that each leaves, and (n, 3) m what `best` leaves."""
    inside = (t_cam > t_robot[0] + span) & (t_cam < t_robot[-1] - span)
    t, p, path = t_cam[inside], p_cam[inside], CubicSpline(t_robot, p_robot)
    offsets = np.arange(-span, span + GRID / 2, GRID)
    costs = np.array([_rigid(path(t + o), p)[2] for o in offsets])
    R, s, _ = _rigid(path(t + best), p)
    return offsets, np.sqrt(costs / len(t)), p - path(t + best) @ R.T - s


def _check(t_cam: np.ndarray, p_cam: np.ndarray, t_robot: np.ndarray, p_robot: np.ndarray) -> None:
    lines = []
    for name, t, p in (("camera", t_cam, p_cam), ("robot", t_robot, p_robot)):
        if p.shape != (len(t), 3) or len(t) < LEAST_SAMPLES:
            lines.append(f"{name}: shapes {t.shape}, {p.shape}; (n,) and (n, 3) with n of at least {LEAST_SAMPLES}")
        elif not (np.isfinite(t).all() and np.isfinite(p).all() and (np.diff(t) > 0).all()):
            lines.append(f"{name}: numbers that are not finite, or times that do not rise")
    if lines:
        raise CalibrationError(lines)


def _rigid(p: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """R, s and the cost sum |q - R p - s|^2 (Kabsch)."""
    a, b = p - p.mean(0), q - q.mean(0)
    U, _, Vt = np.linalg.svd(b.T @ a)
    R = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    return R, q.mean(0) - R @ p.mean(0), float(np.sum((b - a @ R.T) ** 2))


def _refine(path: CubicSpline, t: np.ndarray, p: np.ndarray, offset: float) -> tuple[float, float, float]:
    """offset, its variance, rms (m)."""
    for _ in range(20):
        R, s, _ = _rigid(path(t + offset), p)
        moved = path(t + offset) @ R.T
        J = np.concatenate(
            [(path(t + offset, 1) @ R.T)[:, :, None], np.tile(np.eye(3), (len(t), 1, 1)), -skew(moved)], 2
        )
        J, r = J.reshape(-1, 7), (p - moved - s).ravel()
        step = np.linalg.lstsq(J, r, rcond=None)[0]
        offset += float(np.clip(step[0], -GRID, GRID))
        if abs(step[0]) < 1e-9:
            break
    variance = float(r @ r) / (len(r) - 7)
    return offset, max(variance * float(np.linalg.pinv(J.T @ J)[0, 0]), 1e-18), float(np.sqrt(3 * np.mean(r**2)))


def _rival(costs: np.ndarray, best: int) -> bool:
    """Is there another minimum nearly as deep?"""
    low = [i for i in range(1, len(costs) - 1) if costs[i] <= min(costs[i - 1], costs[i + 1]) and abs(i - best) > 2]
    return any(costs[i] < RIVAL * costs[best] + 1e-12 for i in low)
