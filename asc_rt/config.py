"""Load and check a cell: its own file, the robot's profile and URDF, the tool. Every error at once, one line each.

Degrees, milliseconds and kilograms of the files become SI and radians here and nowhere else.
"""

from __future__ import annotations

import dataclasses
import math
import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from asc_rt import cell_checks as checks
from asc_rt.cell_checks import Faults
from asc_rt.cell_files import Capsule, CellFile, ProfileFile, Safety, Table, ToolFile
from asc_rt.core.params import CapsuleSpec, HumanParams, Params, RobotParams, SafetyParams, TaskParams, ToolParams
from asc_rt.explain import explain, suggestion

PACKAGE = Path(__file__).parent
CELLS, ROBOTS, TOOLS = PACKAGE / "cells", PACKAGE / "robots", PACKAGE / "robots" / "tools"

File = TypeVar("File", bound=Table)


class ConfigError(Exception):
    """`lines`: one per fault, as `FILE: KEY: what is wrong; what would be right`."""

    def __init__(self, lines: Sequence[str]) -> None:
        super().__init__("\n".join(lines))
        self.lines = tuple(lines)


@dataclass(frozen=True, slots=True)
class RealTimeOptions:
    priority: int
    cpu: int | None


@dataclass(frozen=True, slots=True)
class LogOptions:
    key: Path | None  # None: the user's own
    stop_when_full: bool
    rotate_ns: int  # 0: one file


@dataclass(frozen=True, slots=True)
class Cell:
    name: str
    path: Path
    text: str  # the cell file as it stands
    overrides: tuple[str, ...]  # "key=value" put over it
    params: Params
    driver: dict[str, Any]  # the [driver] table, with `name`
    sim: dict[str, dict[str, Any]]  # the [sim.*] tables
    simulated: bool
    certificates: Path  # folder
    uncertified: bool  # runs whether or not a certificate covers it: in simulation, and recorded
    bus_endpoint: str
    goals: tuple[tuple[float, ...], ...]  # rad
    log_dir: Path
    log: LogOptions
    realtime: RealTimeOptions

    @property
    def driver_options(self) -> dict[str, Any]:
        """What the driver's constructor takes."""
        return {key: value for key, value in self.driver.items() if key != "name"}


def load_cell(path_or_name: str | Path, overrides: Sequence[str] = ()) -> Cell:
    """The cell `path_or_name` (a file, or a name under asc_rt/cells) with `overrides` ("safety.d_min_m=0.12") applied.

    ConfigError: everything that is wrong with it.
    """
    path = find_cell(path_or_name)
    text = _read(path)
    tree = _parse(path, text)
    faults = _apply(tree, overrides)
    cell = _check(CellFile, path, tree, faults)
    profile = _part(ProfileFile, path, "robot", tree.get("robot"), faults)
    tool = _part(ToolFile, path, "tool", tree.get("tool"), faults)
    if cell is None or profile is None or tool is None:
        raise ConfigError(faults)
    profile_path = _part_path("robot", cell.robot)
    urdf_path = profile_path.parent / profile.urdf
    try:
        urdf = _read(urdf_path)
    except ConfigError as error:
        raise ConfigError([*faults, f"{profile_path}: urdf: {error.lines[0]}"]) from error
    checks.check_profile(profile_path, profile, faults)
    checks.check_urdf(profile_path, profile, urdf_path, urdf, faults)
    checks.check_tool(_part_path("tool", cell.tool), tool, profile, faults)
    checks.check_cell(path, cell, profile, faults)
    calibration = checks.calibration_hash(path, cell, faults)
    if faults:
        raise ConfigError(faults)
    params = _params(cell, profile, tool, urdf, calibration)
    return _assemble(path, text, overrides, cell, params)


def load_arm(robot: str, tool: str) -> tuple[RobotParams, ToolParams]:
    """A robot of asc_rt/robots and a tool of asc_rt/robots/tools, without a cell. ConfigError: all that is wrong."""
    faults, asked = Faults(), Path("command line")
    profile = _part(ProfileFile, asked, "robot", robot, faults)
    tool_file = _part(ToolFile, asked, "tool", tool, faults)
    if profile is None or tool_file is None:
        raise ConfigError(faults)
    profile_path = _part_path("robot", robot)
    urdf_path = profile_path.parent / profile.urdf
    urdf = _read(urdf_path)
    checks.check_profile(profile_path, profile, faults)
    checks.check_urdf(profile_path, profile, urdf_path, urdf, faults)
    checks.check_tool(_part_path("tool", tool), tool_file, profile, faults)
    if faults:
        raise ConfigError(faults)
    return _robot(profile, urdf), _tool(tool_file, profile.flange)


def what_if(params: Params, changes: Sequence[str]) -> Params:
    """`params` with other values in [safety], by the keys of the cell file ("safety.d_min_m=0.12"). ConfigError."""
    s = params.safety
    tree: dict[str, Any] = {
        "safety": {
            "d_min_m": s.d_min,
            "activation_m": s.activation_distance,
            "k": s.k,
            "eta": s.eta,
            "M_floor": s.M_floor,
            "human_acceleration_m_s2": s.human_acceleration,
            "rearm_distance_m": s.rearm_distance,
        }
    }
    faults = _apply(tree, changes)
    for table in tree.keys() - {"safety"}:
        faults.append(f"--set {table}: a replay can change values of [safety] only, for example safety.d_min_m=0.12")
    safety = _check(Safety, Path("--set safety"), tree["safety"], faults)
    if safety is None or faults:
        raise ConfigError(faults)
    return dataclasses.replace(params, safety=_safety(safety))


def find_cell(path_or_name: str | Path) -> Path:
    """ConfigError: no such cell, with the nearest name."""
    asked = str(path_or_name)
    if asked.endswith(".toml") or "/" in asked:
        if not Path(asked).is_file():
            raise ConfigError([f"{asked}: no such cell file"])
        return _short(Path(asked))
    known = sorted(p.stem for p in CELLS.glob("*.toml"))
    if asked not in known:
        guess = suggestion(asked, known)
        raise ConfigError(
            [f"cell {asked!r}: unknown;{guess} known cells: {', '.join(known)}; or give a path to a .toml"]
        )
    return _short(CELLS / f"{asked}.toml")


def _short(path: Path) -> Path:
    """Relative to the working directory where it is inside: error lines stay readable."""
    here, full = Path.cwd(), path.resolve()
    return full.relative_to(here) if full.is_relative_to(here) else full


# --- reading ---------------------------------------------------------------------------------------------------------


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise ConfigError([f"{path}: cannot be read: {reason}"]) from error


def _parse(path: Path, text: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        found = re.search(r" \(at line (\d+), column \d+\)$", str(error))
        line = f":{found[1]}" if found else ""
        message = str(error)[: found.start()] if found else str(error)
        raise ConfigError([f"{path}{line}: malformed TOML: {message[:1].lower()}{message[1:]}"]) from error


def _apply(tree: dict[str, Any], overrides: Sequence[str]) -> Faults:
    """Put "key=value" over the tree; the faults found."""
    faults = Faults()
    for item in overrides:
        key, equals, raw = item.partition("=")
        *tables, leaf = key.strip().split(".")
        if not equals or not all([*tables, leaf]):
            faults.append(f"--set {item}: not of the form key=value, for example safety.d_min_m=0.12")
            continue
        place: Any = tree
        for table in tables:
            place = place.setdefault(table, {}) if isinstance(place, dict) else None
        if isinstance(place, dict):
            place[leaf] = _value(raw.strip())
        else:
            faults.append(f"--set {item}: {'.'.join(tables)} is a value, not a table")
    return faults


def _value(raw: str) -> Any:
    """`raw` as TOML, or as the text itself where it is none (so that a word needs no quotes)."""
    try:
        return tomllib.loads(f"value = {raw}")["value"]
    except tomllib.TOMLDecodeError:
        return raw


def _check(kind: type[File], path: Path, tree: dict[str, Any], faults: Faults) -> File | None:
    try:
        return kind.model_validate(tree)
    except ValidationError as error:
        faults += [f"{path}: {line}" for line in explain(kind, error)]
        return None


def _part_path(kind: str, name: str) -> Path:
    return _short(ROBOTS / name / "profile.toml" if kind == "robot" else TOOLS / f"{name}.toml")


def _part(kind: type[File], cell: Path, key: str, name: Any, faults: Faults) -> File | None:
    """The robot's or tool's file that the cell names; None with the fault noted."""
    if not isinstance(name, str):
        return None  # told with the cell's own errors
    path = _part_path(key, name)
    known = sorted(
        [p.parent.name for p in ROBOTS.glob("*/profile.toml")]
        if key == "robot"
        else [p.stem for p in TOOLS.glob("*.toml")]
    )
    if name not in known:
        faults.append(f"{cell}: {key}: {name!r} is unknown;{suggestion(name, known)} known: {', '.join(known)}")
        return None
    try:
        return _check(kind, path, _parse(path, _read(path)), faults)
    except ConfigError as error:
        faults += error.lines
        return None


# --- putting together ------------------------------------------------------------------------------------------------


def _assemble(path: Path, text: str, overrides: Sequence[str], cell: CellFile, params: Params) -> Cell:
    return Cell(
        name=cell.name,
        path=path.resolve(),
        text=text,
        overrides=tuple(overrides),
        params=params,
        driver=cell.driver.model_dump(),
        sim=cell.sim,
        simulated=cell.simulated,
        certificates=path.resolve().parent / cell.certificates,
        uncertified=cell.uncertified,
        bus_endpoint=cell.bus.endpoint,
        goals=tuple(_radians(goal) for goal in cell.task.goals_deg),
        log_dir=Path(cell.log.dir),
        log=LogOptions(
            key=path.resolve().parent / cell.log.key if cell.log.key else None,
            stop_when_full=cell.log.on_full == "stop",
            rotate_ns=round(cell.log.rotate_min * 60e9),
        ),
        realtime=RealTimeOptions(cell.realtime.priority, None if cell.realtime.cpu < 0 else cell.realtime.cpu),
    )


def _params(cell: CellFile, profile: ProfileFile, tool: ToolFile, urdf: str, calibration: int) -> Params:
    return Params(
        period_ns=cell.period_ms * 1_000_000,
        control=cell.control.level,
        silence_cycles=cell.control.silence_cycles,
        tracking_tolerance=math.radians(cell.control.tracking_tolerance_deg),
        robot=_robot(profile, urdf),
        tool=_tool(tool, profile.flange),
        safety=_safety(cell.safety),
        human=HumanParams(_ns(cell.human.age_limit_ms), _ns(cell.human.future_limit_ms), calibration),
        task=TaskParams(cell.task.speed, math.radians(cell.task.goal_tolerance_deg)),
    )


def _safety(safety: Safety) -> SafetyParams:
    return SafetyParams(
        d_min=safety.d_min_m,
        activation_distance=safety.activation_m,
        k=safety.k,
        eta=safety.eta,
        M_floor=safety.M_floor,
        human_acceleration=safety.human_acceleration_m_s2,
        rearm_distance=safety.rearm_distance_m,
    )


def _robot(profile: ProfileFile, urdf: str) -> RobotParams:
    joints = profile.joints
    return RobotParams(
        name=profile.name,
        urdf=urdf,
        joints=tuple(joints.names),
        flange=profile.flange,
        q_min=_radians([low for low, _ in joints.position_deg]),
        q_max=_radians([high for _, high in joints.position_deg]),
        dq_max=_radians(joints.velocity_deg_s),
        ddq_max=_radians(joints.acceleration_deg_s2),
        dddq_max=_radians(joints.jerk_deg_s3),
        effort=tuple(joints.effort_nm or ()),
        command_latency_ns=_ns(profile.command_latency_ms),
        capsules=tuple(_capsule(c.link, c) for c in profile.capsules),
    )


def _tool(tool: ToolFile, flange: str) -> ToolParams:
    capsules = tuple(_capsule(flange, capsule) for capsule in tool.capsules)
    return ToolParams(tool.name, tool.mass_kg, tool.com, tool.inertia, capsules)


def _capsule(link: str, capsule: Capsule) -> CapsuleSpec:
    return CapsuleSpec(link, capsule.p0, capsule.p1, capsule.radius)


def _radians(degrees: Sequence[float]) -> tuple[float, ...]:
    return tuple(math.radians(angle) for angle in degrees)


def _ns(milliseconds: float) -> int:
    return round(milliseconds * 1e6)
