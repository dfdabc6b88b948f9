"""The golden recording: what the decision did when somebody last looked at it and agreed.

    python tests/logs/golden.py            tell how today's code behaves differently
    python tests/logs/golden.py --update   the same, and make today's behaviour the golden one

A story of two seconds: the arm works, a person comes near and it gives way, the camera falls silent and it stops, the
person leaves, it is armed again and works on, and the session ends.
"""

import dataclasses
import sys
from pathlib import Path

import numpy as np

from asc_rt.config import load_cell
from asc_rt.core.fusion import heard
from asc_rt.core.params import Params
from asc_rt.core.step import step
from asc_rt.core.system import System, initial
from asc_rt.core.types import (
    CycleInputs,
    EventKind,
    Goal,
    Health,
    HumanState,
    JointState,
    OperatorEvent,
    RobotFlag,
    vector,
)
from asc_rt.record import RecordLayout, Timings
from drivers.base import WriteReceipt
from logs import schema
from logs.commands import told
from logs.context import attachments, session
from logs.log_file import LogFile
from logs.mcap_scan import LogError
from logs.recording import open_recording
from logs.replay import core_stepper
from logs.whatif import what_if

ROOT = Path(__file__).parents[2]
GOLDEN = ROOT / "tests" / "golden" / "approach.mcap"
CYCLES = 300
START_NS = 1_000_000_000
START_Q = vector([0.0, 0.3, 0.2, 0.0, -1.2, 0.0])
EVENTS = {3: EventKind.ARM, 150: EventKind.ARM, 230: EventKind.END}
SILENT = range(40, 120)  # cycles without a new message of the camera


def person(t_ns: int, seq: int, distance: float) -> HumanState:
    """One arm, upright, straight ahead."""
    p0, p1 = vector([[distance, 0.1, 0.2]]), vector([[distance, 0.2, 0.5]])
    v = vector([[-0.25, 0.0, 0.0]])
    bounds = vector([0.08]), vector([0.02]), vector([0.3])
    return HumanState(t_ns, seq, 1, 0, Health.OK, 1.0, True, p0, p1, v, v, *bounds, np.zeros(1, np.int64))


def distance_at(k: int) -> float:
    return 0.95 - 0.003 * k if k < 60 else 1.1


def make(path: Path) -> None:
    """Record the story with today's code."""
    cell = load_cell("fanuc-sim-truth")
    params = dataclasses.replace(
        cell.params, human=dataclasses.replace(cell.params.human, age_limit_ns=120_000_000)
    )  # so that silence stops the arm within the story
    layout, records = RecordLayout(params.n), []
    buffer = layout.buffer()
    for cycle in play(params):
        layout.pack(buffer, *cycle)
        records.append(layout.sealed(buffer))
    path.parent.mkdir(exist_ok=True)
    path.unlink(missing_ok=True)
    files = {**attachments(cell), schema.PARAMS: params.canonical()}
    wanted = (schema.PARAMS, schema.CELL, schema.FINGERPRINT)
    # Nothing about the machine and the person who updated it.
    about = {k: v for k, v in session(cell).items() if k not in ("operator", "host")}
    log = LogFile(path, {name: files[name] for name in wanted}, about, channels=(schema.CYCLE, schema.HELLO))
    for k, record in enumerate(records):
        log.message(schema.CYCLE, START_NS + k * params.period_ns, record)
    log.close({"reason": "golden"})


def play(params: Params) -> list[tuple[object, ...]]:
    """The arm is always exactly where its set-point was."""
    system = System(params)
    state, goal = initial(system), Goal(1, vector([1.0, 0.3, 0.2, 0.0, -1.2, 0.0]))
    seen = person(START_NS, 0, distance_at(0))
    cycles: list[tuple[object, ...]] = []
    for k in range(CYCLES):
        t_ns = START_NS + k * params.period_ns
        if k not in SILENT:
            seen = person(t_ns - 30_000_000, k + 1, distance_at(k))
        joint = JointState(
            t_ns - 20_000, k, k, state.q_cmd if k else START_Q, state.dq_cmd, vector(np.zeros(params.n)),
            RobotFlag.READY | RobotFlag.SERVO_ON, 0, True,
        )  # fmt: skip
        events = (OperatorEvent(k, EVENTS[k]),) if k in EVENTS else ()
        age = t_ns - seen.t_capture_ns
        x = CycleInputs(k, t_ns, params.period_ns, joint, seen, age, heard(seen, age), goal, events, 0, False)
        before = state
        state, out = step(system, before, x)
        sent = None if out.command is None else WriteReceipt(t_ns + 1_000_000, k, out.command.q, True)
        cycles.append((before, x, out, sent, Timings(*[t_ns] * 4)))
        if state.mode.is_over:
            break
    return cycles


def difference(path: Path = GOLDEN) -> list[str]:
    """How today's code behaves differently, in words."""
    log = open_recording(path)
    return told(what_if(log, core_stepper(log.params), log.params).as_dict())


def main() -> None:
    if GOLDEN.exists():
        try:
            print(*difference(), sep="\n")
        except LogError as error:
            print(f"it cannot be compared: {error}")
    else:
        print("there is no golden recording yet")
    if "--update" in sys.argv[1:]:
        make(GOLDEN)
        print(f"{GOLDEN.relative_to(ROOT)}: {GOLDEN.stat().st_size // 1000} kB")


if __name__ == "__main__":
    main()
