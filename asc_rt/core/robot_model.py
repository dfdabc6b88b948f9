"""From URDF text and tool to the arrays that the kernels read. Pinocchio parses, checks and extracts; it runs no
cycle."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numba import njit

from asc_rt.core.dynamics import Inertias
from asc_rt.core.kinematics import Chain
from asc_rt.core.limits import Bounds
from asc_rt.core.params import CapsuleSpec, RobotParams, ToolParams
from asc_rt.core.types import Vector, vector


class ModelError(Exception):
    """The robot description does not fit: says what and where."""


class Capsules(NamedTuple):
    """m capsules fixed to the robot."""

    joint: np.ndarray  # (m,) index of the joint that carries it; -1: the base, which no control moves
    p0: np.ndarray  # (m, 3) m, in that joint's frame (base: base frame)
    p1: np.ndarray  # (m, 3) m
    radius: np.ndarray  # (m,) m


class Arm(NamedTuple):
    """What the kernels know of the arm with its tool."""

    chain: Chain
    capsules: Capsules
    bodies: Inertias
    bounds: Bounds
    effort: np.ndarray  # (n,) Nm, torque limits; (0,): the arm takes positions and its torque is its own affair


class RobotModel(NamedTuple):
    pin_model: pin.Model  # the controlled joints only; tests compare against it
    arm: Arm
    packed: Vector  # see `pack`
    capsule_names: tuple[str, ...]

    @property
    def chain(self) -> Chain:
        return self.arm.chain

    @property
    def capsules(self) -> Capsules:
        return self.arm.capsules


def load(robot: RobotParams, tool: ToolParams, control: str = "acceleration") -> RobotModel:
    """Model of the arm with its tool, all joints but `robot.joints` locked at zero.

    Raises ModelError: unparsable URDF, unknown joint or link, joints that are not revolute or not in series,
    a moving link without inertia.
    """
    try:
        full = pin.buildModelFromXML(robot.urdf)
    except Exception as error:  # Pinocchio raises bare RuntimeError/ValueError on a bad URDF
        raise ModelError(f"robot {robot.name}: the URDF cannot be read: {error}") from error
    missing = [name for name in robot.joints if not full.existJointName(name)]
    if missing:
        raise ModelError(f"robot {robot.name}: no joint {', '.join(missing)} in the URDF")
    locked = [full.getJointId(name) for name in full.names[1:] if name not in robot.joints]
    model = pin.buildReducedModel(full, locked, pin.neutral(full))
    if tuple(model.names)[1:] != robot.joints or model.nq != len(robot.joints):
        raise ModelError(f"robot {robot.name}: joints must be revolute, in order from the base: {robot.joints}")
    if any(not model.joints[i].shortname().startswith("JointModelR") for i in range(1, model.njoints)):
        raise ModelError(f"robot {robot.name}: joints must be revolute; a sliding one is among {robot.joints}")
    if any(int(parent) != i for i, parent in enumerate(model.parents[1:])):
        raise ModelError(f"robot {robot.name}: the joints do not form one serial chain")
    flange = _frame(model, robot.flange)
    _add_tool(model, flange, tool)
    for i in range(1, model.njoints):
        inertia = model.inertias[i]
        if inertia.mass <= 0.0 or np.linalg.eigvalsh(inertia.inertia).min() <= 0.0:
            raise ModelError(f"robot {robot.name}: the link moved by {model.names[i]} has no mass or inertia")
    effort = np.array(robot.effort if control == "torque" else ())
    if control == "torque" and len(effort) != model.nv:
        raise ModelError(f"robot {robot.name}: torque control needs a torque limit (effort) for every joint")
    specs = (*robot.capsules, *tool.capsules)
    arm = Arm(_chain(model), _capsules(model, specs), _bodies(model), _bounds(robot), effort)
    return RobotModel(
        pin_model=model,
        arm=arm,
        packed=pack(arm),
        capsule_names=tuple(
            [f"{c.link}.{i}" for i, c in enumerate(robot.capsules)]
            + [f"{tool.name}.{i}" for i in range(len(tool.capsules))]
        ),
    )


def pack(arm: Arm) -> Vector:
    """An Arm in one array: a tuple of arrays that Python hands to a kernel costs two microseconds.

    n joints, m capsules, the capsules' joints, then the arrays one after the other.
    """
    c, k, b = arm.chain, arm.capsules, arm.bodies
    sizes = (len(b.mass), len(k.radius))
    return vector(np.concatenate([np.ravel(a) for a in (sizes, k.joint, *c, *k[1:], *b, *arm.bounds, arm.effort)]))


@njit(cache=True)
def unpack(packed: Vector) -> Arm:
    """Inverse of `pack`: views, but for the capsules' joints."""
    n, m = int(packed[0]), int(packed[1])
    joints, x = packed[2 : 2 + m].astype(np.int64), packed[2 + m :]
    p0 = 15 * n  # after the chain
    mass = p0 + 7 * m
    q_min = mass + 13 * n
    return Arm(
        Chain(x[: 9 * n].reshape(n, 3, 3), x[9 * n : 12 * n].reshape(n, 3), x[12 * n : p0].reshape(n, 3)),
        Capsules(
            joints,
            x[p0 : p0 + 3 * m].reshape(m, 3),
            x[p0 + 3 * m : p0 + 6 * m].reshape(m, 3),
            x[p0 + 6 * m : mass],
        ),
        Inertias(
            x[mass : mass + n], x[mass + n : mass + 4 * n].reshape(n, 3), x[mass + 4 * n : q_min].reshape(n, 3, 3)
        ),
        Bounds(
            x[q_min : q_min + n],
            x[q_min + n : q_min + 2 * n],
            x[q_min + 2 * n : q_min + 3 * n],
            x[q_min + 3 * n : q_min + 4 * n],
            x[q_min + 4 * n : q_min + 5 * n],
        ),
        x[q_min + 5 * n :],
    )


def _frame(model: pin.Model, name: str) -> pin.Frame:
    if not model.existFrame(name, pin.BODY):
        raise ModelError(f"no link {name} in the URDF")
    return model.frames[model.getFrameId(name, pin.BODY)]


def _add_tool(model: pin.Model, flange: pin.Frame, tool: ToolParams) -> None:
    if tool.mass <= 0.0:
        return
    xx, xy, xz, yy, yz, zz = tool.inertia
    matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    body = pin.Inertia(tool.mass, np.array(tool.com), matrix)
    model.appendBodyToJoint(flange.parentJoint, body, flange.placement)


def _chain(model: pin.Model) -> Chain:
    data = model.createData()
    pin.computeJointJacobians(model, data, pin.neutral(model))
    axes = [pin.getJointJacobian(model, data, i, pin.LOCAL)[3:, i - 1] for i in range(1, model.njoints)]
    placements = [model.jointPlacements[i] for i in range(1, model.njoints)]
    return Chain(
        rotation=np.ascontiguousarray([p.rotation for p in placements]),
        offset=np.ascontiguousarray([p.translation for p in placements]),
        axis=np.ascontiguousarray(axes),
    )


def _bodies(model: pin.Model) -> Inertias:
    bodies = [model.inertias[i] for i in range(1, model.njoints)]
    return Inertias(
        mass=np.array([b.mass for b in bodies]),
        com=np.array([b.lever for b in bodies]),
        inertia=np.ascontiguousarray([b.inertia for b in bodies]),
    )


def _bounds(robot: RobotParams) -> Bounds:
    return Bounds(*(np.array(v) for v in (robot.q_min, robot.q_max, robot.dq_max, robot.ddq_max, robot.dddq_max)))


def _capsules(model: pin.Model, specs: tuple[CapsuleSpec, ...]) -> Capsules:
    frames = [_frame(model, spec.link) for spec in specs]
    ends = [
        (f.placement.act(np.array(s.p0)), f.placement.act(np.array(s.p1))) for f, s in zip(frames, specs, strict=True)
    ]
    return Capsules(
        joint=np.array([f.parentJoint - 1 for f in frames], dtype=np.int64),
        p0=np.array([e[0] for e in ends]).reshape(-1, 3),
        p1=np.array([e[1] for e in ends]).reshape(-1, 3),
        radius=np.array([s.radius for s in specs]),
    )
