"""The one file of a calibration result: numbers with error bars, what they belong to, how long they hold, and a seal.

JSON. `hash` is the SHA-256 of the canonical form of all else (keys sorted, no blanks, shortest round-trip floats), so a
changed digit is found. Whoever loads a file gets a result that is accepted, valid today and belongs to his device, or
`CalibrationError` with one line per fault. Nothing here needs more than numpy: the control process loads it.

A pose is spelled `T_parent_child`: p_parent = R p_child + t. Its value is x y z (m) and the quaternion qx qy qz qw
(scalar last); its covariance is over (dx dy dz, wx wy wz), m and rad, with t_true = t + d, R_true = exp([w]) R: both
perturbations in the parent's axes.
"""

from __future__ import annotations

import hashlib
import json
import math
import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import date, timedelta
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from calibration.geometry import matrix_from_quaternion, quaternion_from_matrix

FORMAT = 1
VALID_DAYS = 90  # ASSUMED: and any bump, change of firmware or of mode ends it sooner
CONVENTION = "T_parent_child; quaternion x y z w; covariance in the parent's axes, translation m before rotation rad"
POSE = {"x": "m", "y": "m", "z": "m", "qx": "1", "qy": "1", "qz": "1", "qw": "1"}
POSE_ERROR = ("x", "y", "z", "wx", "wy", "wz")
KINDS: dict[str, tuple[dict[str, str], tuple[str, ...]]] = {  # value names with units, what the covariance is over
    "intrinsics": (
        dict.fromkeys(("fx", "fy", "cx", "cy"), "px") | dict.fromkeys(("k1", "k2", "p1", "p2", "k3"), "1"),
        ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"),
    ),
    "hand-eye": (POSE, POSE_ERROR),
    "tool": (dict.fromkeys(("x", "y", "z"), "m"), ("x", "y", "z")),
    "payload": ({"mass": "kg"} | dict.fromkeys(("x", "y", "z"), "m"), ("mass", "x", "y", "z")),
    "time-offset": ({"offset": "s"}, ("offset",)),
}


class CalibrationError(Exception):
    """A calibration that must not be used, or data that allow none. `lines`: one per fault."""

    def __init__(self, lines: Sequence[str]) -> None:
        super().__init__("\n".join(lines))
        self.lines = tuple(lines)


def software() -> dict[str, str]:
    """What computes here."""
    return {"python": platform.python_version(), "numpy": version("numpy"), "asc-rt": version("asc-rt")}


@dataclass(frozen=True, slots=True)
class Result:
    kind: str  # of KINDS
    frame: str  # "T_base_cam", "cam", "T_flange_tcp", "flange", "cam-robot"
    value: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]  # k x k over KINDS[kind][1]
    method: str
    quality: dict[str, Any] = field(default_factory=dict)  # rms, chi2_dof, holdout, coverage, condition ...
    reasons: tuple[str, ...] = ()  # why it is not accepted; none: accepted
    serials: dict[str, str] = field(default_factory=dict)  # camera, robot ...
    mode: str = ""  # what the device was set to, "1280x720"
    inputs: dict[str, str] = field(default_factory=dict)  # name -> SHA-256 of each file used
    software: dict[str, str] = field(default_factory=software)
    operator: str = ""
    valid_from: str = field(default_factory=lambda: date.today().isoformat())
    valid_until: str = field(default_factory=lambda: (date.today() + timedelta(days=VALID_DAYS)).isoformat())

    @property
    def accepted(self) -> bool:
        return not self.reasons

    @property
    def sigma(self) -> np.ndarray:
        """(k,) standard deviations, in the order of the covariance."""
        return np.sqrt(np.diag(np.array(self.covariance)))

    @property
    def digest(self) -> bytes:
        """32 bytes: the content hash, which human messages carry."""
        return hashlib.sha256(_canonical(self._tree())).digest()

    def _tree(self) -> dict[str, Any]:
        names, over = KINDS[self.kind]
        return {
            "format": FORMAT,
            **asdict(self),
            "names": list(names),
            "units": list(names.values()),
            "covariance_over": list(over),
            "convention": CONVENTION,
            "accepted": self.accepted,
        }

    def save(self, path: Path) -> None:
        """Write the file, also of a result that is not accepted: it says why."""
        tree = self._tree() | {"hash": self.digest.hex()}
        path.write_text(json.dumps(tree, indent=1, allow_nan=False) + "\n")

    # --- what perception and control ask --------------------------------------------------------------------------

    def camera_matrix(self) -> np.ndarray:
        """(3, 3) px, of intrinsics."""
        fx, fy, cx, cy = self.value[:4]
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])

    def distortion(self) -> np.ndarray:
        """(5,) k1 k2 p1 p2 k3, of intrinsics."""
        return np.array(self.value[4:9])

    def pose(self) -> np.ndarray:
        """(4, 4) homogeneous T_parent_child, of hand-eye."""
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = matrix_from_quaternion(np.array(self.value[3:])), self.value[:3]
        return T

    def position_bound(self, distance: float, k: float = 3.0) -> float:
        """k-sigma bound (m) on where a point `distance` m away from the camera is in the parent's frame.

        k (sigma_t + distance sigma_w) with the largest standard deviations over all directions: at least the exact one
        for any correlation, since the deviation of a sum is at most the sum of the deviations.
        """
        C = np.array(self.covariance)
        return float(k * (_largest(C[:3, :3]) + distance * _largest(C[3:, 3:])))

    def capsule_bounds(self, p0: np.ndarray, p1: np.ndarray, radius: np.ndarray, k: float = 3.0) -> np.ndarray:
        """(m,) m, k-sigma bound on the surface of capsules seen at p0, p1 (m, 3) in the parent's frame."""
        camera = np.array(self.value[:3])
        reach = radius + np.maximum(np.linalg.norm(p0 - camera, axis=1), np.linalg.norm(p1 - camera, axis=1))
        return np.array([self.position_bound(float(distance), k) for distance in reach])


def _largest(covariance: np.ndarray) -> float:
    return math.sqrt(max(float(np.linalg.eigvalsh(covariance)[-1]), 0.0))


def pose_value(T: np.ndarray) -> tuple[float, ...]:
    """Value of a pose result from its homogeneous matrix."""
    return (*(float(v) for v in T[:3, 3]), *(float(v) for v in quaternion_from_matrix(T[:3, :3])))


def rows(matrix: np.ndarray) -> tuple[tuple[float, ...], ...]:
    """A covariance as the file holds it: symmetric to the last bit."""
    return tuple(tuple(float(v) for v in row) for row in (matrix + matrix.T) / 2)


def file_hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def revoke(result: Result, why: str) -> Result:
    """The same numbers, no longer to be used."""
    return replace(result, reasons=(*result.reasons, f"revoked: {why}"))


# --- reading ---------------------------------------------------------------------------------------------------------


def load(
    path: Path, kind: str | None = None, serials: dict[str, str] | None = None, mode: str | None = None,
    today: date | None = None,
) -> Result:  # fmt: skip
    """The result in `path` if it may be used for this device today. CalibrationError: why not, one line per fault.

    `serials` and `mode` are those of the device at hand; None: not compared.
    """
    result = read(path)
    faults = _unusable(result, kind, serials or {}, mode, today or date.today())
    if faults:
        raise CalibrationError([f"{path}: {fault}" for fault in faults])
    return result


def read(path: Path) -> Result:
    """What the file says, accepted or not, if it is whole and of this format. CalibrationError."""
    try:
        tree = json.loads(path.read_bytes())
    except OSError as error:
        raise CalibrationError([f"{path}: cannot be read: {error.strerror}"]) from error
    except ValueError as error:
        raise CalibrationError([f"{path}: no calibration result: it is not JSON; make one by asc calibrate"]) from error
    fault = _malformed(tree)
    if fault:
        raise CalibrationError([f"{path}: {fault}"])
    fields = {name: tree[name] for name in Result.__dataclass_fields__}
    for name in ("value", "reasons"):
        fields[name] = tuple(fields[name])
    fields["covariance"] = tuple(tuple(row) for row in fields["covariance"])
    return Result(**fields)


def _malformed(tree: Any) -> str:
    """The first thing that makes the file none of ours; empty: nothing."""
    if not isinstance(tree, dict) or "format" not in tree:
        return "no calibration result: it has no key 'format'; make one by asc calibrate"
    if tree["format"] != FORMAT:
        return f"format: {tree['format']!r} is unknown; this version reads {FORMAT}"
    said = {key: value for key, value in tree.items() if key != "hash"}
    try:
        if hashlib.sha256(_canonical(said)).hexdigest() != tree.get("hash"):
            return "hash: the content was changed after it was made; calibrate again, or restore the file"
    except ValueError:
        return "value: a number is not finite; calibrate again"
    missing = Result.__dataclass_fields__.keys() - tree.keys()
    if missing:
        return f"{', '.join(sorted(missing))}: missing; calibrate again"
    if tree["kind"] not in KINDS:
        return f"kind: {tree['kind']!r} is unknown; known: {', '.join(KINDS)}"
    names, over = KINDS[tree["kind"]]
    if [tree.get("names"), tree.get("units"), tree.get("convention")] != [
        list(names), list(names.values()), CONVENTION,
    ]:  # fmt: skip
        return "names, units, convention: not those of this kind; calibrate again"
    return _bad_numbers(tree, len(names), len(over))


def _bad_numbers(tree: dict[str, Any], n: int, k: int) -> str:
    try:
        value, C = np.array(tree["value"], float), np.array(tree["covariance"], float)
        for day in ("valid_from", "valid_until"):
            date.fromisoformat(tree[day])
    except (TypeError, ValueError):
        return "value, covariance, dates: not numbers and ISO days; calibrate again"
    if value.shape != (n,) or C.shape != (k, k):
        return f"value, covariance: shapes {value.shape}, {C.shape}; must be ({n},), ({k}, {k})"
    if tree["kind"] == "hand-eye" and abs(np.linalg.norm(value[3:]) - 1) > 1e-6:
        return f"value: the quaternion has length {np.linalg.norm(value[3:]):g}; must be 1"
    least = np.linalg.eigvalsh(C)[0] if np.array_equal(C, C.T) else -1.0
    if least < -1e-12 * max(float(np.trace(C)), 1e-300) or np.diag(C).min() <= 0:
        return "covariance: not symmetric and positive; a result without error bars is none"
    return ""


def _unusable(result: Result, kind: str | None, serials: dict[str, str], mode: str | None, today: date) -> list[str]:
    faults = []
    if kind and result.kind != kind:
        faults.append(f"kind: {result.kind!r}; must be {kind!r}")
    if not result.accepted:
        faults.append(f"accepted: it was refused: {'; '.join(result.reasons)}; calibrate again")
    if today.isoformat() < result.valid_from:
        faults.append(f"valid_from: {result.valid_from} is in the future; check the clock of this PC")
    if today.isoformat() > result.valid_until:
        faults.append(f"valid_until: it expired on {result.valid_until}; calibrate again")
    for device, serial in serials.items():
        if result.serials.get(device) != serial:
            made = result.serials.get(device, "none")
            faults.append(f"serials.{device}: made for {made!r}, this one is {serial!r}; use the file of this device")
    if mode is not None and result.mode != mode:
        faults.append(f"mode: made in {result.mode!r}, the device runs in {mode!r}; calibrate in that mode")
    return faults


def _canonical(tree: dict[str, Any]) -> bytes:
    return json.dumps(tree, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
