"""`asc bench`: what one decision costs, and how punctually a loop of this process wakes up.

`step`: torque control, Panda, for 1, 10 and 50 active pairs among 20 human capsules, one after the other, caches warm:
    pairs_N     the whole `step`, from frozen inputs to command and record
    rows_qp_N   of it the safety rows (abstraction, M, M_dot, index) and the QP
  and what a fresh process takes until it could touch the robot, kernels loaded from their cache.
`cycle`: the step of the cell inside a loop of its period at real-time priority, where everything has gone cold since
the last cycle: the figure that counts.
"""

from __future__ import annotations

import dataclasses
import os
import platform
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from asc_rt import realtime
from asc_rt.config import load_arm, load_cell
from asc_rt.core.levels import LEVELS
from asc_rt.core.params import Params
from asc_rt.core.rows import rows
from asc_rt.core.safe_control import solve
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
# Goals on the project's 2-core machine; OSCBF on frax/JAX there: 65, 70, 99 us, 4 s import, 4 s compile, 690 MB.
STEP_MEDIAN_US, STEP_P99_US = {1: 50.0, 10: 65.0, 50: 95.0}, 150.0
START_S, START_MB = 2.0, 200.0
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
    """Median and p99 in us, for each of PAIRS, of one step and of its rows with the QP."""
    whole, part = [], []
    for pairs in PAIRS:
        scene = Scene(params, pairs)
        goal = {"median": STEP_MEDIAN_US[pairs], "p99": STEP_P99_US}
        whole += _rows(f"pairs_{pairs}", np.array([timed(scene) for _ in range(REPETITIONS)]), goal)
        part += _rows(f"rows_qp_{pairs}", np.array([_timed_rows(scene) for _ in range(REPETITIONS)]), goal)
    return whole + part


def bench_start(cell_name: str) -> list[Row]:
    """Wall time and greatest memory of a fresh process that imports the controller, loads the cell and warms up."""
    code = (
        "import resource, sys, time; began = time.perf_counter(); import asc_rt.control\n"
        "from asc_rt import config; from asc_rt.core.system import System; from asc_rt.core.warm import warm_up\n"
        "warm_up(System(config.load_cell(sys.argv[1]).params))\n"
        "print(time.perf_counter() - began, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)"
    )
    command = [sys.executable, "-c", code, cell_name]
    for _ in range(2):  # the first run may have to compile
        told = subprocess.run(command, capture_output=True, text=True, check=True, cwd=Path(__file__).parents[1]).stdout
    seconds, megabytes = (float(word) for word in told.split()[-2:])
    return [_row("start", seconds, "s", START_S), _row("start_memory", megabytes, "MB", START_MB)]


def reference_arm(params: Params) -> Params:
    """`params` for a torque-controlled Panda, the arm that the references below were measured with."""
    robot, tool = load_arm("panda", "ee1")
    return dataclasses.replace(params, robot=robot, tool=tool, control="torque", period_ns=1_000_000)


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
    period = dict.fromkeys(("median", "p99"), params.period_ns * 1e-3)
    made = _rows("wake", np.array(wake[WARM_CYCLES:]), period)
    made += _rows("step_in_loop", np.array(spent[WARM_CYCLES:]), period)
    return made, report["missing"]


def run(what: str, cell_name: str) -> dict[str, Any]:
    """Everything that `asc bench` prints. `ratio` is to `reference`: the goals above, or the cell's period."""
    cell = load_cell(cell_name)
    made: list[Row] = []
    missing: list[str] = []
    if what in ("step", "all"):
        made += bench_step(reference_arm(cell.params)) + bench_start(cell_name)
    if what in ("cycle", "all"):
        cycle_rows, missing = bench_cycle(cell.params, cell.realtime.priority, cell.realtime.cpu)
        made += cycle_rows
    return {"machine": machine(), "missing": missing, "rows": made}


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


def _timed_rows(scene: Scene) -> int:
    """ns of the rows and the QP of one step."""
    state, x = scene.next()
    system = scene.system
    u_ref = LEVELS[system.params.control].reference(system, state)
    began_ns = time.perf_counter_ns()
    found = rows(system, state, x)
    solve(u_ref, found.C, found.floor, found.base, found.U, system.bounds.ddq_max)
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


def _rows(name: str, times_ns: np.ndarray[Any, np.dtype[np.int64]], reference_us: dict[str, float]) -> list[Row]:
    found = {"median": np.median(times_ns) * 1e-3, "p99": np.percentile(times_ns, 99) * 1e-3}
    return [_row(f"{name}_{kind}", float(value), "us", reference_us[kind]) for kind, value in found.items()]


def _row(name: str, value: float, unit: str, reference: float) -> Row:
    ratio = round(value / reference, 5)
    return {"name": name, "value": round(value, 2), "unit": unit, "reference": reference, "ratio": ratio}
