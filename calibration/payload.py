"""Mass and centre of mass of what the flange carries, from the torques that hold the arm still.

tau_i - tau_empty,i = Y(q_i) (m, m c) + b with Y = J^T [[g, 0], [0, -[g]x]], J the flange's Jacobian and g = R^T (0 0
9.81) the pull of gravity upwards, both in the flange's frame; b is one bias per joint (friction, sensor drift), without
which the centre of mass is centimetres wrong. Inertia cannot be seen at rest.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from asc_rt.core.params import RobotParams, ToolParams
from asc_rt.core.robot_model import load
from calibration.geometry import skew
from calibration.result import CalibrationError, Result, rows

GRAVITY = 9.81  # m/s2
LEAST_POSES = 6
MOST_CONDITION = 200.0  # of the equations with unit columns; ASSUMED: degenerate sets are above 1e6
MOST_LEVER = 0.5  # m from the flange; more is a wrong unit


def calibrate(robot: RobotParams, q: np.ndarray, tau: np.ndarray, empty: np.ndarray | None = None) -> Result:
    """Payload in the flange's frame from (n, dof) rad and Nm at rest; `empty`: the same poses without it.

    Without `empty` the robot's model stands for it. CalibrationError: shapes, too few poses.
    """
    if (
        q.shape != tau.shape
        or q.ndim != 2
        or q.shape[1] != len(robot.joints)
        or (empty is not None and empty.shape != q.shape)
    ):
        raise CalibrationError([f"q, tau: shapes {q.shape} and {tau.shape}; both must be (n, {len(robot.joints)})"])
    if len(q) < LEAST_POSES:
        raise CalibrationError([f"poses: {len(q)} are too few; at least {LEAST_POSES}"])
    Y, bare = regressor(robot, q)
    n, dof = q.shape
    H = np.concatenate([Y.reshape(-1, 4), np.tile(np.eye(dof), (n, 1))], 1)
    h = (tau - (bare if empty is None else empty)).ravel()
    scale = np.linalg.norm(H, axis=0)
    condition = float(np.linalg.cond(H / np.where(scale > 0, scale, 1.0)))
    x = np.linalg.lstsq(H, h, rcond=None)[0]
    r = h - H @ x
    freedom = r.size - x.size
    variance = float(r @ r) / freedom
    C = variance * np.linalg.pinv(H.T @ H)[:4, :4] + 1e-18 * np.eye(4)
    mass, com = float(x[0]), x[1:4] / x[0]
    J = np.block([[np.ones((1, 1)), np.zeros((1, 3))], [-com[:, None] / mass, np.eye(3) / mass]])
    covariance = J @ C @ J.T
    quality = {"poses": n, "rms": float(np.sqrt(variance)), "condition": condition, "bias": [float(v) for v in x[4:]]}
    return Result(
        "payload", "flange", (mass, *(float(v) for v in com)), rows(covariance), "static torques with joint bias",
        quality=quality, reasons=tuple(_reasons(mass, com, np.sqrt(np.diag(covariance)), condition)),
    )  # fmt: skip


def regressor(robot: RobotParams, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, dof, 4) Y of (m, m c), and (n, dof) Nm of the bare arm."""
    model = load(robot, ToolParams("none", 0.0, (0.0,) * 3, (0.0,) * 6, ())).pin_model
    data, frame = model.createData(), model.getFrameId(robot.flange, pin.BODY)
    Y, bare = np.zeros((*q.shape, 4)), np.zeros(q.shape)
    for i, pose in enumerate(q):
        J = pin.computeFrameJacobian(model, data, pose, frame, pin.LOCAL)
        pin.framesForwardKinematics(model, data, pose)
        g = data.oMf[frame].rotation.T @ [0.0, 0.0, GRAVITY]
        Y[i, :, 0], Y[i, :, 1:] = J[:3].T @ g, -J[3:].T @ skew(g)
        bare[i] = pin.computeGeneralizedGravity(model, data, pose)
    return Y, bare


def flange_poses(robot: RobotParams, q: np.ndarray) -> np.ndarray:
    """(n, 4, 4) T_base_flange of (n, dof) rad."""
    model = load(robot, ToolParams("none", 0.0, (0.0,) * 3, (0.0,) * 6, ())).pin_model
    data, frame = model.createData(), model.getFrameId(robot.flange, pin.BODY)
    T = np.zeros((len(q), 4, 4))
    for i, angles in enumerate(q):
        pin.framesForwardKinematics(model, data, angles)
        T[i] = data.oMf[frame].homogeneous
    return T


def unexplained(
    robot: RobotParams, q: np.ndarray, tau: np.ndarray, empty: np.ndarray | None, load: Result
) -> np.ndarray:
    """(n, dof) Nm that neither the payload of the result nor its biases explain."""
    Y, bare = regressor(robot, q)
    mass, *com = load.value
    said = Y @ np.array([mass, *(mass * np.array(com))]) + np.array(load.quality["bias"])
    return np.asarray(tau - (bare if empty is None else empty) - said)


def _reasons(mass: float, com: np.ndarray, sigma: np.ndarray, condition: float) -> list[str]:
    reasons = []
    if condition > MOST_CONDITION:
        reasons.append(f"condition {condition:.3g} is above {MOST_CONDITION:g}: hold the wrist in more directions")
    if mass < 3 * sigma[0]:
        reasons.append(f"mass {mass:.3g} +- {sigma[0]:.2g} kg is not there, or the sign of the torques is turned")
    elif max(sigma[1:]) > 0.05:
        reasons.append(f"the centre of mass is known to {1e3 * max(sigma[1:]):.0f} mm only; at most 50")
    if np.linalg.norm(com) > MOST_LEVER:
        reasons.append(
            f"the centre of mass is {np.linalg.norm(com):.3g} m away; angles are rad, torques Nm, of one arm"
        )
    return reasons


def tool_lines(result: Result) -> str:
    """For the tool's TOML file."""
    mass, *com = result.value
    return f"mass_kg = {mass:.4f}\ncom = [{', '.join(f'{v:.4f}' for v in com)}]\n"
