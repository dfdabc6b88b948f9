"""Serial-chain kinematics as a compiled kernel; verified against Pinocchio, which stays the model loader and the
oracle.

A plain Pinocchio call per link and per perturbation costs 6-10 times as much from Python. No fast-math: the bits must
not depend on how LLVM felt that day.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from asc_rt.core.types import Matrix, Vector

Three = Vector | tuple[float, float, float]  # a 3-vector in a kernel


class Chain(NamedTuple):
    """n revolute joints in series."""

    rotation: np.ndarray  # (n, 3, 3) parent joint frame -> this joint frame at q = 0
    offset: np.ndarray  # (n, 3) m, origin of this joint in the parent joint frame
    axis: np.ndarray  # (n, 3) unit, in the joint frame


class Motion(NamedTuple):
    """World placement, velocity and *bias* acceleration (at zero joint acceleration) of every joint frame."""

    rotation: np.ndarray  # (n, 3, 3)
    origin: np.ndarray  # (n, 3) m
    axis: np.ndarray  # (n, 3) unit, world
    omega: np.ndarray  # (n, 3) rad/s
    velocity: np.ndarray  # (n, 3) m/s, of the origin
    alpha: np.ndarray  # (n, 3) rad/s2
    acceleration: np.ndarray  # (n, 3) m/s2, of the origin


@njit(cache=True)
def cross(a: Three, b: Three) -> tuple[float, float, float]:
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


@njit(cache=True)
def dot(a: Three, b: Three) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True)
def plus(a: Three, s: float, b: Three) -> tuple[float, float, float]:
    """a + s b"""
    return a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]


@njit(cache=True)
def rotated(m: Matrix, v: Three) -> tuple[float, float, float]:
    """m v"""
    return (
        m[0, 0] * v[0] + m[0, 1] * v[1] + m[0, 2] * v[2],
        m[1, 0] * v[0] + m[1, 1] * v[1] + m[1, 2] * v[2],
        m[2, 0] * v[0] + m[2, 1] * v[1] + m[2, 2] * v[2],
    )


@njit(cache=True)
def _rotate_about(axis: Vector, angle: float, out: Matrix) -> None:
    """Rodrigues' formula."""
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = axis
    t = 1.0 - c
    out[0, 0], out[0, 1], out[0, 2] = (
        t * x * x + c,
        t * x * y - s * z,
        t * x * z + s * y,
    )
    out[1, 0], out[1, 1], out[1, 2] = (
        t * x * y + s * z,
        t * y * y + c,
        t * y * z - s * x,
    )
    out[2, 0], out[2, 1], out[2, 2] = (
        t * x * z - s * y,
        t * y * z + s * x,
        t * z * z + c,
    )


@njit(cache=True)
def _multiply(a: Matrix, b: Matrix, out: Matrix) -> None:
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@njit(cache=True)
def forward(chain: Chain, q: Vector, dq: Vector) -> Motion:
    """Outward recursion: w_i = w_{i-1} + z_i dq_i; a_i = a_{i-1} + alpha x r + w x (w x r)."""
    n = q.shape[0]
    motion = Motion(
        np.empty((n, 3, 3)),
        np.empty((n, 3)),
        np.empty((n, 3)),
        np.empty((n, 3)),
        np.empty((n, 3)),
        np.empty((n, 3)),
        np.empty((n, 3)),
    )
    local, fixed = np.empty((3, 3)), np.empty((3, 3))
    parent_rotation = np.eye(3)
    r = np.empty(3)
    zero = np.zeros(3)
    origin, omega, velocity, alpha, acceleration = zero, zero, zero, zero, zero
    for i in range(n):
        _rotate_about(chain.axis[i], q[i], local)
        _multiply(parent_rotation, chain.rotation[i], fixed)
        for k in range(3):
            r[k] = (
                parent_rotation[k, 0] * chain.offset[i, 0]
                + parent_rotation[k, 1] * chain.offset[i, 1]
                + parent_rotation[k, 2] * chain.offset[i, 2]
            )
        _multiply(fixed, local, motion.rotation[i])
        wr = cross(omega, r)
        ar = cross(alpha, r)
        for k in range(3):
            motion.origin[i, k] = origin[k] + r[k]
            motion.velocity[i, k] = velocity[k] + wr[k]
            motion.axis[i, k] = (
                motion.rotation[i, k, 0] * chain.axis[i, 0]
                + motion.rotation[i, k, 1] * chain.axis[i, 1]
                + motion.rotation[i, k, 2] * chain.axis[i, 2]
            )
        z = motion.axis[i]
        wz = cross(omega, z)
        wwr_x = omega[1] * wr[2] - omega[2] * wr[1]
        wwr_y = omega[2] * wr[0] - omega[0] * wr[2]
        wwr_z = omega[0] * wr[1] - omega[1] * wr[0]
        motion.acceleration[i, 0] = acceleration[0] + ar[0] + wwr_x
        motion.acceleration[i, 1] = acceleration[1] + ar[1] + wwr_y
        motion.acceleration[i, 2] = acceleration[2] + ar[2] + wwr_z
        for k in range(3):
            motion.alpha[i, k] = alpha[k] + wz[k] * dq[i]
            motion.omega[i, k] = omega[k] + z[k] * dq[i]
        parent_rotation = motion.rotation[i]
        origin, omega, velocity = motion.origin[i], motion.omega[i], motion.velocity[i]
        alpha, acceleration = motion.alpha[i], motion.acceleration[i]
    return motion
