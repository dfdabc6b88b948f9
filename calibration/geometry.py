"""Rotations and poses for calibration, vectorised over leading axes. Right-handed, active; quaternions scalar last."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def skew(v: np.ndarray) -> np.ndarray:
    """(..., 3) -> (..., 3, 3) with skew(v) @ x = v cross x."""
    x, y, z = np.moveaxis(np.asarray(v, float), -1, 0)
    o = np.zeros_like(x)
    return np.stack([np.stack([o, -z, y], -1), np.stack([z, o, -x], -1), np.stack([-y, x, o], -1)], -2)


def exp(w: np.ndarray) -> np.ndarray:
    """(..., 3) rad -> (..., 3, 3): Rodrigues' formula."""
    w = np.asarray(w, float)
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    K = skew(w)
    return np.eye(3) + np.sinc(angle / np.pi) * K + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * (K @ K)


def log(R: np.ndarray) -> np.ndarray:
    """(..., 3, 3) -> (..., 3) rad, length at most pi."""
    q = quaternion_from_matrix(R)
    s = np.linalg.norm(q[..., :3], axis=-1)
    angle = 2 * np.arctan2(s, q[..., 3])
    return q[..., :3] * np.where(s > 1e-12, angle / np.maximum(s, 1e-12), 2.0)[..., None]


def quaternion_from_matrix(R: np.ndarray) -> np.ndarray:
    """(..., 3, 3) -> (..., 4) x y z w with w >= 0: the dominant eigenvector of Bar-Itzhack's symmetric matrix."""
    R = np.asarray(R, float)
    B = np.empty((*R.shape[:-2], 4, 4))
    B[..., :3, :3] = R + np.swapaxes(R, -1, -2)
    trace = np.trace(R, axis1=-2, axis2=-1)
    B[..., :3, :3] -= trace[..., None, None] * np.eye(3)
    B[..., 3, 3] = trace
    vector = np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], -1)
    B[..., 3, :3] = B[..., :3, 3] = vector
    q = np.linalg.eigh(B)[1][..., -1]
    return q * np.where(q[..., 3:] < 0, -1.0, 1.0)


def matrix_from_quaternion(q: np.ndarray) -> np.ndarray:
    """(..., 4) x y z w -> (..., 3, 3)."""
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    v, w = q[..., :3], q[..., 3, None, None]
    K = skew(v)
    return np.eye(3) + 2 * w * K + 2 * (K @ K)


def pose(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """(..., 3, 3), (..., 3) -> (..., 4, 4)."""
    T = np.zeros((*np.shape(t)[:-1], 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, t, 1.0
    return T


def inverse(T: np.ndarray) -> np.ndarray:
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    return pose(Rt, -(Rt @ T[..., :3, 3:])[..., 0])


def perturb(T: np.ndarray, xi: np.ndarray) -> np.ndarray:
    """t + xi[:3], exp(xi[3:]) R: both in the parent's axes (the convention of the result files)."""
    return pose(exp(xi[..., 3:]) @ T[..., :3, :3], T[..., :3, 3] + xi[..., :3])


def difference(T: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """(..., 6) xi with perturb(origin, xi) = T."""
    w = log(T[..., :3, :3] @ np.swapaxes(origin[..., :3, :3], -1, -2))
    return np.concatenate([T[..., :3, 3] - origin[..., :3, 3], w], -1)


def look_at(eye: npt.ArrayLike, target: npt.ArrayLike) -> np.ndarray:
    """(4, 4) T_base_cam of a level camera at `eye` that looks at `target`."""
    forward = np.subtract(target, eye, dtype=float)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = eye
    return T
