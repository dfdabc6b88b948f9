"""What no single file of a cell can tell alone: do cell, profile, URDF and tool fit together?"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from pathlib import Path

from asc_rt import cell_cameras, topics
from asc_rt.cell_cameras import PerceptionOptions
from asc_rt.cell_files import CellFile, ProfileFile, ToolFile
from asc_rt.core.params import SensorParams
from asc_rt.explain import suggestion
from asc_rt.faults import Faults
from calibration.result import CalibrationError, load
from drivers import registry

LOOPBACK = ("127.0.0.1", "localhost")
GROUND_TRUTH = "ground-truth"
LEAST_RANGE_DEG = 20  # of a joint; 2 pi and less look like radians
URDF_TOLERANCE_DEG = 0.1


def check_urdf(path: Path, profile: ProfileFile, urdf: Path, text: str, faults: Faults) -> None:
    """The profile (at `path`) against its URDF: links, joints, limits."""
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        faults.append(f"{urdf}:{error.position[0]}: malformed URDF: {error}")
        return
    links = [link.get("name", "") for link in root.iter("link")]
    joints = {joint.get("name", ""): joint for joint in root.findall("joint")}
    named = [("flange", profile.flange), *((f"capsules[{i}].link", c.link) for i, c in enumerate(profile.capsules))]
    for key, link in named:
        if link not in links:
            near = suggestion(link, links)
            faults.note(path, key, f"link {link!r} is not in {urdf.name};{near} links: {', '.join(links)}")
    for i, name in enumerate(profile.joints.names):
        if name not in joints:
            known = ", ".join(joints)
            faults.note(path, f"joints.names[{i}]", f"joint {name!r} is not in {urdf.name}; joints: {known}")
        elif i < len(profile.joints.position_deg):
            _check_joint(path, i, profile.joints.position_deg[i], joints[name], faults)


def _check_joint(path: Path, i: int, limits: tuple[float, float], joint: ET.Element, faults: Faults) -> None:
    limit = joint.find("limit")
    if joint.get("type") != "revolute" or limit is None:
        faults.note(path, f"joints.names[{i}]", f"{joint.get('name')} is not a revolute joint with limits in the URDF")
        return
    low, high = (math.degrees(float(limit.get(side, "nan"))) for side in ("lower", "upper"))
    if not (low - URDF_TOLERANCE_DEG <= limits[0] and limits[1] <= high + URDF_TOLERANCE_DEG):
        wide = f"{limits[0]:g} to {limits[1]:g} deg"
        faults.note(path, f"joints.position_deg[{i}]", f"{wide} is wider than the URDF's {low:g} to {high:g} deg")


def check_profile(path: Path, profile: ProfileFile, faults: Faults) -> None:
    joints, n = profile.joints, len(profile.joints.names)
    for key in ("position_deg", "velocity_deg_s", "acceleration_deg_s2", "jerk_deg_s3", "effort_nm"):
        if (values := getattr(joints, key)) is not None and (count := len(values)) != n:
            faults.note(path, f"joints.{key}", f"{count} values for {n} joints; one each for {', '.join(joints.names)}")
    for i, (low, high) in enumerate(joints.position_deg):
        key = f"joints.position_deg[{i}]"
        if low >= high:
            faults.note(path, key, f"{low:g} to {high:g} deg is no range; the lower limit first")
        elif high - low < LEAST_RANGE_DEG:
            faults.note(path, key, f"a range of {high - low:g} deg is implausible; degrees, not radians")


def check_tool(path: Path, tool: ToolFile, profile: ProfileFile, faults: Faults) -> None:
    if tool.mass_kg > profile.payload_kg:
        more = f"{tool.mass_kg:g} kg is more than the payload of {profile.name}, {profile.payload_kg:g} kg"
        faults.note(path, "mass_kg", f"{more}; a lighter tool or a stronger robot")
    if tool.mass_kg > 0 and not _is_solid(tool.inertia):
        faults.note(
            path,
            "inertia",
            f"no solid body has {list(tool.inertia)} kg m2; xx xy xz yy yz zz about the centre of mass, "
            "positive definite, each diagonal element at most the sum of the other two",
        )


def check_tools(path: Path, cell: CellFile, profile: ProfileFile, faults: Faults) -> None:
    assert cell.tools is not None
    numbers, tools = [m.number for m in cell.tools.mount], [m.tool for m in cell.tools.mount]
    for key, values in (("number", [str(number) for number in numbers]), ("tool", tools)):
        if twice := sorted({value for value in values if values.count(value) > 1}):
            faults.note(path, f"tools.mount.{key}", f"{', '.join(twice)} stands there twice; each once")
    if cell.tool not in tools:
        faults.note(
            path, "tools.mount", f"the cell's own tool, {cell.tool}, is missing; mounted are {', '.join(tools)}"
        )
    if (count := len(cell.tools.nm_per_ampere)) not in (0, len(profile.joints.names)):
        right = f"one each for {', '.join(profile.joints.names)}, or none"
        faults.note(path, "tools.nm_per_ampere", f"{count} values for {len(profile.joints.names)} joints; {right}")


def _is_solid(inertia: tuple[float, float, float, float, float, float]) -> bool:
    """Positive definite by its leading minors, and the triangle inequality of the diagonal."""
    xx, xy, xz, yy, yz, zz = inertia
    minor = xx * yy - xy * xy
    determinant = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    return xx > 0 and minor > 0 and determinant > 0 and 2 * max(xx, yy, zz) <= (xx + yy + zz) * (1 + 1e-9)


def check_cell(path: Path, cell: CellFile, profile: ProfileFile, faults: Faults) -> None:
    joints, safety = profile.joints, cell.safety
    for i, goal in enumerate(cell.task.goals_deg):
        if len(goal) != len(joints.names):
            faults.note(
                path, f"task.goals_deg[{i}]", f"{len(goal)} angles; {profile.name} has {len(joints.names)} joints"
            )
            continue
        for j, (angle, (low, high)) in enumerate(zip(goal, joints.position_deg, strict=False)):
            if not low <= angle <= high:
                limits = f"the limits of {joints.names[j]}, {low:g} to {high:g} deg"
                faults.note(path, f"task.goals_deg[{i}][{j}]", f"{angle:g} deg is outside {limits}")
    least = f"safety.d_min_m = {safety.d_min_m:g} m"
    if safety.activation_m <= safety.d_min_m:
        faults.note(path, "safety.activation_m", f"{safety.activation_m:g} m is too small; above {least}")
    if safety.rearm_distance_m < safety.d_min_m:
        faults.note(path, "safety.rearm_distance_m", f"{safety.rearm_distance_m:g} m is too small; at least {least}")
    _check_bus(path, cell, faults)
    _check_ladder(path, cell, faults)
    if cell.uncertified and not cell.simulated:
        faults.note(path, "uncertified", "this cell is real; only a simulated one may run without a certificate")
    for device in sorted(cell.sim.keys() - set(topics.SIM_DEVICES)):
        known = list(topics.SIM_DEVICES)
        near = suggestion(device, known)
        faults.note(path, f"sim.{device}", f"unknown device;{near} known: {', '.join(known)}")
    _check_driver(path, cell, faults)


def _check_bus(path: Path, cell: CellFile, faults: Faults) -> None:
    """Plain TCP stays on this machine."""
    host = cell.bus.endpoint.removeprefix("tcp/").rpartition(":")[0]
    if host not in LOOPBACK:
        wrong = f"{host} is not this machine alone; one of {', '.join(LOOPBACK)}, and [bus.remote] for other machines"
        faults.note(path, "bus.endpoint", wrong)


def _check_ladder(path: Path, cell: CellFile, faults: Faults) -> None:
    """Slow before stop."""
    h = cell.human
    if h.slow_age_ms > h.age_limit_ms:
        wrong = f"{h.slow_age_ms:g} ms is too large; at most human.age_limit_ms = {h.age_limit_ms:g} ms"
        faults.note(path, "human.slow_age_ms", wrong)
    if h.slow_coverage < h.least_coverage:
        wrong = f"{h.slow_coverage:g} is too small; at least human.least_coverage = {h.least_coverage:g}"
        faults.note(path, "human.slow_coverage", wrong)


def _check_driver(path: Path, cell: CellFile, faults: Faults) -> None:
    """The driver knows its own options; making one opens nothing."""
    known = sorted(registry.known())
    if cell.driver.name not in known:
        near = suggestion(cell.driver.name, known)
        faults.note(path, "driver.name", f"{cell.driver.name!r} is unknown;{near} known: {', '.join(known)}")
        return
    try:
        registry.driver_class(cell.driver.name)(cell.driver.model_extra or {})
    except ValueError as error:
        faults.note(path, "driver", str(error))


def sensors(path: Path, cell: CellFile, cameras: PerceptionOptions | None, faults: Faults) -> tuple[SensorParams, ...]:
    """The sensors of people that the cell names, each with the number that its messages must carry."""
    names = cell.human.sensors
    if len(set(names)) < len(names):
        faults.note(path, "human.sensors", f"{', '.join(names)}: a name stands twice; each once")
    for name in cell.human.calibrations.keys() - set(names):
        near = suggestion(name, names)
        faults.note(path, f"human.calibrations.{name}", f"no such sensor;{near} human.sensors: {', '.join(names)}")
    return tuple(
        SensorParams(name, i, _calibration_hash(path, cell, name, cameras, faults))
        for i, name in enumerate(names, start=1)
    )


def _calibration_hash(
    path: Path, cell: CellFile, sensor: str, cameras: PerceptionOptions | None, faults: Faults
) -> int:
    """The number that the sensor's messages must carry; 0: ground truth, which exists in simulation only."""
    if cameras is not None and sensor == cameras.sensor:
        return hash_number(cameras.digest)
    own = cell.human.calibrations.get(sensor)
    key = "human.calibration" if own is None else f"human.calibrations.{sensor}"
    named = cell.human.calibration if own is None else own
    if named == GROUND_TRUTH:
        if not cell.simulated:
            faults.note(path, key, f"{GROUND_TRUTH!r} exists in simulation only; the sensor's calibration file")
        return 0
    if named == cell_cameras.CAMERAS:
        if cell.perception is None or cell.perception.sensor != sensor:
            faults.note(path, key, f"{named!r} are those of [perception], which this sensor is not; its own file")
        return 0
    return _result_number(path, cell, key, named, faults)


def _result_number(path: Path, cell: CellFile, key: str, named: str, faults: Faults) -> int:
    """The hash of the camera's result file, if it is accepted, valid today and made for the camera of this cell."""
    human, file = cell.human, path.parent / named
    if not cell.simulated and not (human.camera and human.camera_mode):
        faults.note(path, "human.camera", "a real cell names serial and camera_mode of the camera it is calibrated for")
        return 0
    serials = {"camera": human.camera} if human.camera else {}
    try:
        result = load(file, "hand-eye", serials, human.camera_mode or None)
    except CalibrationError as error:
        for line in error.lines:
            faults.note(path, key, line)
        return 0
    return hash_number(result.digest)


def hash_number(digest: bytes) -> int:
    """The number that stands for a SHA-256 digest in states and records: its first 8 bytes; 0 for none."""
    return int.from_bytes(digest[:8], "big")
