"""`asc bench`: what one decision costs, and how punctually a loop of this process wakes up.

`step`: torque control, Panda, for 1, 10 and 50 active pairs, one state after the other, caches warm:
    pairs_N   reference, safety rows, QP and torque; the nearest person is too near and what is wanted goes for them as
              hard as the arm can, so the QP is solved every time. OSCBF's figures below are of the same: nominal
              controller and filter
    free_N    the same with the reference of the goal, which keeps every row: no QP
    whole_N   the whole `step`, from frozen inputs to command and record, mode and checks of the person's data included
  and what a fresh process takes until it could touch the robot, kernels loaded from their cache.
`cycle`: the step of the cell inside a loop of its period at real-time priority, where everything has gone cold since
the last cycle: the figure that counts.
`sampling`: states for which `asc certify` computes M and its rate in a second; more is better.
`perception`: see `asc_rt.perception.bench`.
`log`: see `logs.bench`.
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
from asc_rt.core import robot_model
from asc_rt.core.fusion import heard
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
    Vector,
    vector,
)
from asc_rt.core.warm import warm_up

PAIRS = (1, 10, 50)
REPETITIONS = 2000
SAMPLES, SAMPLES_PER_S = 100_000, 50_000.0  # of M and its rate; the goal: 100 000 in 2 s on 2 cores
CYCLES = 750  # 6 s of 8 ms
WARM_CYCLES = 50
# Goals on the project's 2-core machine; OSCBF on frax/JAX there: 65, 70, 99 us, 4 s import, 4 s compile, 690 MB.
STEP_MEDIAN_US, STEP_P99_US = {1: 50.0, 10: 65.0, 50: 95.0}, 150.0
START_S, START_MB = 2.0, 200.0
FAR, NEAR = 1.5, 0.9  # m from the robot's axis, where the capsules of the bench stand
INSIDE = 0.01  # m under d_min
SWING = 0.1  # rad, so little that the pairs stay the same
LEAST_GAP = 0.002  # m; the moving arm must not bring one more pair into play

Row = dict[str, Any]


def machine() -> str:
    """The machine in one line: figures without it mean nothing."""
    info = Path("/proc/cpuinfo").read_text().splitlines()
    model = next(
        (line.partition(":")[2].strip() for line in info if line.startswith("model name")), "unknown processor"
    )
    return f"{os.cpu_count()} x {model}, {platform.system()} {platform.release()}, Python {platform.python_version()}"


def bench_step(params: Params) -> list[Row]:
    """Median and p99 in us, for each of PAIRS, of the filter with and without the QP, and of one step."""
    made = []
    for name, one in (("pairs", _timed_conflict), ("free", _timed_free), ("whole", timed)):
        for pairs in PAIRS:
            scene = Scene(params, pairs, in_conflict=name == "pairs")
            goal = {"median": STEP_MEDIAN_US[pairs], "p99": STEP_P99_US}
            made += _rows(f"{name}_{pairs}", np.array([one(scene) for _ in range(REPETITIONS)]), goal)
    return made


def bench_start(cell_name: str) -> list[Row]:
    """Wall time and greatest memory of a fresh process that imports the controller, loads the cell and warms up."""
    code = (
        "import sys, time; began = time.perf_counter(); from asc_rt import footprint, realtime\n"
        "realtime.one_blas_thread(); footprint.lean_start(); from asc_rt import control, config\n"
        "control.ready(config.load_cell(sys.argv[1]))\n"
        "seconds = time.perf_counter() - began\n"
        # not getrusage's, which counts what the process was before it ran this program, too
        "print(seconds, int(open('/proc/self/status').read().partition('VmHWM:')[2].split()[0]) / 1024)"
    )
    command = [sys.executable, "-c", code, cell_name]
    for _ in range(2):  # the first run may have to compile
        told = subprocess.run(command, capture_output=True, text=True, check=True, cwd=Path(__file__).parents[1]).stdout
    seconds, megabytes = (float(word) for word in told.split()[-2:])
    return [row("start", seconds, "s", START_S), row("start_memory", megabytes, "MB", START_MB)]


def reference_arm(params: Params) -> Params:
    """`params` for a torque-controlled Panda, the arm that the references below were measured with."""
    robot, tool = load_arm("panda", "ee1")
    return dataclasses.replace(params, robot=robot, tool=tool, control="torque", period_ns=1_000_000)


def bench_sampling(params: Params) -> list[Row]:
    """What `asc certify` draws in a second: M and its rate for states within torque and joint limits."""
    from asc_rt.synthesis import sampling
    from asc_rt.synthesis.certify import request_of

    safety = params.safety
    ranges = sampling.Ranges(
        safety.d_min, safety.activation_distance, 1.0, 1.0, 1.6, safety.human_acceleration, True, "tool"
    )
    request = request_of(params, ranges, samples=SAMPLES)
    model = robot_model.load(request.robot, request.tool, request.control)
    draw = sampling.draw_of(model, len(request.tool.capsules), ranges)
    for count in (SAMPLES // 100, SAMPLES):  # the first one loads the kernels
        survey = sampling.Survey(model.arm, draw, request.seed, count, request.M_floor, ranges.v_max)
        began = time.perf_counter()
        sampling.collect(survey)
        seconds = time.perf_counter() - began
    return [row("samples", SAMPLES / seconds, "1/s", SAMPLES_PER_S)]


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
    if what in ("sampling", "all"):
        made += bench_sampling(reference_arm(cell.params))
    if what in ("perception", "all"):
        from asc_rt.perception.bench import GOAL_MS
        from asc_rt.perception.bench import bench as bench_perception

        made += [row(name, ms, "ms", GOAL_MS) for name, ms in bench_perception(cell.params)]
    if what in ("log", "all"):
        from logs.bench import bench_log

        made += bench_log(cell_name, cell)
    return {"machine": machine(), "missing": missing, "rows": made}


# --- what is measured ------------------------------------------------------------------------------------------------


class Scene:
    """A robot that turns its last joint to and fro among people, with `pairs` active pairs."""

    def __init__(self, params: Params, pairs: int, in_conflict: bool = False) -> None:
        """`in_conflict`: the nearest of them is nearer than d_min."""
        moving = sum(int(joint) >= 0 for joint in System(params).model.capsules.joint)
        people = min(MAX_CAPSULES, -(-(pairs + 1) // moving))  # no more than it takes
        while _gap(params, pairs, _crowd(people)) < LEAST_GAP and people < MAX_CAPSULES:
            people += 1
        self.human = _crowd(people)
        scene = _with_pairs(params, pairs, self.human)
        if in_conflict:
            d_min = _reach(params, 1, self.human) + INSIDE
            scene = dataclasses.replace(
                scene, safety=dataclasses.replace(scene.safety, d_min=d_min, rearm_distance=0.0)
            )
        self.system = System(scene)
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


def _timed_free(scene: Scene) -> int:
    """ns of reference, rows and torque of one step; the reference keeps every row."""
    return _timed_filter(scene, None)


def _timed_conflict(scene: Scene) -> int:
    """ns of the same with the QP, which is asked for the hardest approach to the nearest person."""
    towards = -np.sign(rows(scene.system, *scene.next()).C[0])
    return _timed_filter(scene, vector(towards * scene.system.bounds.ddq_max))


def _timed_filter(scene: Scene, wanted: Vector | None) -> int:
    (state, x), system = scene.next(), scene.system
    level = LEVELS[system.params.control]
    began_ns = time.perf_counter_ns()
    u_ref = level.reference(system, state)
    found = rows(system, state, x)
    solution = solve(
        u_ref if wanted is None else wanted, found.C, found.floor, found.base, found.box, system.bounds.ddq_max
    )
    level.set_point(system, state, solution.u)
    return time.perf_counter_ns() - began_ns


def _inputs(
    params: Params, state: CoreState, human: HumanState, tick: int, goal: Goal, events: tuple[OperatorEvent, ...]
) -> CycleInputs:
    q = state.q_cmd if tick else vector(_middle(params))
    zero = vector(np.zeros(params.n))
    joint = JointState(tick, tick, tick, q, state.dq_cmd, zero, RobotFlag.READY | RobotFlag.SERVO_ON, 0, True)
    sensor = params.human.sensors[0]
    human = dataclasses.replace(human, seq=tick + 1, calibration_hash=sensor.calibration_hash, sensor_id=sensor.id)
    return CycleInputs(tick, tick, params.period_ns, joint, human, 0, heard(human, 0), goal, events, 0, False)


def _middle(params: Params) -> np.ndarray[Any, np.dtype[np.float64]]:
    return 0.5 * (np.array(params.robot.q_min) + np.array(params.robot.q_max)) * 0.5


def _crowd(count: int) -> HumanState:
    """Upright capsules in a half circle, each at a distance of its own, so that every number of pairs can be had."""
    angle = np.linspace(-1.5, 1.5, MAX_CAPSULES)[:count]
    radius = np.linspace(NEAR, FAR, MAX_CAPSULES)[:count]
    foot: Matrix = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(count)])
    zeros = vector(np.zeros((count, 3)))
    return HumanState(
        t_capture_ns=0,
        seq=1,  # 0 would mean that nothing has come yet
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
    return _activated(params, _reach(params, pairs, human) + 0.5 * _gap(params, pairs, human))


def _gap(params: Params, pairs: int, human: HumanState) -> float:
    """Between the activation distances of the last wanted pair and of the next one, m."""
    return _reach(params, pairs + 1, human) - _reach(params, pairs, human)


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
    return [row(f"{name}_{kind}", float(value), "us", reference_us[kind]) for kind, value in found.items()]


def row(name: str, value: float, unit: str, reference: float) -> Row:
    ratio = round(value / reference, 5)
    return {"name": name, "value": round(value, 2), "unit": unit, "reference": reference, "ratio": ratio}
