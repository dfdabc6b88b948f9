"""The real decision, recorded and run again: not a bit may differ."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asc_rt.core.step import step
from asc_rt.core.system import System, initial
from asc_rt.core.types import (
    EventKind,
    Goal,
    Health,
    HumanState,
    Mode,
    OperatorEvent,
    RobotFlag,
    Status,
    Vector,
    vector,
)
from asc_rt.record import Timings
from drivers.base import WriteReceipt
from logs.replay import Order, replay


def approaching(t_ns: int, seq: int) -> HumanState:
    """An arm at 0.9 m that comes 2 mm closer every cycle."""
    p0 = vector([[0.9 - 0.002 * seq, 0.1, 0.2], [0.9 - 0.002 * seq, 0.2, 0.5]])
    v = vector(np.tile([-0.25, 0.0, 0.0], (2, 1)))
    bounds = vector([0.08] * 2), vector([0.02] * 2), vector([0.3] * 2)
    return HumanState(t_ns - 30_000_000, seq, 1, 0, Health.OK, 1.0, True, p0, p0, v, v, *bounds, np.zeros(2, np.int64))


@pytest.fixture
def session(recording: Any) -> tuple[Path, list[Any]]:
    """The arm follows its set-points exactly and works towards a goal."""
    system = System(recording.params)
    state, goal = initial(system), Goal(1, vector([1.0, 0.3, 0.2, 0.0, -1.2, 0.0]))
    q: Vector = vector([0.0, 0.3, 0.2, 0.0, -1.2, 0.0])
    cycles = []
    for plain in (cycle[1] for cycle in recording.cycles(150)):
        k = plain.tick
        joint = dataclasses.replace(
            plain.joint, q=state.q_cmd if k else q, dq=state.dq_cmd, flags=RobotFlag.READY | RobotFlag.SERVO_ON
        )
        events = (OperatorEvent(1, EventKind.ARM),) if k == 3 else ()
        x = dataclasses.replace(
            plain, joint=joint, human=approaching(plain.t_ns, k + 1), goal=goal, events=events, late=False
        )
        before = state
        state, out = step(system, before, x)
        assert out.command is not None
        cycles.append(
            (before, x, out, WriteReceipt(x.t_ns + 1_000_000, k, out.command.q, True), Timings(*[x.t_ns] * 4))
        )
    return recording.write(recording.packed(cycles)), cycles


def test_the_core_replays_to_the_bit(session: tuple[Path, list[Any]]) -> None:
    path, cycles = session
    assert cycles[-1][0].mode is Mode.ACTIVE
    assert {Status.PASS, Status.FILTERED} <= {out.decision.status for _, _, out, _, _ in cycles}
    for start, order in ((0, Order.FORWARD), (60, Order.FORWARD), (0, Order.REVERSE)):
        report = replay(path, start, order)
        assert (report.cycles, report.mismatches, report.exact) == (150 - start, 0, True)


def test_other_parameters_decide_otherwise(recording: Any, session: tuple[Path, list[Any]]) -> None:
    path, _ = session
    safety = dataclasses.replace(recording.params.safety, d_min=0.2)
    report = replay(path, params=dataclasses.replace(recording.params, safety=safety))
    assert report.mismatches > 0
    assert report.first_difference is not None
    assert report.first_difference.field.startswith("outputs.decision.")
