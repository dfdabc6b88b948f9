"""What a simulated camera does wrong, and when: [[faults]] with at_s, fault, camera ("": all), value, for_s."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from sim_hil.depth_camera import Faults
from sim_hil.person import Array

FLAGS = ("freeze", "silent", "cover", "damage")
LOCKSTEP = ("killed", "no_joints")  # of the whole process and of what it hears: seeing_cell only
KINDS = (*FLAGS, "clock_ms", "shift_mm", "tilt_deg", "turn_deg")


@dataclass(frozen=True, slots=True)
class Fault:
    at_s: float
    fault: str
    camera: str = ""
    value: float = 1.0  # ms that the clock is ahead; mm to the right; degrees down, degrees to the left
    for_s: float = math.inf

    @classmethod
    def parse(cls, entry: object) -> Fault:
        """ValueError: not a fault."""
        known = {field.name for field in fields(cls)}
        if not isinstance(entry, dict) or not {"at_s", "fault"} <= set(entry) <= known:
            raise ValueError(f"a fault is a table with {', '.join(sorted(known))}, not {entry!r}")
        fault = cls(**entry)
        numbers = (fault.at_s, fault.value, fault.for_s)
        if fault.fault not in KINDS or not all(type(n) in (int, float) for n in numbers) or fault.at_s < 0:
            raise ValueError(f"{entry} is no fault; faults: {', '.join(KINDS)}")
        return fault


def struck(script: Sequence[Fault], cameras: Sequence[str], t: float) -> Iterator[tuple[str, Faults, Array]]:
    """(camera, what its wire does wrong, (4, 4) how it has moved in its own frame) of each at script time t (s)."""
    for camera in cameras:
        wrong, moved = Faults(), np.eye(4)
        for one in script:
            if one.camera not in ("", camera) or not one.at_s <= t < one.at_s + one.for_s:
                continue
            if one.fault in FLAGS:
                wrong = replace(wrong, **{one.fault: True})
            elif one.fault == "clock_ms":
                wrong = replace(wrong, clock_ns=round(one.value * 1e6))
            elif one.fault in KINDS:
                moved = moved @ _movement(one.fault, one.value)
        yield camera, wrong, moved


def _movement(kind: str, value: float) -> Array:
    T = np.eye(4)
    if kind == "shift_mm":
        T[0, 3] = value * 1e-3
        return T
    c, s = np.cos(np.radians(value)), np.sin(np.radians(value))
    T[:3, :3] = [[1, 0, 0], [0, c, -s], [0, s, c]] if kind == "tilt_deg" else [[c, 0, -s], [0, 1, 0], [s, 0, c]]
    return T
