"""Closed-form derivative of M with respect to the joint speeds; the other half of M_dot, along q and the people, is
numeric.

n, C, H and the nearest points do not depend on dq, and drift and h are quadratic in it, so no differences are needed:

    d drift / d dq_j = 2 n . Jdot_j + 2 (w_dot . J_j - d_dot C_j) / D - 2 b^T A^-1 db_j / D
    d h_i  / d dq_j  = sum_k 2 m_k Jv_ki . Jvdot_kj + z_i . (I_k dalpha_kj + z_j x I_k omega_k + omega_k x I_k z_j)

(linear acceleration is integrable: sum_i d2p/dq_i dq_j dq_i counts twice; dalpha_kj = omega_{j-1} x z_j + z_j x
(omega_k - omega_j)). By the envelope theorem the maximum over U moves with its active bounds only: - y . dh for the
torque rows.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from asc_rt.core.abstraction import MIN_AXIS_DISTANCE, People, _nearest
from asc_rt.core.dynamics import Inertias, _apply, _world_inertia
from asc_rt.core.kinematics import Motion, Three, cross
from asc_rt.core.types import Vector


@njit(cache=True, inline="always")
def _dot(a: Three, b: Three) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True)
def _column_rates(motion: Motion, joint: int, point: Vector, velocity: Vector, J: Vector, J_dot: Vector) -> None:
    """Columns J_j = z_j x (p - o_j) and their rates of a point on the link of `joint`, both (n, 3), zero beyond it."""
    for j in range(J.shape[0]):
        J[j], J_dot[j] = 0.0, 0.0
        if j > joint:
            continue
        z = motion.axis[j]
        arm = point - motion.origin[j]
        J[j] = cross(z, arm)
        turned = np.array(cross(cross(motion.omega[j], z), arm))
        moved = cross(z, velocity - motion.velocity[j])
        for a in range(3):
            J_dot[j, a] = turned[a] + moved[a]


@njit(cache=True)
def drift_gradient(motion: Motion, joint: int, r0: Vector, r1: Vector, people: People, h: int) -> Vector:
    """d drift / d dq of one pair, (n,) 1/s; r0, r1: world end points of the robot capsule."""
    n = motion.origin.shape[0]
    h0, h1 = people.p0[h], people.p1[h]
    s, t = _nearest(r0, r1, h0, h1)
    e_r, e_h = r1 - r0, h1 - h0
    de_h = people.v1[h] - people.v0[h]
    point = r0 + s * e_r
    w = point - h0 - t * e_h
    D = max(np.sqrt(_dot(w, w)), MIN_AXIS_DISTANCE)
    omega = motion.omega[joint]
    velocity = motion.velocity[joint] + np.array(cross(omega, point - motion.origin[joint]))
    rate = velocity - people.v0[h] - t * de_h
    J, J_dot = np.empty((n, 3)), np.empty((n, 3))
    _column_rates(motion, joint, point, velocity, J, J_dot)
    d_dot = _dot(w, rate) / D
    b_s = _dot(e_r, rate) + _dot(w, cross(omega, e_r))
    b_t = -_dot(e_h, rate) - _dot(w, de_h)
    rr, hh, rh = _dot(e_r, e_r), _dot(e_h, e_h), _dot(e_r, e_h)
    s_free, t_free = 0.0 < s < 1.0 and rr > 1e-12, 0.0 < t < 1.0 and hh > 1e-12
    det = rr * hh - rh * rh
    both = s_free and t_free and det > 1e-4 * rr * hh
    only_s = s_free and not both and (not t_free or b_s * b_s * hh >= b_t * b_t * rr)
    only_t = t_free and not both and not only_s
    out = np.zeros(n)
    for j in range(joint + 1):
        C = _dot(w, J[j]) / D
        db_s = _dot(e_r, J[j]) + _dot(w, cross(motion.axis[j], e_r))
        db_t = -_dot(e_h, J[j])
        slip = 0.0
        if both:
            slip = (hh * b_s * db_s + rh * (b_s * db_t + b_t * db_s) + rr * b_t * db_t) / det
        elif only_s:
            slip = b_s * db_s / rr
        elif only_t:
            slip = b_t * db_t / hh
        out[j] = 2.0 * (_dot(w, J_dot[j]) + _dot(rate, J[j]) - d_dot * C - slip) / D
    return out


@njit(cache=True)
def bias_gradient(motion: Motion, bodies: Inertias, y: Vector) -> Vector:
    """d (y . h) / d dq, (n,) for multipliers y, (n,)."""
    n = y.shape[0]
    out = np.zeros(n)
    half, world = np.empty((3, 3)), np.empty((3, 3))
    J, J_dot = np.empty((n, 3)), np.empty((n, 3))
    for k in range(n):
        omega = motion.omega[k]
        lever = np.array(_apply(motion.rotation[k], bodies.com[k]))
        com = motion.origin[k] + lever
        velocity = motion.velocity[k] + np.array(cross(omega, lever))
        _column_rates(motion, k, com, velocity, J, J_dot)
        _world_inertia(motion.rotation[k], bodies.inertia[k], half, world)
        spin = np.array(_apply(world, omega))
        linear, angular = np.zeros(3), np.zeros(3)
        for i in range(k + 1):
            for a in range(3):
                linear[a] += y[i] * J[i, a]
                angular[a] += y[i] * motion.axis[i, a]
        for j in range(k + 1):
            z = motion.axis[j]
            turned, relative = cross(motion.omega[j], z), cross(z, omega - motion.omega[j])
            alpha = np.array((turned[0] + relative[0], turned[1] + relative[1], turned[2] + relative[2]))
            gyro_a, gyro_b = cross(z, spin), cross(omega, _apply(world, z))
            out[j] += 2.0 * bodies.mass[k] * _dot(linear, J_dot[j])
            out[j] += _dot(angular, _apply(world, alpha)) + _dot(angular, gyro_a) + _dot(angular, gyro_b)
    return out
