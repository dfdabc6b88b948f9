"""From URDF text and tool to the arrays that the kernels read. Pinocchio parses, checks and extracts; it runs no
cycle."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pinocchio as pin

from asc_rt.core.kinematics import Chain
from asc_rt.core.params import CapsuleSpec, RobotParams, ToolParams


class ModelError(Exception):
    """The robot description does not fit: says what and where."""


class Capsules(NamedTuple):
    """m capsules fixed to the robot."""

    joint: np.ndarray  # (m,) index of the joint that carries it; -1: the base, which no control moves
    p0: np.ndarray  # (m, 3) m, in that joint's frame (base: base frame)
    p1: np.ndarray  # (m, 3) m
    radius: np.ndarray  # (m,) m


class RobotModel(NamedTuple):
    pin_model: pin.Model  # the controlled joints only; tests compare against it
    chain: Chain
    capsules: Capsules
    capsule_names: tuple[str, ...]


def load(robot: RobotParams, tool: ToolParams) -> RobotModel:
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
    specs = (*robot.capsules, *tool.capsules)
    return RobotModel(
        pin_model=model,
        chain=_chain(model),
        capsules=_capsules(model, specs),
        capsule_names=tuple(
            [f"{c.link}.{i}" for i, c in enumerate(robot.capsules)]
            + [f"{tool.name}.{i}" for i in range(len(tool.capsules))]
        ),
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
