"""Is the arm where it was left? A file keeps the pose of the last clean end; while a session runs there is none."""

from __future__ import annotations

import json
import math
from pathlib import Path

from asc_rt.core.types import Vector
from drivers.base import Finding
from drivers.can.arm import Joint

MARGIN = 0.1  # rad beyond the limits: no arm is there, its zero is wrong
MOVED = math.radians(2.0)


def check(path: str, q: Vector, joints: tuple[Joint, ...]) -> Finding:
    """An encoder that lost or changed its zero would drive the arm into a person or itself."""
    out = [f"axis {i + 1} at {a:.2f} rad" for i, (a, j) in enumerate(zip(q, joints, strict=True))
           if not j.q_min - MARGIN <= a <= j.q_max + MARGIN]  # fmt: skip
    if out:
        return Finding("home", False, "outside its range: " + ", ".join(out), "check the zero of these axes")
    if not path:
        return Finding("home", True, "inside the ranges; no driver.home to compare with")
    try:
        left = json.loads(Path(path).read_text())["q"]
        moved = [f"axis {i + 1} by {a - b:+.3f} rad" for i, (a, b) in enumerate(zip(q, left, strict=True))
                 if abs(a - b) > MOVED]  # fmt: skip
    except (OSError, ValueError, KeyError, TypeError):
        fix = f'look whether the arm shows its true pose, then write it: {{"q": [...]}} in {path}'
        return Finding("home", False, f"the last session did not end cleanly: no pose in {path}", fix)
    fix = f"compare the true pose with what is told; if it is right, write it into {path}"
    return Finding("home", not moved, ", ".join(moved) or "where the last session left it", fix)


def begin(path: str) -> None:
    """A session runs: until its clean end the pose is not known."""
    if path:
        Path(path).unlink(missing_ok=True)


def end(path: str, q: Vector) -> None:
    if path:
        Path(path).write_text(json.dumps({"q": [float(a) for a in q]}))
