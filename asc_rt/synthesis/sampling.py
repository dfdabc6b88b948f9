"""Sampling of M and M_dot: uniform in joint angles, speeds, and the person's place around a robot capsule.

Chunk i draws from its own stream, SeedSequence(seed, spawn_key=(i,)), and chunks are merged in their order: the result
depends on the seed alone, not on how many workers there were. The kernels hold no GIL, so threads fill all cores.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy as np

from asc_rt.core.robot_model import Arm, RobotModel
from asc_rt.core.types import Matrix
from asc_rt.synthesis import boundary, kernel
from asc_rt.synthesis.draw import Draw, evaluate_all, width
from asc_rt.synthesis.statistics import Statistics

CHUNK = 5000  # samples; 50 ms of work
IN_FLIGHT = 4  # chunks per worker that may wait to be merged

Part = TypeVar("Part")
Progress = Callable[[Iterable[Any], int], Iterable[Any]]  # (parts, how many) -> the parts


@dataclass(frozen=True, slots=True)
class Ranges:
    """Where the samples are drawn and what the certificate is about; all of it is written into it."""

    d_low: float  # m, separation distance; above 0: M_dot grows without bound towards contact
    d_high: float  # m
    v_max: float  # m/s, approach speed up to which k is synthesised
    speed_share: float  # 0..1 of the joint speed limits (and of what can still be stopped before a position limit)
    human_speed: float  # m/s
    human_acceleration: float  # m/s2
    joint_limits: bool  # they belong to U; False: the torque box alone, as in the paper
    links: str  # "tool": its capsules (without a tool those of the last joint); "all": every moving capsule
    obstacle: tuple[float, float, float] | None = None  # m, a fixed point; None: around the capsule


class RangeError(Exception):
    """A range that cannot be sampled or certified: says which figure and what would be right."""


def check(ranges: Ranges, d_min: float, samples: int) -> None:
    """RangeError."""
    r = ranges
    if samples < 1:
        raise RangeError(f"--samples: {samples} is not possible; at least 1")
    if not r.d_low > 0.0:
        raise RangeError(f"d from {r.d_low:g} m: M_dot has no bound where d reaches 0; begin above 0, for example 0.05")
    if not r.d_high > max(r.d_low, d_min):
        raise RangeError(f"d up to {r.d_high:g} m: above its beginning {r.d_low:g} m and d_min {d_min:g} m")
    if r.d_low > d_min > 0.0:
        raise RangeError(f"d from {r.d_low:g} m leaves d_min = {d_min:g} m out; begin there or nearer")
    if not 0.0 < r.speed_share <= 1.0:
        raise RangeError(f"speed share {r.speed_share:g}: above 0, at most 1")
    if not r.v_max > 0.0:
        raise RangeError(f"approach speed up to {r.v_max:g} m/s: above 0")
    if r.human_speed < 0.0 or r.human_acceleration < 0.0:
        raise RangeError("the person's speed and acceleration bounds: 0 or more")


def draw_of(model: RobotModel, tool_capsules: int, ranges: Ranges) -> Draw:
    """What the kernels draw from."""
    joint = model.capsules.joint
    moving = np.flatnonzero(joint >= 0)
    if ranges.links == "tool":
        own = np.arange(len(joint) - tool_capsules, len(joint))
        moving = own if tool_capsules else moving[joint[moving] == joint.max()]
    return Draw(
        moving,
        ranges.d_low,
        ranges.d_high,
        ranges.speed_share,
        ranges.human_speed,
        kernel.Conditions(ranges.human_acceleration, ranges.joint_limits),
        np.array(ranges.obstacle if ranges.obstacle else ()),
    )


@dataclass(frozen=True, slots=True)
class Survey:
    """Chunks of M and M_dot over the ranges."""

    arm: Arm
    draw: Draw
    seed: int
    samples: int
    M_floor: float
    v_max: float

    def part(self, index: int) -> Statistics:
        """Statistics of one chunk; see `Statistics.counts` for what is counted."""
        units = units_of(self.arm, self.seed, index, self.samples)
        found = evaluate_all(self.arm, self.draw, units, True)
        d, v, M = found[:, kernel.D], -found[:, kernel.D_DOT], found[:, kernel.RADIUS]
        ball, falling = found[:, kernel.BALL], -found[:, kernel.RADIUS_LOW]
        steepest = np.maximum(-found[:, kernel.BALL_LOW], found[:, kernel.BALL_HIGH])
        above = M - self.M_floor > 0.0
        kept = (d >= self.draw.d_low) & (d <= self.draw.d_high)  # a fixed point may be elsewhere
        approach = kept & (v > 0.0) & (found[:, kernel.D_DOT_ROBOT] < 0.0)
        covered = approach & above & (v <= self.v_max)
        out = Statistics()
        out.count(samples=kept, approaching=approach, covered=covered, M_nonpositive=kept & (M <= 0.0))
        out.count(ball_nonpositive=kept & (ball <= 0.0), under_floor=approach & ~above)
        out.count(too_fast=approach & (v > self.v_max))
        out.see("M", M[kept], units[kept], histogram=True)
        out.see("ball", ball[kept], units[kept], histogram=True)
        out.see("falling", falling[kept], units[kept], histogram=True)
        out.see("steepest", steepest[kept], units[kept], histogram=True)
        out.see("approach_M", M[approach], units[approach])
        out.see("covered_M", M[covered], units[covered])
        out.see("ratio", falling[covered] / M[covered], units[covered], histogram=True)
        return out


@dataclass(frozen=True, slots=True)
class Pull:
    """Chunks of states on phi = 0."""

    arm: Arm
    draw: Draw
    seed: int
    samples: int
    k: float  # of phi*; deceleration a of phi_b
    d_min: float
    M_floor: float
    v_max: float
    stopping: bool  # phi_b

    def part(self, index: int) -> Statistics:
        units = units_of(self.arm, self.seed, index, self.samples)
        found = boundary.pull_all(self.arm, self.draw, units, self.k, self.d_min, self.M_floor, self.stopping)
        status, margin = found[:, boundary.STATUS], found[:, boundary.MARGIN]
        within = found[:, boundary.SPEED] <= self.v_max
        on = (status == boundary.ON_BOUNDARY) & within
        out = Statistics()
        out.count(on=on, feasible=on & (margin >= 0.0), floor=(status == boundary.UNDER_FLOOR) & within)
        out.see("margin", margin[on], units[on])
        return out


def units_of(arm: Arm, seed: int, index: int, samples: int) -> Matrix:
    """The unit numbers of chunk `index` of `samples`."""
    rows = min(CHUNK, samples - index * CHUNK)
    stream = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=(index,))))
    return stream.random((rows, width(arm.chain.offset.shape[0])))


class Workers(Protocol):
    """Who computes: calls `work` for every index and gives the results in order, with few of them waiting."""

    def __call__(self, work: Callable[[int], Part], count: int) -> Iterator[Part]: ...


def threads(work: Callable[[int], Part], count: int, workers: int = 0) -> Iterator[Part]:
    """On this machine; workers 0: all cores."""
    size = workers or len(os.sched_getaffinity(0))
    with ThreadPoolExecutor(size) as pool:
        waiting: deque[Any] = deque()
        for index in range(count):
            waiting.append(pool.submit(work, index))
            if len(waiting) >= size * IN_FLIGHT:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def quietly(parts: Iterable[Any], count: int) -> Iterable[Any]:
    """No progress is shown."""
    return parts


def collect(task: Survey | Pull, workers: Workers = threads, progress: Progress = quietly) -> Statistics:
    """All chunks of a task, merged."""
    total, count = Statistics(), -(-task.samples // CHUNK)
    for part in progress(workers(task.part, count), count):
        total.merge(part)
    return total
