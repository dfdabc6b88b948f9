"""From URDF and tool to the model: what it takes over, and what it refuses."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from asc_rt.core.kinematics import forward
from asc_rt.core.params import CapsuleSpec, ToolParams
from asc_rt.core.robot_model import ModelError, load

TOOL = ToolParams("block", 2.0, (0.1, 0.02, -0.03), (0.01, 0.001, 0.002, 0.02, 0.003, 0.03), ())


def test_tool_mass_centre_and_inertia_join_the_last_link(bench: Any) -> None:
    robot = bench.params().robot
    bare = load(robot, replace(TOOL, mass=0.0)).pin_model
    held = load(robot, TOOL).pin_model
    flange = bare.frames[bare.getFrameId("flange", pin.BODY)].placement
    a, b = bare.inertias[6], held.inertias[6]
    com = flange.act(np.array(TOOL.com))
    assert b.mass == pytest.approx(a.mass + 2.0)
    np.testing.assert_allclose(b.mass * b.lever, a.mass * a.lever + 2.0 * com)
    xx, xy, xz, yy, yz, zz = TOOL.inertia
    about_com = flange.rotation @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ flange.rotation.T

    def about_origin(inertia: Any, mass: float, lever: Any) -> Any:
        return inertia + mass * (lever @ lever * np.eye(3) - np.outer(lever, lever))

    expected = about_origin(a.inertia, a.mass, a.lever) + about_origin(about_com, 2.0, com)
    np.testing.assert_allclose(about_origin(b.inertia, b.mass, b.lever), expected, atol=1e-12)


def test_massless_tool_changes_no_inertia(bench: Any) -> None:
    robot = bench.params().robot
    bare = load(robot, replace(TOOL, mass=0.0)).pin_model
    full = pin.buildModelFromXML(robot.urdf)
    assert bare.inertias[6].isApprox(full.inertias[6])


def test_capsules_stand_where_the_figures_say(bench: Any) -> None:
    system = bench.system()
    model = system.model
    assert len(model.capsules.radius) == len(model.capsule_names) == 9
    for q in np.random.default_rng(0).uniform(-2.0, 2.0, (20, 6)):
        motion = forward(model.chain, q, np.zeros(6))
        for i, (joint, p0, p1, radius) in enumerate(bench.robot_capsules(system, q)):
            assert (model.capsules.joint[i], model.capsules.radius[i]) == (joint, radius)
            for local, world in ((model.capsules.p0[i], p0), (model.capsules.p1[i], p1)):
                ours = local if joint < 0 else motion.origin[joint] + motion.rotation[joint] @ local
                np.testing.assert_allclose(ours, world, atol=1e-10)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"urdf": "<robot"}, "URDF"),
        ({"urdf": ""}, "URDF"),
        ({"urdf": "<robot name='x'/>"}, "URDF"),
        ({"joints": ("J1", "J2", "J3", "J4", "J5", "J9")}, "J9"),
        ({"joints": ("J2", "J1", "J3", "J4", "J5", "J6")}, "order"),
        ({"flange": "elsewhere"}, "elsewhere"),
        ({"capsules": (CapsuleSpec("elbow", (0, 0, 0), (0, 0, 1), 0.1),)}, "elbow"),
    ],
)
def test_descriptions_that_do_not_fit_are_model_errors(bench: Any, changes: dict[str, Any], says: str) -> None:
    with pytest.raises(ModelError, match=says):
        load(replace(bench.params().robot, **changes), TOOL)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('type="revolute"', 'type="prismatic"'),
        ('type="revolute"', 'type="continuous"'),
        ('<mass value="1"/>', '<mass value="0"/>'),
        ('izz=".1"', 'izz="0"'),
    ],
)
def test_joints_that_do_not_turn_and_links_without_inertia_are_model_errors(bench: Any, old: str, new: str) -> None:
    params = bench.skew_arm()
    with pytest.raises(ModelError):
        load(replace(params.robot, urdf=params.robot.urdf.replace(old, new)), params.tool)


def test_a_branched_arm_is_a_model_error(bench: Any) -> None:
    params = bench.skew_arm()
    branched = params.robot.urdf.replace('<parent link="l4"/>', '<parent link="l2"/>')
    with pytest.raises(ModelError, match="serial|in order"):
        load(replace(params.robot, urdf=branched), params.tool)
