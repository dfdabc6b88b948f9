"""What must be the same in simulation and on the hardware: the cell hash."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterator
from pathlib import Path

from asc_rt.config import PACKAGE, Cell
from asc_rt.fingerprint import fingerprint
from asc_rt.synthesis.certificate import file_name

ADDRESS = frozenset({"host", "port", "rmi_port", "interface", "channel", "lock_dir"})  # where the robot is
PERCEPTION = ("sensor", "low", "high", "voxel", "margin", "detection", "digest")  # its cameras are part of the digest
CODE = (PACKAGE, PACKAGE.parent / "drivers")


def cell_hash(cell: Cell) -> str:
    """SHA-256 of all that decides how the arm moves: the meaning of the cell file (robot, tools, safety, people, task,
    control, driver, real time; comments and order do not count), its certificates, our code, and the versions of the
    libraries that compute.

    Left out is where things are: the robot's address, the bus, the log; what is simulated and how; the cell's name.
    """
    said = {
        "params": json.loads(cell.params.canonical()),
        "driver": {key: value for key, value in cell.driver.items() if key not in ADDRESS},
        "goals": cell.goals,
        "uncertified": cell.uncertified,
        "perception": [getattr(cell.perception, key, None) for key in PERCEPTION],
        "realtime": dataclasses.asdict(cell.realtime),
        "certificates": {path.name: _digest(path) for path in _certificates(cell)},
        "code": {path.relative_to(PACKAGE.parent).as_posix(): _digest(path) for path in _sources()},
        "packages": fingerprint()["packages"],
    }
    return hashlib.sha256(json.dumps(said, sort_keys=True, default=bytes.hex).encode()).hexdigest()


def _certificates(cell: Cell) -> Iterator[Path]:
    tools = [cell.params.tool, *(mount.tool for mount in cell.params.changer.mounts)]
    for name in sorted({tool.name for tool in tools}):
        yield cell.certificates / file_name(cell.params.robot.name, name)


def _sources() -> Iterator[Path]:
    for folder in CODE:
        yield from sorted(folder.rglob("*.py"))


def _digest(path: Path) -> str:
    """Empty: there is no such file."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""
