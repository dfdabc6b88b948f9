"""The arm and tool data against published figures and against physics."""

from __future__ import annotations

import math
import tomllib
import xml.etree.ElementTree as ET
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio
import pytest
from numpy.typing import NDArray

Array = NDArray[np.float64]

ROBOTS = Path(__file__).parents[2] / "asc_rt" / "robots"
ARMS = sorted(path.parent.name for path in ROBOTS.glob("*/profile.toml"))
TOOLS = sorted((ROBOTS / "tools").glob("*.toml"))
PANDAS = ("panda", "panda_6dof", "panda_5dof", "panda_ee3")

READY = np.array([0, -math.pi / 4, 0, -3 * math.pi / 4, 0, math.pi / 2, math.pi / 4])  # Franka's ready pose

# Position (mm) and fixed-XYZ angles (deg) of FANUC's faceplate frame, from the height of J2 (base z 0.33 m).
FK = [
    ("lrmate_200id", (0, 0, 0, 0, -90, 0), (385, 0, 285), (180, 0, 0)),
    ("lrmate_200id", (30, 20, -10, 40, -50, 60), (445.3873, 211.6582, 106.5416), (159.1520, 27.4119, 108.5336)),
    ("lrmate_200id", (-45, 60, 35, -120, 75, -200), (416.9870, -511.6280, 11.3761), (123.1684, 0.2831, -42.7295)),
    ("lrmate_200id_7l", (0, 0, 0, 0, -90, 0), (470, 0, 395), (180, 0, 0)),
    ("lrmate_200id_7l", (30, 20, -10, 40, -50, 60), (541.7191, 267.2754, 167.4078), (159.1520, 27.4119, 108.5336)),
    ("lrmate_200id_7l", (-45, 60, 35, -120, 75, -200), (538.8208, -633.4618, 30.4535), (123.1684, 0.2831, -42.7295)),
]

# Rows (a, alpha, d, theta at q = 0) in m and deg, and the height of the table's base frame above ours, m.
DH = {  # "classic": Rz(theta) Tz(d) Tx(a) Rx(alpha); "modified": Rx(alpha) Tx(a) Rz(theta) Tz(d)
    "panda": (
        "modified",  # Franka's documentation, and the flange 0.107 m beyond joint 7
        [(0, 0, 0.333, 0), (0, -90, 0, 0), (0, 90, 0.316, 0), (0.0825, 90, 0, 0), (-0.0825, -90, 0.384, 0)]
        + [(0, 90, 0, 0), (0.088, 90, 0.107, 0)],
        0.0,
    ),
    "ur5e": (
        "classic",  # Universal Robots' article on DH parameters
        [(0, 90, 0.1625, 0), (-0.425, 0, 0, 0), (-0.3922, 0, 0, 0)]
        + [(0, 90, 0.1333, 0), (0, -90, 0.0997, 0), (0, 0, 0.0996, 0)],
        0.0,
    ),
    "crx_10ia_l": (
        "modified",  # Abbes and Poisson, Robotics 13 (2024) 91, with the upper arm of the long version
        [(0, 0, 0, 0), (0, -90, 0, -90), (0.71, 180, 0, 0), (0, -90, -0.54, 0), (0, 90, 0.15, 0), (0, -90, -0.16, 0)],
        0.245,
    ),
}

MASS = {  # kg, with the base: data sheets of the LR Mates, sums of the published link masses of the others
    "lrmate_200id": 25.0,
    "lrmate_200id_7l": 27.0,
    "crx_10ia_l": 38.607,
    **dict.fromkeys(PANDAS, 16.6919),
    "ur5e": 21.7,
    "openarm": 5.828,
}


def load(path: Path) -> dict[str, Any]:
    return tomllib.loads(path.read_text())


def profile_of(arm: str) -> dict[str, Any]:
    return load(ROBOTS / arm / "profile.toml")


def urdf_of(arm: str) -> Path:
    return ROBOTS / arm / str(profile_of(arm)["urdf"])


def model_of(arm: str) -> Any:
    return pinocchio.buildModelFromUrdf(str(urdf_of(arm)))


def frame(model: Any, q: Any, name: str = "flange") -> Any:
    data = model.createData()
    pinocchio.framesForwardKinematics(model, data, np.asarray(q, float))
    return data.oMf[model.getFrameId(name, pinocchio.FrameType.BODY)]


def postures(model: Any, count: int) -> Array:
    rng = np.random.default_rng(7)
    return rng.uniform(model.lowerPositionLimit, model.upperPositionLimit, (count, model.nq))


# --- kinematics ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("arm", "q_deg", "xyz_mm", "wpr_deg"), FK)
def test_forward_kinematics_of_the_lr_mates(arm: str, q_deg: Any, xyz_mm: Any, wpr_deg: Any) -> None:
    flange = frame(model_of(arm), np.radians(q_deg))
    assert (flange.translation - [0, 0, 0.33]) * 1000 == pytest.approx(xyz_mm, abs=1e-3)
    faceplate = flange.rotation @ pinocchio.rpy.rpyToMatrix(math.pi, -math.pi / 2, 0)
    expected = pinocchio.rpy.rpyToMatrix(*np.radians(wpr_deg))  # pinocchio's rpy is Rz Ry Rx too
    assert faceplate == pytest.approx(expected, abs=2e-6)


def screw(axis: int, angle: float, along: float) -> Array:
    """Rotation about axis (0 x, 2 z) and shift along it."""
    turn = np.zeros(3)
    turn[axis] = angle
    pose = np.eye(4)
    pose[:3, :3] = pinocchio.exp3(turn)
    pose[axis, 3] = along
    return pose


@pytest.mark.parametrize("arm", DH)
def test_forward_kinematics_is_that_of_the_published_dh_table(arm: str) -> None:
    kind, rows, height = DH[arm]
    model = model_of(arm)
    for q in postures(model, 50):
        pose = screw(2, 0.0, height)
        for angle, (a, alpha, d, theta) in zip(q, rows, strict=True):
            link, joint = screw(0, math.radians(alpha), a), screw(2, angle + math.radians(theta), d)
            pose = pose @ (joint @ link if kind == "classic" else link @ joint)
        flange = frame(model, q)
        assert flange.translation == pytest.approx(pose[:3, 3], abs=1e-9)
        outward = -pose[:3, 2] if arm == "crx_10ia_l" else pose[:3, 2]  # our flanges have x outward; FANUC's last d < 0
        assert flange.rotation[:, 0] == pytest.approx(outward, abs=1e-9)


@pytest.mark.parametrize(
    ("arm", "q", "xyz"),
    [
        ("panda", READY, (0.306891, 0.0, 0.590282)),  # the arm's own O_T_EE there is (0.3069, 0, 0.4869), with its hand
        ("ur5e", np.zeros(6), (-0.8172, -0.2329, 0.0628)),
        ("openarm", np.zeros(7), (0.0, 0.0, 0.6586)),  # where the maker's model places the hand's mesh
        ("crx_10ia_l", np.zeros(6), (0.7, -0.15, 0.955)),
    ],
)
def test_flange_at_a_known_posture(arm: str, q: Array, xyz: Any) -> None:
    assert frame(model_of(arm), q).translation == pytest.approx(xyz, abs=1e-6)


@pytest.mark.parametrize(
    ("arm", "forearm_deg", "reach"),
    [
        ("lrmate_200id", 90 - math.degrees(math.atan2(0.035, 0.335)), 0.717),
        ("lrmate_200id_7l", 90 - math.degrees(math.atan2(0.035, 0.42)), 0.911),
        ("crx_10ia_l", 90, 1.249),
    ],
)
def test_reach_of_the_data_sheet(arm: str, forearm_deg: float, reach: float) -> None:
    """From the J1 axis to the wrist, upper arm and forearm in one horizontal line."""
    model = model_of(arm)
    data = model.createData()
    pinocchio.forwardKinematics(model, data, np.radians([0, 90, forearm_deg, 0, 0, 0]))
    assert data.oMi[5].translation[0] == pytest.approx(reach, abs=1.1e-3)


@pytest.mark.parametrize("arm", ARMS)
def test_flange_x_axis_points_outward(arm: str) -> None:
    """The tool files count on it."""
    model, last = model_of(arm), profile_of(arm)["capsules"][-1]
    for q in postures(model, 5):
        flange, link = frame(model, q), frame(model, q, last["link"])
        body = link.act((np.array(last["p0"]) + last["p1"]) / 2)
        away = flange.translation - body
        assert flange.rotation[:, 0] @ away > 0.8 * np.linalg.norm(away)


# --- dynamics --------------------------------------------------------------------------------------------------------


def test_gravity_torque_and_mass_matrix_of_the_stretched_lr_mates() -> None:
    q = np.radians([0, 90, 90, 0, 0, 0])
    for arm, gravity, inertia in [
        ("lrmate_200id", [-37.5, 7.1, 0.09], [2.07, 1.60, 0.207]),
        ("lrmate_200id_7l", [-57.4, 10.1, 0.08], [3.79, 3.10, 0.350]),
    ]:
        model = model_of(arm)
        data = model.createData()
        assert pinocchio.computeGeneralizedGravity(model, data, q)[[1, 2, 4]] == pytest.approx(gravity, abs=0.06)
        assert np.diag(pinocchio.crba(model, data, q))[:3] == pytest.approx(inertia, rel=0.01)


def test_dynamics_of_the_panda_in_its_ready_pose() -> None:
    """MEASURED with Pinocchio on the panda.urdf of PyPI's example-robot-data 6.0.0, hand and fingers made weightless.

    Over random states the inverse dynamics of the two agree to 4e-12 Nm.
    """
    model = model_of("panda")
    data = model.createData()
    inertia = np.diag(pinocchio.crba(model, data, READY))
    assert inertia == pytest.approx([0.46118, 1.44496, 0.87893, 0.78874, 0.02785, 0.03256, 0.00491], abs=1e-5)
    gravity = pinocchio.computeGeneralizedGravity(model, data, READY)
    assert gravity == pytest.approx([0, -1.77138, -0.644, 18.57359, 0.63385, 1.69368, 0], abs=1e-5)


@pytest.mark.parametrize("arm", ARMS)
def test_masses_and_inertias_are_physical(arm: str) -> None:
    masses = []
    for link in ET.parse(urdf_of(arm)).getroot().iter("link"):
        inertial = link.find("inertial")
        if inertial is None:
            assert link.attrib["name"] == "flange"
            continue
        mass, inertia = inertial.find("mass"), inertial.find("inertia")
        assert mass is not None and inertia is not None
        masses.append(float(mass.attrib["value"]))
        xx, xy, xz, yy, yz, zz = (float(inertia.attrib[f"i{key}"]) for key in ("xx", "xy", "xz", "yy", "yz", "zz"))
        moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        assert masses[-1] > 0 and moments[0] > 0, link.attrib["name"]
        assert moments[2] < moments[0] + moments[1], f"{link.attrib['name']}: triangle inequality of inertia"
    assert sum(masses) == pytest.approx(MASS[arm], abs=0.02)
    assert sum(link.mass for link in model_of(arm).inertias) == pytest.approx(sum(masses))


@pytest.mark.parametrize("arm", [arm for arm in ARMS if "effort_nm" in profile_of(arm)["joints"]])
def test_the_motors_hold_the_arm(arm: str) -> None:
    profile, model = profile_of(arm), model_of(arm)
    effort = np.array(profile["joints"]["effort_nm"])
    data = model.createData()
    worst = np.max([np.abs(pinocchio.computeGeneralizedGravity(model, data, q)) for q in postures(model, 2000)], axis=0)
    assert np.all(worst < 0.7 * effort)
    assert np.all(worst[1:3] > 0.05 * effort[1:3]), "weightless"


# --- profiles --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("arm", ARMS)
def test_profile_agrees_with_the_urdf(arm: str) -> None:
    profile, model = profile_of(arm), model_of(arm)
    joints = profile["joints"]
    assert profile["name"] == arm
    assert joints["names"] == list(model.names)[1:]
    position = np.radians(joints["position_deg"])
    assert position[:, 0] == pytest.approx(model.lowerPositionLimit, abs=5e-6)
    assert position[:, 1] == pytest.approx(model.upperPositionLimit, abs=5e-6)
    assert np.radians(joints["velocity_deg_s"]) == pytest.approx(model.velocityLimit, abs=5e-6)
    assert joints.get("effort_nm", list(model.effortLimit)) == pytest.approx(list(model.effortLimit))
    assert model.existFrame(profile["flange"])
    assert ET.parse(urdf_of(arm)).getroot().attrib["name"] == arm
    links = [link.attrib["name"] for link in ET.parse(urdf_of(arm)).getroot().iter("link")]
    assert links[0] == "base", "the root link, whose frame everything is in"
    assert {capsule["link"] for capsule in profile["capsules"]} == set(links) - {"flange"}
    for block in (profile, joints, *profile["capsules"]):
        assert block["provenance"].startswith(("MEASURED ", "DATASHEET ", "ASSUMED "))


@pytest.mark.parametrize("arm", ARMS)
def test_limits_are_sane(arm: str) -> None:
    profile = profile_of(arm)
    joints = profile["joints"]
    position = np.array(joints["position_deg"])
    velocity, acceleration, jerk = (
        np.array(joints[key]) for key in ("velocity_deg_s", "acceleration_deg_s2", "jerk_deg_s3")
    )
    n = len(joints["names"])
    assert position.shape == (n, 2) and all(len(limit) == n for limit in (velocity, acceleration, jerk))
    assert np.all(position[:, 1] - position[:, 0] >= 90) and np.all(np.abs(position) <= 360)
    assert np.all((velocity / acceleration > 0.05) & (velocity / acceleration < 1.5)), "s to full speed"
    assert np.all((acceleration / jerk >= 0.002 - 1e-9) & (acceleration / jerk < 0.6)), "s to full acceleration"
    torque = "effort_nm" in joints
    assert profile["command_latency_ms"] <= 5 if torque else profile["command_latency_ms"] >= 20
    assert 1 <= profile["payload_kg"] <= 20


# --- the Pandas of the transfer trials -------------------------------------------------------------------------------


@pytest.mark.parametrize(("arm", "locked"), [("panda_6dof", 1), ("panda_5dof", 2)])
def test_a_panda_with_locked_joints_is_the_panda_at_those_angles(arm: str, locked: int) -> None:
    full, fixed = model_of("panda"), model_of(arm)
    free = 7 - locked
    reduced = pinocchio.buildReducedModel(full, list(range(free + 1, 8)), READY)
    assert list(fixed.names) == list(reduced.names)
    for q in postures(fixed, 20):
        assert frame(fixed, q).homogeneous == pytest.approx(frame(full, [*q, *READY[free:]]).homogeneous, abs=1e-9)
        torques = [pinocchio.rnea(m, m.createData(), q, q[::-1].copy(), q) for m in (fixed, reduced)]
        assert torques[0] == pytest.approx(torques[1], abs=1e-9)


def test_the_third_end_effector_moves_joint_7_by_5_cm_along_y_of_link_6_and_nothing_else() -> None:
    plain, moved = model_of("panda"), model_of("panda_ee3")
    for q in postures(plain, 20):
        shift = frame(moved, q).translation - frame(plain, q).translation
        assert frame(plain, q, "link6").rotation.T @ shift == pytest.approx([0, 0.05, 0], abs=1e-9)
    assert all(a == b for a, b in zip(plain.inertias, moved.inertias, strict=True))


@pytest.mark.parametrize("arm", PANDAS[1:])
def test_the_pandas_share_their_figures(arm: str) -> None:
    plain, other = profile_of("panda"), profile_of(arm)
    n = len(other["joints"]["names"])
    assert other["capsules"] == plain["capsules"]
    for key, values in plain["joints"].items():
        assert other["joints"][key] == (values if key == "provenance" else values[:n])
    links = [list(ET.parse(urdf_of(name)).getroot().iter("link")) for name in ("panda", arm)]
    assert [ET.tostring(link) for link in links[0]] == [ET.tostring(link) for link in links[1]]


# --- shapes ----------------------------------------------------------------------------------------------------------


def corners(visual: ET.Element) -> Array:
    """Points on the hull of one primitive visual, in the link frame."""
    origin, shape = visual.find("origin"), visual.find("geometry")
    assert origin is not None and shape is not None
    numbers = [np.array(origin.get(key, "0 0 0").split(), float) for key in ("xyz", "rpy")]
    box, cylinder = shape.find("box"), shape.find("cylinder")
    if box is not None:
        half = np.array(box.attrib["size"].split(), float) / 2
        points = np.array(list(product((-1, 1), repeat=3))) * half
    else:
        assert cylinder is not None, "only boxes and cylinders: no meshes"
        r, length = float(cylinder.attrib["radius"]), float(cylinder.attrib["length"])
        angle = np.linspace(0, 2 * math.pi, 64)
        rim = np.stack([r * np.cos(angle), r * np.sin(angle), np.full(64, length / 2)], axis=1)
        points = np.concatenate([rim, rim * [1, 1, -1]])
    return points @ pinocchio.rpy.rpyToMatrix(*numbers[1]).T + numbers[0]


def distance_to_segment(points: Array, p0: Any, p1: Any) -> Array:
    axis = np.subtract(p1, p0)
    share = np.clip((points - p0) @ axis / max(axis @ axis, 1e-12), 0, 1)
    return np.linalg.norm(points - p0 - share[:, None] * axis, axis=1)


@pytest.mark.parametrize("arm", ARMS)
def test_what_is_drawn_lies_inside_the_capsules(arm: str) -> None:
    capsules = {capsule["link"]: capsule for capsule in profile_of(arm)["capsules"]}
    for link in ET.parse(urdf_of(arm)).getroot().iter("link"):
        name = link.attrib["name"]
        visuals = list(link.iter("visual"))
        assert visuals or name == "flange"
        for visual in visuals:
            capsule = capsules[name]
            beyond = distance_to_segment(corners(visual), capsule["p0"], capsule["p1"]) - capsule["radius"]
            assert beyond.max() < 1e-3, f"{name}: {beyond.max():.4f} m outside"


@pytest.mark.parametrize("arm", ARMS)
def test_the_capsules_leave_no_gap_from_base_to_flange(arm: str) -> None:
    model, capsules = model_of(arm), profile_of(arm)["capsules"]
    share = np.linspace(0, 1, 30)[:, None]
    for q in postures(model, 10):
        placed = [(frame(model, q, c["link"]), c) for c in capsules]
        axes = [
            (np.array(c["p0"]) + share * np.subtract(c["p1"], c["p0"])) @ pose.rotation.T + pose.translation
            for pose, c in placed
        ]
        for (one, a), (other, b) in pairwise(zip(axes, capsules, strict=True)):
            gap = np.linalg.norm(one[:, None] - other[None], axis=2).min() - a["radius"] - b["radius"]
            assert gap < -0.02, f"{a['link']} to {b['link']}: {gap:.3f} m"
        end = np.linalg.norm(axes[-1] - frame(model, q).translation, axis=1).min() - capsules[-1]["radius"]
        assert -0.05 < end < 0, "the flange lies just inside the last capsule"


# --- tools -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", TOOLS, ids=lambda path: path.stem)
def test_tool_is_physical(path: Path) -> None:
    tool = load(path)
    assert tool["name"] == path.stem
    assert tool["provenance"].startswith(("MEASURED ", "DATASHEET ", "ASSUMED "))
    xx, xy, xz, yy, yz, zz = tool["inertia"]
    moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    assert moments[0] >= 0 and moments[2] <= moments[0] + moments[1] + 1e-12, "triangle inequality of inertia"
    assert (moments[0] > 0) == (tool["mass_kg"] > 0)
    for capsule in tool["capsules"]:
        assert min(capsule["p0"][0], capsule["p1"][0]) - capsule["radius"] > -0.01, "reaches back into the flange"
    if tool["mass_kg"] > 0:
        inside = [
            distance_to_segment(np.array([tool["com"]]), c["p0"], c["p1"])[0] < c["radius"] + 0.02
            for c in tool["capsules"]
        ]
        assert any(inside), "centre of mass far outside the tool"


def test_the_rod_has_the_inertia_of_a_uniform_cylinder() -> None:
    rod = load(ROBOTS / "tools" / "ee2.toml")
    m, r, length = rod["mass_kg"], 0.01, 0.2
    across = m * (3 * r**2 + length**2) / 12
    assert m == 0.1
    assert rod["inertia"] == pytest.approx([m * r**2 / 2, 0, 0, across, 0, across], abs=1e-6)


def test_the_tools_that_cells_name_exist() -> None:
    assert {path.stem for path in TOOLS} >= {"bare", "drill", "bat", "ee1", "ee2"}


def test_the_arms_that_the_trials_name_exist() -> None:
    assert set(ARMS) >= {"lrmate_200id", "lrmate_200id_7l", "crx_10ia_l", *PANDAS, "openarm", "ur5e"}
