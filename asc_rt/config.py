"""Load and check a cell: its own file, the robot's profile and URDF, the tool. Every error at once, one line each."""

from __future__ import annotations

import dataclasses
import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from asc_rt import cell_cameras
from asc_rt import cell_checks as checks
from asc_rt.cell_cameras import PerceptionOptions
from asc_rt.cell_files import CellFile, ProfileFile, Safety, Table, ToolFile
from asc_rt.cell_params import cell_params, radians, robot_params, safety_params, tool_params
from asc_rt.core.params import (
    STAND_IN,
    ChangerParams,
    Mount,
    Params,
    RobotParams,
    ToolParams,
)
from asc_rt.enclosing import enclosing_sphere
from asc_rt.explain import explain, suggestion
from asc_rt.faults import Faults, FaultsError

PACKAGE = Path(__file__).parent
CELLS, ROBOTS, TOOLS = PACKAGE / "cells", PACKAGE / "robots", PACKAGE / "robots" / "tools"

File = TypeVar("File", bound=Table)


class ConfigError(FaultsError):
    """`lines`: one per fault, as `FILE: KEY: what is wrong; what would be right`."""


@dataclass(frozen=True, slots=True)
class RealTimeOptions:
    priority: int
    cpu: int | None


@dataclass(frozen=True, slots=True)
class RemoteOptions:
    endpoint: str  # "tls/HOST:PORT"
    keys: Path  # folder

    @property
    def host(self) -> str:
        return self.endpoint.removeprefix("tls/").rpartition(":")[0]


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
    perception: PerceptionOptions | None  # None: its people are not seen by cameras of ours
    driver: dict[str, Any]  # the [driver] table, with `name`
    sim: dict[str, dict[str, Any]]  # the [sim.*] tables
    simulated: bool
    certificates: Path  # folder
    uncertified: bool  # runs whether or not a certificate covers it: in simulation, and recorded
    bus_endpoint: str
    remote: RemoteOptions | None  # how sensors on other machines come in; None: not at all
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
    cameras = cell_cameras.options(path, cell, faults)
    sensors = checks.sensors(path, cell, cameras, faults)
    if faults:
        raise ConfigError(faults)
    params = cell_params(cell, profile, tool, urdf, sensors)
    params = dataclasses.replace(params, changer=_changer(path, cell, profile, faults))
    if faults:
        raise ConfigError(faults)
    return _assemble(path, text, overrides, cell, params, cameras)


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
    return robot_params(profile, urdf), tool_params(tool_file, profile.flange)


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
            "index": s.index,
            "brake_m_s2": s.brake,
            "v_max_m_s": s.v_max,
        }
    }
    faults = _apply(tree, changes)
    for table in tree.keys() - {"safety"}:
        faults.append(f"--set {table}: a replay can change values of [safety] only, for example safety.d_min_m=0.12")
    safety = _check(Safety, Path("--set safety"), tree["safety"], faults)
    if safety is None or faults:
        raise ConfigError(faults)
    return dataclasses.replace(params, safety=safety_params(safety))


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


def _assemble(
    path: Path, text: str, overrides: Sequence[str], cell: CellFile, params: Params, cameras: PerceptionOptions | None
) -> Cell:
    return Cell(
        name=cell.name,
        path=path.resolve(),
        text=text,
        overrides=tuple(overrides),
        params=params,
        perception=cameras,
        driver=cell.driver.model_dump(),
        sim=cell.sim,
        simulated=cell.simulated,
        certificates=path.resolve().parent / cell.certificates,
        uncertified=cell.uncertified,
        bus_endpoint=cell.bus.endpoint,
        remote=_remote(path, cell),
        goals=tuple(radians(goal) for goal in cell.task.goals_deg),
        log_dir=Path(cell.log.dir),
        log=LogOptions(
            key=path.resolve().parent / cell.log.key if cell.log.key else None,
            stop_when_full=cell.log.on_full == "stop",
            rotate_ns=round(cell.log.rotate_min * 60e9),
        ),
        realtime=RealTimeOptions(cell.realtime.priority, None if cell.realtime.cpu < 0 else cell.realtime.cpu),
    )


def _remote(path: Path, cell: CellFile) -> RemoteOptions | None:
    remote = cell.bus.remote
    return None if remote is None else RemoteOptions(remote.endpoint, path.resolve().parent / remote.keys)


def _changer(path: Path, cell: CellFile, profile: ProfileFile, faults: Faults) -> ChangerParams:
    """The tools of [tools], the cell's own first. No certificate is known here: none is covered yet."""
    table = cell.tools
    if table is None:
        return ChangerParams()
    checks.check_tools(path, cell, profile, faults)
    mounts = []
    for entry in sorted(table.mount, key=lambda entry: entry.tool != cell.tool):
        file = _part(ToolFile, path, "tool", entry.tool, faults)
        if file is not None:
            checks.check_tool(_part_path("tool", entry.tool), file, profile, faults)
            mounts.append(Mount(entry.number, tool_params(file, profile.flange), entry.speed_share, covered=False))
    if table.unknown == "enclosing-sphere" and mounts:
        sphere = enclosing_sphere([mount.tool for mount in mounts], profile.flange)
        mounts.append(Mount(STAND_IN, sphere, min(mount.speed_share for mount in mounts), covered=False))
    return ChangerParams(
        mounts=tuple(mounts),
        told_by_robot=table.told_by == "robot",
        goes_on=table.in_motion == "go-on",
        nm_per_ampere=tuple(table.nm_per_ampere),
        torque_tolerance=table.torque_tolerance_nm,
    )
