"""Closed-form derivative of M with respect to the joint speeds; the other half of M_dot, along q and the people, is
numeric.

n, C, H and the nearest points do not depend on dq, and drift and h are quadratic in it, so no differences are needed:

    d drift / d dq_j = 2 n . Jdot_j + 2 (w_dot . J_j - d_dot C_j) / D - 2 b^T A^-1 db_j / D
    d h_i  / d dq_j  = sum_k 2 m_k Jv_ki . Jvdot_kj + z_i . (I_k dalpha_kj + z_j x I_k omega_k + omega_k x I_k z_j)

(linear acceleration is integrable: sum_i d2p/dq_i dq_j dq_i counts twice; dalpha_kj = omega_{j-1} x z_j + z_j x
(omega_k - omega_j)). By the envelope theorem the maximum over U moves with its active bounds only (multipliers y):

    d max / d dq = - y_rows . dh / d dq + y_box d bound / d dq        d bound / d dq = -J / A in a braking zone, else 0
"""

from __future__ import annotations

import numpy as np
from numba import njit

from asc_rt.core.abstraction import MIN_AXIS_DISTANCE, People, nearest
from asc_rt.core.dynamics import Inertias, _world_inertia
from asc_rt.core.kinematics import Motion, cross, dot, plus, rotated
from asc_rt.core.limits import Bounds
from asc_rt.core.robot_model import Arm
from asc_rt.core.types import Vector


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
    s, t = nearest(r0, r1, h0, h1)
    e_r, e_h = r1 - r0, h1 - h0
    de_h = people.v1[h] - people.v0[h]
    point = r0 + s * e_r
    w = point - h0 - t * e_h
    D = max(np.sqrt(dot(w, w)), MIN_AXIS_DISTANCE)
    omega = motion.omega[joint]
    velocity = motion.velocity[joint] + np.array(cross(omega, point - motion.origin[joint]))
    rate = velocity - people.v0[h] - t * de_h
    J, J_dot = np.empty((n, 3)), np.empty((n, 3))
    _column_rates(motion, joint, point, velocity, J, J_dot)
    d_dot = dot(w, rate) / D
    b_s = dot(e_r, rate) + dot(w, cross(omega, e_r))
    b_t = -dot(e_h, rate) - dot(w, de_h)
    rr, hh, rh = dot(e_r, e_r), dot(e_h, e_h), dot(e_r, e_h)
    s_free, t_free = 0.0 < s < 1.0 and rr > 1e-12, 0.0 < t < 1.0 and hh > 1e-12
    det = rr * hh - rh * rh
    both = s_free and t_free and det > 1e-4 * rr * hh
    only_s = s_free and not both and (not t_free or b_s * b_s * hh >= b_t * b_t * rr)
    only_t = t_free and not both and not only_s
    out = np.zeros(n)
    for j in range(joint + 1):
        C = dot(w, J[j]) / D
        db_s = dot(e_r, J[j]) + dot(w, cross(motion.axis[j], e_r))
        db_t = -dot(e_h, J[j])
        slip = 0.0
        if both:
            slip = (hh * b_s * db_s + rh * (b_s * db_t + b_t * db_s) + rr * b_t * db_t) / det
        elif only_s:
            slip = b_s * db_s / rr
        elif only_t:
            slip = b_t * db_t / hh
        out[j] = 2.0 * (dot(w, J_dot[j]) + dot(rate, J[j]) - d_dot * C - slip) / D
    return out


@njit(cache=True)
def bias_gradient(motion: Motion, bodies: Inertias, y: Vector) -> Vector:
    """d (y . h) / d dq, (n,) for multipliers y, (n,).

    In time proportional to n: y is taken through the chain as a joint speed, which gives every body a velocity u of its
    com and an angular velocity a; what a joint j contributes to the bodies k >= j is then a sum over them:

        d (y . h) / d dq_j = (w_j x z_j) . sum_k (2 m (c_k - o_j) x u + 2 I a)
                           + z_j . sum_k (2 m (v_k - v_j) x u + w_k x I a + I w_k x a + I (a x w_k))
    """
    n = y.shape[0]
    out, half, world = np.zeros(n), np.empty((3, 3)), np.empty((3, 3))
    u, a = np.empty((n, 3)), np.empty((n, 3))
    turn, shift = np.zeros(3), np.zeros(3)
    for k in range(n):
        lever, moment = rotated(motion.rotation[k], bodies.com[k]), cross(motion.axis[k], motion.origin[k])
        for x in range(3):
            turn[x] += y[k] * motion.axis[k, x]
            shift[x] += y[k] * moment[x]
        velocity = cross(turn, plus(motion.origin[k], 1.0, lever))
        for x in range(3):
            a[k, x], u[k, x] = turn[x], velocity[x] - shift[x]
    first, push, second = np.zeros(3), np.zeros(3), np.zeros(3)
    for k in range(n - 1, -1, -1):
        omega, m2 = motion.omega[k], 2.0 * bodies.mass[k]
        _world_inertia(motion.rotation[k], bodies.inertia[k], half, world)
        lever = rotated(motion.rotation[k], bodies.com[k])
        turned = rotated(world, a[k])
        about_com, by_speed = (
            cross(plus(motion.origin[k], 1.0, lever), u[k]),
            cross(plus(motion.velocity[k], 1.0, cross(omega, lever)), u[k]),
        )
        gyro_a, gyro_b = cross(omega, turned), cross(rotated(world, omega), a[k])
        gyro_c = rotated(world, cross(a[k], omega))
        for x in range(3):
            push[x] += m2 * u[k, x]
            first[x] += m2 * about_com[x] + 2.0 * turned[x]
            second[x] += m2 * by_speed[x] + gyro_a[x] + gyro_b[x] + gyro_c[x]
        swing = cross(omega, motion.axis[k])
        at_origin, at_speed = cross(motion.origin[k], push), cross(motion.velocity[k], push)
        for x in range(3):
            out[k] += swing[x] * (first[x] - at_origin[x]) + motion.axis[k, x] * (second[x] - at_speed[x])
    return out


@njit(cache=True)
def box_gradient(bounds: Bounds, lower: Vector, upper: Vector, y: Vector) -> Vector:
    """d (y . active bound) / d dq of `limits.acceleration_box`, (n,): each bound depends on its own joint's speed."""
    out = np.zeros(lower.shape[0])
    for i in range(out.shape[0]):
        A = bounds.ddq_max[i]
        bound = upper[i] if y[i] > 0.0 else lower[i]
        if -A < bound < A:
            out[i] = -y[i] * bounds.dddq_max[i] / A
    return out


@njit(cache=True)
def support_gradient(arm: Arm, motion: Motion, lower: Vector, upper: Vector, y: Vector) -> Vector:
    """d (max over U of c . u) / d dq at fixed c, (n,), by its multipliers y = (box, torque rows)."""
    n = lower.shape[0]
    out = box_gradient(arm.bounds, lower, upper, y[:n])
    if y.shape[0] > n:
        out -= bias_gradient(motion, arm.bodies, y[n:])
    return out
