"""What is known before the first cycle: everything that a reader needs to run a session again and to judge it."""

from __future__ import annotations

import ctypes
import getpass
import importlib.metadata
import json
import os
import platform
import subprocess
import time
import tomllib
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from asc_rt.config import ROBOTS, TOOLS, Cell
from asc_rt.fingerprint import fingerprint
from asc_rt.synthesis.certificate import file_name
from logs import schema

NAMING = ("human", "perception", "driver")  # never [log]: its `key` is secret, and a recording is handed around
_CLOCK_NOT_SET = 5  # TIME_ERROR of adjtimex


def attachments(cell: Cell) -> dict[str, bytes]:
    """Name -> content. OSError: a file that was there when the cell was loaded is gone."""
    robot = cell.params.robot
    found = {
        schema.PARAMS: cell.params.canonical(),
        schema.CELL: cell.text.encode(),
        f"{robot.name}.urdf": robot.urdf.encode(),
        schema.FINGERPRINT: json.dumps(fingerprint(), indent=1).encode(),
        schema.PACKAGES: packages().encode(),
        schema.CLOCK: json.dumps(clock_state(), indent=1).encode(),
    }
    return found | {name: path.read_bytes() for name, path in _files(cell).items()}


def _files(cell: Cell) -> dict[str, Path]:
    """The files that the cell consists of and that exist."""
    folder = ROBOTS / cell.params.robot.name
    files = {
        "profile.toml": folder / "profile.toml",
        "tool.toml": TOOLS / f"{cell.params.tool.name}.toml",
        schema.CERTIFICATE: cell.certificates / file_name(cell.params.robot.name, cell.params.tool.name),
    }
    for mount in cell.params.changer.mounts[1:]:  # the first is the cell's own
        name = mount.tool.name
        files[f"tool-{name}.toml"] = TOOLS / f"{name}.toml"
        files[f"{schema.CERTIFICATE}-{name}"] = cell.certificates / file_name(cell.params.robot.name, name)
    meshes = {str(mesh.get("filename")) for mesh in ET.fromstring(cell.params.robot.urdf).iter("mesh")}
    files |= {f"mesh/{name}": folder / name for name in meshes}
    files |= {key: cell.path.parent / name for key, name in _texts(cell).items()}
    files.pop("perception.pose.model", None)  # 9 to 30 MB, and not ours to hand around: `session` has its hash
    return {name: path for name, path in files.items() if path.is_file()}


def _texts(cell: Cell) -> dict[str, str]:
    """Every text of the tables that may name files, such as a calibration, by its dotted key, overrides applied."""
    tables = {name: table for name, table in tomllib.loads(cell.text).items() if name in NAMING}
    texts = dict(_flat(tables))
    for item in cell.overrides:
        key, _, value = item.partition("=")
        if key.strip().split(".")[0] in NAMING:
            texts[key.strip()] = value.strip().strip("\"'")
    return texts


def _flat(table: dict[str, Any], before: str = "") -> Iterator[tuple[str, str]]:
    for key, value in table.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{before}{key}.")
        elif isinstance(value, str):
            yield before + key, value


def session(cell: Cell) -> dict[str, str]:
    """Who, where and what, as text."""
    uname = platform.uname()
    return {
        "cell": cell.name,
        "overrides": " ".join(cell.overrides),
        "simulated": str(cell.simulated).lower(),
        "driver": json.dumps(cell.driver),
        "params_sha256": cell.params.content_hash(),
        "git_commit": git_commit(),
        "operator": _operator(),
        "host": f"{uname.node} {uname.system} {uname.release} {uname.machine}",
        "python": platform.python_version(),
        "started": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    } | _pose_model(cell)


def _pose_model(cell: Cell) -> dict[str, str]:
    pose = cell.perception and cell.perception.pose
    return {"pose_model": f"{pose.model.name} {pose.digest.hex()}"} if pose else {}


def _operator() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):  # no such user in this container
        return f"uid {os.getuid()}"


def packages() -> str:
    """Every installed package with its version: what a lock file would say, and what really runs."""
    found = {d.metadata["Name"]: d.version for d in importlib.metadata.distributions()}
    return "".join(f"{name}=={version}\n" for name, version in sorted(found.items(), key=lambda item: item[0].lower()))


def clock_state() -> dict[str, object]:
    """The clocks beside each other, and whether somebody keeps the wall clock right."""
    state = ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.create_string_buffer(256))  # all zero: only asks
    return {
        "wall_ns": time.time_ns(),
        "monotonic_ns": time.monotonic_ns(),
        "boot_ns": time.clock_gettime_ns(time.CLOCK_BOOTTIME),
        "wall_clock_synchronised": 0 <= state < _CLOCK_NOT_SET,
        "boot_id": _read("/proc/sys/kernel/random/boot_id"),
        "source": _read("/sys/devices/system/clocksource/clocksource0/current_clocksource"),
    }


def _read(path: str) -> str:
    try:
        return Path(path).read_text().strip()
    except OSError:
        return "unknown"


def git_commit(root: Path = Path(__file__).parent) -> str:
    """The commit of this code, with `-dirty` when files differ from it; `unknown` outside a checkout."""
    command = ["git", "-C", str(root), "describe", "--always", "--abbrev=40", "--dirty", "--exclude=*"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=5, check=True)
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return done.stdout.strip()
