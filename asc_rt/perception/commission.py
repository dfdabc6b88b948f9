"""`asc perceive CELL --background`: what each camera sees in the empty cell, once, before the cell may see people."""

from __future__ import annotations

import math
import queue
import time
from contextlib import suppress
from typing import Any

import numpy as np

from asc_rt.config import Cell
from asc_rt.core.system import System
from asc_rt.core.types import Vector
from asc_rt.perception import background
from asc_rt.perception.background import Background, BackgroundError, belongs_to
from asc_rt.perception.cameras import CameraError, Frames, Opened, Reader, grid_of, open_all
from asc_rt.perception.grid import View, rays_of
from drivers.cameras.base import Depth
from drivers.cameras.watch import CameraFault, Watch

PATIENCE = 4.0  # times the nominal time, for the frames to come


class CommissionError(Exception):
    """The backgrounds cannot be made; says what to do. Nothing was written."""


def commission(cell: Cell, arm_deg: str, add: bool) -> dict[str, Any]:
    """Write the background of every camera of the cell and say what they see. `arm_deg`: "q1,q2,..."; `add`: keep what
    the files know already where the arm stands before it now. CommissionError."""
    options = cell.perception
    assert options is not None
    q = _joints(arm_deg, cell.params.n)
    for camera in options.cameras:
        if camera.background.exists() and not add:
            more = "--add to learn what the arm hid; remove it to begin anew"
            raise CommissionError(f"{camera.background} exists; {more}")
    try:
        opened = open_all(options, ())
    except CameraError as error:
        raise CommissionError("; ".join(error.lines)) from error
    frames = _frames(opened)
    learnt = [_learn(one, taken, cell, q, options.margin) for one, taken in zip(opened, frames, strict=True)]
    if add:
        learnt = [_with_known(one, depth) for one, depth in zip(opened, learnt, strict=True)]
    grid = grid_of(options)
    views = [one.view(grid, depth) for one, depth in zip(opened, learnt, strict=True)]
    for one, depth in zip(opened, learnt, strict=True):
        Background(depth, belongs_to(one.info, one.options.digest)).save(one.options.background)
    return _told(cell, opened, views)


def _joints(arm_deg: str, n: int) -> Vector:
    try:
        q = np.radians([float(word) for word in arm_deg.split(",")])
    except ValueError:
        q = np.zeros(0)
    if q.shape != (n,) or not np.isfinite(q).all():
        raise CommissionError(f"--arm-deg: {arm_deg!r} is not {n} angles in degrees with commas between them")
    return q


def _frames(opened: list[Opened]) -> list[list[Depth]]:
    """FRAMES of every camera, all read at once, and all in order."""
    frames: Frames = queue.SimpleQueue()
    watches, taken = [Watch(one.info) for one in opened], [list[Depth]() for _ in opened]
    slowest_ns = max(one.info.period_ns for one in opened)
    deadline = time.monotonic() + PATIENCE * background.FRAMES * slowest_ns * 1e-9
    faults: list[str] = []
    readers = [Reader(i, one, frames, faults.append) for i, one in enumerate(opened)]
    try:
        while min(map(len, taken)) < background.FRAMES:
            if faults or time.monotonic() > deadline:
                counts = ", ".join(f"{len(t)} of {one.options.name}" for one, t in zip(opened, taken, strict=True))
                raise CommissionError(f"{'; '.join(faults) or 'the cameras are too slow'}; frames that came: {counts}")
            with suppress(queue.Empty):
                i, frame = frames.get(timeout=0.1)
                if fault := watches[i].look(frame):
                    raise CommissionError(f"camera {opened[i].options.name}: {_text(fault)}; mend it first")
                taken[i].append(frame.depth)
    finally:
        for reader in readers:
            reader.close()
    return taken


def _learn(one: Opened, frames: list[Depth], cell: Cell, q: Vector, margin: float) -> Depth:
    T, rays = one.options.pose.pose(), rays_of(one.info.intrinsics)
    return background.learn(frames, rays, T, one.info.unit_m, System(cell.params).model, q, margin)


def _text(fault: CameraFault) -> str:
    return str(fault.name).replace("|", ", ")


def _with_known(one: Opened, depth: Depth) -> Depth:
    try:
        known = background.load(one.options.background, one.info, one.options.digest)
    except BackgroundError as error:
        raise CommissionError(str(error)) from error
    return background.merged(known.depth, depth)


def _told(cell: Cell, opened: list[Opened], views: list[View]) -> dict[str, Any]:
    human = cell.params.human
    coverage = background.coverage(views)
    return {
        "files": [str(one.options.background) for one in opened],
        "known": {
            one.options.name: round(background.known(view.background), 4)
            for one, view in zip(opened, views, strict=True)
        },
        "coverage": math.floor(1e4 * coverage) / 1e4,
        "slow_below": human.slow_coverage,
        "stop_below": human.least_coverage,
        "ok": coverage >= human.slow_coverage,
    }
