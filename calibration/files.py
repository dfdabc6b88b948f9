"""What the commands read: folders of pictures, tables of poses and traces. One line per fault, each with the cure.

A table is CSV with a header whose names carry the units, so that nobody guesses: `x_m` or `x_mm`, `q1_rad` or `q1_deg`.
A pose is T_base_flange: x y z and the quaternion qx qy qz qw (scalar last), or x y z and the fixed-axis angles w p r
that a FANUC pendant shows (R = Rz(r) Ry(p) Rx(w)).
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from calibration import vision
from calibration.geometry import matrix_from_quaternion, pose
from calibration.result import CalibrationError

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
UNITS = {"m": 1.0, "mm": 1e-3, "rad": 1.0, "deg": np.pi / 180, "s": 1.0, "ms": 1e-3, "Nm": 1.0}
NEAREST_DEPTH, FARTHEST_DEPTH = 0.1, 70.0  # m, of the farthest pixel of a depth picture
FARTHEST = 10.0  # m from the robot's base; more are millimetres under a header that says metres
NEAREST = 0.005  # m; a table of lengths none of which is longer holds metres under a header that says millimetres


def pictures(folder: Path) -> dict[str, np.ndarray]:
    """Grey pictures of a folder by file name, in the order of the names."""
    return _read_all(folder, vision.read, "no picture that can be read")


def depths(folder: Path, unit: float) -> dict[str, np.ndarray]:
    """Depth pictures in metres by file name; `unit`: metres per count."""
    images = _read_all(folder, vision.read_depth, "no depth picture; 16 bits, one channel")
    found = {name: unit * image for name, image in images.items()}
    far = max(float(image.max()) for image in found.values())
    if not NEAREST_DEPTH < far < FARTHEST_DEPTH:
        raise CalibrationError([f"{folder}: the farthest depth is {far:.4g} m; is --unit-mm the camera's?"])
    return found


def _read_all(folder: Path, read: Callable[[Path], np.ndarray | None], fault: str) -> dict[str, np.ndarray]:
    if not folder.is_dir():
        raise CalibrationError([f"{folder}: no folder of pictures"])
    files = [path for path in sorted(folder.iterdir()) if path.suffix.lower() in PICTURES]
    if not files:
        raise CalibrationError([f"{folder}: no pictures; one of {', '.join(PICTURES)} for each view"])
    images = {path.name: read(path) for path in files}
    broken = [f"{folder / name}: {fault}" for name, image in images.items() if image is None]
    if broken:
        raise CalibrationError(broken)
    return {name: image for name, image in images.items() if image is not None}


class Table:
    """A CSV file with its header; numbers come out in m, rad, s, Nm."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with path.open(newline="") as file:
                lines = [[cell.strip() for cell in line] for line in csv.reader(file) if any(line)]
        except (OSError, UnicodeDecodeError, csv.Error) as error:
            why = error.strerror if isinstance(error, OSError) else "it is no CSV text"
            raise CalibrationError([f"{path}: cannot be read: {why}"]) from error
        if len(lines) < 2:
            raise CalibrationError([f"{path}: no table; a header line and one line for each sample"])
        self.header, self.lines = lines[0], lines[1:]
        ragged = [i for i, line in enumerate(self.lines, 2) if len(line) != len(self.header)]
        if ragged:
            raise CalibrationError(
                [f"{path}: line {i}: not the {len(self.header)} cells of the header" for i in ragged]
            )

    def words(self, name: str) -> list[str]:
        if name not in self.header:
            raise CalibrationError([f"{self.path}: column {name!r} is missing; the header says {self._said()}"])
        at = self.header.index(name)
        return [line[at] for line in self.lines]

    def numbers(self, names: Iterable[str], units: tuple[str, ...] = ()) -> np.ndarray:
        """(n, k) of the columns `names`, each in one of `units`, converted to the unit of the SI."""
        columns, faults = [], []
        for name in names:
            spelled = [f"{name}_{unit}" for unit in units] if units else [name]
            found = next((i for i, word in enumerate(self.header) if word in spelled), None)
            if found is None:
                faults.append(f"{self.path}: column {' or '.join(spelled)} is missing; the header says {self._said()}")
                continue
            factor = UNITS[self.header[found].rpartition("_")[2]] if units else 1.0
            columns.append(factor * self._column(found, faults))
        if faults:
            raise CalibrationError(faults)
        return np.stack(columns, 1)

    def has(self, name: str) -> bool:
        return any(word == name or word.rpartition("_")[0] == name for word in self.header)

    def _column(self, at: int, faults: list[str]) -> np.ndarray:
        values = np.full(len(self.lines), np.nan)
        for i, line in enumerate(self.lines):
            with suppress(ValueError):
                values[i] = float(line[at])
            if not np.isfinite(values[i]):
                faults.append(f"{self.path}: line {i + 2}: {self.header[at]}: {line[at]!r} is no number")
        return values

    def _said(self) -> str:
        return ", ".join(self.header)

    # --- what the columns mean ----------------------------------------------------------------------------------

    def positions(self) -> np.ndarray:
        """(n, 3) m."""
        p = self.numbers("xyz", ("m", "mm"))
        unit = self.header[[word.rpartition("_")[0] for word in self.header].index("x")].rpartition("_")[2]
        if np.abs(p).max() > FARTHEST:
            far = f"{np.abs(p).max() / UNITS[unit]:.4g} {unit} is {np.abs(p).max():.4g} m"
            raise CalibrationError([f"{self.path}: x, y, z: {far}; are these millimetres? the header says {unit}"])
        if unit == "mm" and np.abs(p).max() < NEAREST:
            near = f"none is longer than {1e3 * np.abs(p).max():.3g} mm"
            raise CalibrationError([f"{self.path}: x, y, z: {near}; are these metres? the header says mm"])
        return p

    def poses(self) -> np.ndarray:
        """(n, 4, 4) T_base_flange."""
        t = self.positions()
        if self.has("w"):
            angles = self.numbers("wpr", ("deg", "rad"))
            return pose(Rotation.from_euler("xyz", angles).as_matrix(), t)
        q = self.numbers(("qx", "qy", "qz", "qw"))
        length = np.linalg.norm(q, axis=1)
        bad = np.flatnonzero(np.abs(length - 1) > 1e-3)
        if len(bad):
            lines = [f"{self.path}: line {i + 2}: the quaternion has length {length[i]:.4g}; must be 1" for i in bad]
            raise CalibrationError(lines)
        return pose(matrix_from_quaternion(q), t)

    def times(self) -> np.ndarray:
        """(n,) s."""
        return self.numbers("t", ("s", "ms"))[:, 0]

    def joints(self, dof: int) -> np.ndarray:
        """(n, dof) rad."""
        q = self.numbers([f"q{i + 1}" for i in range(dof)], ("rad", "deg"))
        if np.abs(q).max() > 4 * np.pi:
            large = f"{np.abs(q).max():.4g} rad is more than two turns"
            raise CalibrationError(
                [f"{self.path}: q1..q{dof}: {large}; are these degrees? name the columns q1_deg ..."]
            )
        return q

    def torques(self, dof: int) -> np.ndarray:
        """(n, dof) Nm."""
        return self.numbers([f"tau{i + 1}" for i in range(dof)], ("Nm",))


def write(path: Path, header: str, rows: Iterable[Iterable[object]]) -> None:
    """A table as `Table` reads it; floats keep every digit."""
    with path.open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow(header.split(","))
        out.writerows([repr(float(v)) if isinstance(v, float | np.floating) else v for v in row] for row in rows)
