"""`asc bench`: what one decision costs, and how punctually a loop of this process wakes up.

`step`: one `step` after the other, caches warm, for 1, 10 and 50 active pairs. `cycle`: the same step inside a loop of
the cell's period at real-time priority, where everything has gone cold since the last cycle: the figure that counts.
"""

from __future__ import annotations

import dataclasses
import os
import platform
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from asc_rt import realtime
from asc_rt.config import load_cell
from asc_rt.core.params import Params
from asc_rt.core.step import step
from asc_rt.core.system import System, initial
from asc_rt.core.types import (
    MAX_CAPSULES,
    CoreState,
    CycleInputs,
    EventKind,
    Goal,
    Health,
    HumanState,
    JointState,
    Matrix,
    OperatorEvent,
    RobotFlag,
    vector,
)
from asc_rt.core.warm import warm_up

PAIRS = (1, 10, 50)
REPETITIONS = 2000
CYCLES = 750  # 6 s of 8 ms
WARM_CYCLES = 50
FAR, NEAR = 1.5, 0.9  # m from the robot's axis, where the capsules of the bench stand
SWING = 0.1  # rad, so little that the pairs stay the same

Row = dict[str, Any]


def machine() -> str:
    """The machine in one line: figures without it mean nothing."""
    info = Path("/proc/cpuinfo").read_text().splitlines()
    model = next(
        (line.partition(":")[2].strip() for line in info if line.startswith("model name")), "unknown processor"
    )
    return f"{os.cpu_count()} x {model}, {platform.system()} {platform.release()}, Python {platform.python_version()}"


def bench_step(params: Params) -> list[Row]:
    """Median and p99 of one step in us, for each of PAIRS."""
    rows = []
    for pairs in PAIRS:
        scene = Scene(params, pairs)
        times = np.array([timed(scene) for _ in range(REPETITIONS)])
        rows += _rows(f"pairs_{pairs}", times, params.period_ns)
    return rows


def bench_cycle(params: Params, priority: int, cpu: int | None) -> tuple[list[Row], list[str]]:
    """Wake-up latency and step time inside the cell's period; and what real-time set-up was not possible."""
    scene = Scene(params, PAIRS[1])
    report = realtime.set_up(priority, cpu)
    wake, spent = [], []
    due_ns = time.monotonic_ns()
    for _ in range(CYCLES):
        due_ns += params.period_ns
        time.sleep(max(0, due_ns - time.monotonic_ns()) * 1e-9)
        wake.append(time.monotonic_ns() - due_ns)
        spent.append(timed(scene))
    rows = _rows("wake", np.array(wake[WARM_CYCLES:]), params.period_ns)
    rows += _rows("step_in_loop", np.array(spent[WARM_CYCLES:]), params.period_ns)
    return rows, report["missing"]


def run(what: str, cell_name: str) -> dict[str, Any]:
    """Everything that `asc bench` prints. `ratio` is the share of the cell's period."""
    cell = load_cell(cell_name)
    rows: list[Row] = []
    missing: list[str] = []
    if what in ("step", "all"):
        rows += bench_step(cell.params)
    if what in ("cycle", "all"):
        cycle_rows, missing = bench_cycle(cell.params, cell.realtime.priority, cell.realtime.cpu)
        rows += cycle_rows
    return {"machine": machine(), "missing": missing, "rows": rows}


# --- what is measured ------------------------------------------------------------------------------------------------


class Scene:
    """A robot that turns its last joint to and fro among people, with `pairs` active pairs."""

    def __init__(self, params: Params, pairs: int) -> None:
        self.human = _crowd(MAX_CAPSULES)
        self.system = System(_with_pairs(params, pairs, self.human))
        warm_up(self.system)
        self._moves = self._run()

    def next(self) -> tuple[CoreState, CycleInputs]:
        """The state and the inputs of the next cycle."""
        return next(self._moves)

    def _run(self) -> Iterator[tuple[CoreState, CycleInputs]]:
        """An ideal robot: each sample is the last set-point."""
        params, state, goal = self.system.params, initial(self.system), Goal(1, vector(_middle(self.system.params)))
        for tick in range(1_000_000_000):
            if state.reached_id == goal.id:
                swing = SWING * (-1) ** goal.id
                goal = Goal(goal.id + 1, vector(_middle(params) + np.eye(params.n)[-1] * swing))
            events = (OperatorEvent(tick, EventKind.ARM),) if tick else ()
            x = _inputs(params, state, self.human, tick, goal, events)
            yield state, x
            state, _ = step(self.system, state, x)


def timed(scene: Scene) -> int:
    """ns of one step."""
    state, x = scene.next()
    began_ns = time.perf_counter_ns()
    step(scene.system, state, x)
    return time.perf_counter_ns() - began_ns


def _inputs(
    params: Params, state: CoreState, human: HumanState, tick: int, goal: Goal, events: tuple[OperatorEvent, ...]
) -> CycleInputs:
    q = state.q_cmd if tick else vector(_middle(params))
    zero = vector(np.zeros(params.n))
    joint = JointState(tick, tick, tick, q, state.dq_cmd, zero, RobotFlag.READY | RobotFlag.SERVO_ON, 0, True)
    human = dataclasses.replace(human, seq=tick + 1, calibration_hash=params.human.calibration_hash)
    return CycleInputs(tick, tick, params.period_ns, joint, human, 0, False, goal, events, 0, False)


def _middle(params: Params) -> np.ndarray[Any, np.dtype[np.float64]]:
    return 0.5 * (np.array(params.robot.q_min) + np.array(params.robot.q_max)) * 0.5


def _crowd(count: int) -> HumanState:
    """Upright capsules in a half circle, each at a distance of its own, so that every number of pairs can be had."""
    angle = np.linspace(-1.5, 1.5, count)
    radius = np.linspace(NEAR, FAR, count)
    foot: Matrix = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(count)])
    zeros = vector(np.zeros((count, 3)))
    return HumanState(
        t_capture_ns=0,
        seq=0,
        sensor_id=0,
        calibration_hash=0,
        health=Health.OK,
        coverage=1.0,
        empty_certified=True,
        p0=vector(foot),
        p1=vector(foot + [0.0, 0.0, 1.0]),
        v0=zeros,
        v1=zeros,
        radius=vector(np.full(count, 0.05)),
        position_bound=vector(np.zeros(count)),
        velocity_bound=vector(np.zeros(count)),
        visibility=np.zeros(count, dtype=np.int64),
    )


def _with_pairs(params: Params, pairs: int, human: HumanState) -> Params:
    """`params` with an activation distance well between that of the last wanted pair and that of the next one."""
    edges = _reach(params, pairs, human), _reach(params, pairs + 1, human)
    return _activated(params, 0.5 * sum(edges))


def _reach(params: Params, pairs: int, human: HumanState) -> float:
    """The least activation distance that makes `pairs` pairs active, m."""
    low, high = 0.0, 10.0
    while high - low > 1e-3:
        middle = 0.5 * (low + high)
        enough = _count(_activated(params, middle), human) >= pairs
        low, high = (low, middle) if enough else (middle, high)
    return high


def _activated(params: Params, distance: float) -> Params:
    return dataclasses.replace(params, safety=dataclasses.replace(params.safety, activation_distance=distance))


def _count(params: Params, human: HumanState) -> int:
    system = System(params)
    x = _inputs(params, initial(system), human, 0, Goal(1, vector(_middle(params))), ())
    return step(system, initial(system), x)[1].decision.pair_count


def _rows(name: str, times_ns: np.ndarray[Any, np.dtype[np.int64]], period_ns: int) -> list[Row]:
    reference = period_ns * 1e-3
    found = {"median": np.median(times_ns) * 1e-3, "p99": np.percentile(times_ns, 99) * 1e-3}
    return [
        {
            "name": f"{name}_{kind}",
            "value": round(float(value), 2),
            "unit": "us",
            "reference": reference,
            "ratio": round(float(value) / reference, 5),
        }
        for kind, value in found.items()
    ]
