"""Joint-space inertia and bias force of a serial chain, in the world frame of `kinematics.Motion`; compiled.

tau = H(q) ddq + h(q, dq)        h: centrifugal, Coriolis and gravity forces

H_ij = sum_k m_k Jv_ki . Jv_kj + z_i . I_k z_j      Jv_ki = z_i x (c_k - o_i), links k >= i, j
h_i  = sum_k Jv_ki . m_k (a_k - g) + z_i . (I_k alpha_k + omega_k x I_k omega_k)     at ddq = 0
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from asc_rt.core.kinematics import Motion, cross, rotated
from asc_rt.core.types import Matrix, Vector

GRAVITY = 9.81  # m/s2, along -z of the base frame


class Inertias(NamedTuple):
    """Bodies carried by the n joints, each in its joint's frame."""

    mass: np.ndarray  # (n,) kg
    com: np.ndarray  # (n, 3) m
    inertia: np.ndarray  # (n, 3, 3) kg m2, about the com


@njit(cache=True)
def _world_inertia(rotation: Matrix, inertia: Matrix, half: Matrix, out: Matrix) -> None:
    """rotation inertia rotation^T, in plain loops: a BLAS call costs more than the 54 products and has bits of its
    own."""
    for a in range(3):
        for b in range(3):
            half[a, b] = (
                rotation[a, 0] * inertia[0, b] + rotation[a, 1] * inertia[1, b] + rotation[a, 2] * inertia[2, b]
            )
    for a in range(3):
        for b in range(3):
            out[a, b] = half[a, 0] * rotation[b, 0] + half[a, 1] * rotation[b, 1] + half[a, 2] * rotation[b, 2]


@njit(cache=True)
def inertia_and_bias(motion: Motion, bodies: Inertias) -> tuple[Matrix, Vector]:
    """(H, h)."""
    n = motion.origin.shape[0]
    H, h = np.zeros((n, n)), np.zeros(n)
    Jv, arm = np.empty((n, 3)), np.empty(3)
    half, world = np.empty((3, 3)), np.empty((3, 3))
    for k in range(n):
        omega, alpha, m = motion.omega[k], motion.alpha[k], bodies.mass[k]
        lever = rotated(motion.rotation[k], bodies.com[k])
        spin = cross(omega, lever)
        centripetal, tangential = cross(omega, spin), cross(alpha, lever)
        _world_inertia(motion.rotation[k], bodies.inertia[k], half, world)
        gyro, torque = cross(omega, rotated(world, omega)), rotated(world, alpha)
        for i in range(k + 1):
            z = motion.axis[i]
            for a in range(3):
                arm[a] = motion.origin[k, a] + lever[a] - motion.origin[i, a]
            column, turned = cross(z, arm), rotated(world, z)
            for a in range(3):
                Jv[i, a] = column[a]
                gravity = GRAVITY if a == 2 else 0.0
                force = m * (motion.acceleration[k, a] + tangential[a] + centripetal[a] + gravity)
                h[i] += Jv[i, a] * force + z[a] * (torque[a] + gyro[a])
            for j in range(i + 1):
                for a in range(3):
                    H[i, j] += m * Jv[i, a] * Jv[j, a] + motion.axis[j, a] * turned[a]
    for i in range(n):
        for j in range(i):
            H[j, i] = H[i, j]
    return H, h


@njit(cache=True)
def inverse(H: Matrix) -> Matrix:
    """H^-1 of a symmetric positive definite matrix by Cholesky; only + - * / sqrt, so that the bits do not depend on
    BLAS."""
    n = H.shape[0]
    L = np.zeros((n, n))
    for i in range(n):
        for j in range(i + 1):
            value = H[i, j]
            for k in range(j):
                value -= L[i, k] * L[j, k]
            if i == j:
                L[i, i] = np.sqrt(value)
            else:
                L[i, j] = value / L[j, j]
    X = np.zeros((n, n))  # L^-1
    for c in range(n):
        for i in range(c, n):
            value = 1.0 if i == c else 0.0
            for k in range(c, i):
                value -= L[i, k] * X[k, c]
            X[i, c] = value / L[i, i]
    out = np.zeros((n, n))
    for i in range(n):
        for j in range(i + 1):
            for k in range(i, n):
                out[i, j] += X[k, i] * X[k, j]
            out[j, i] = out[i, j]
    return out
