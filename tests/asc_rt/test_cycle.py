"""The loop: its verbs in order, and every way out ends in driver.stop()."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asc_rt import cycle, ring
from asc_rt.config import load_cell
from asc_rt.control import RingRecorder
from asc_rt.core.system import System, initial
from asc_rt.core.types import (
    CoreState,
    CycleInputs,
    CycleOutputs,
    JointCommand,
    JointState,
    Mode,
    RobotFlag,
    StopReason,
    StopRequest,
    vector,
)
from asc_rt.inputs import Mail
from asc_rt.pacing import DevicePaced
from asc_rt.record import RecordLayout, Timings
from drivers.base import LinkError, WriteReceipt
from tests.box import Box

PERIOD = 8_000_000


class Bench:
    """Clock, robot and recorder in one: an ideal arm in simulated time that notes what is done to it."""

    def __init__(self, n: int = 6) -> None:
        self.now = 1_000_000_000
        self.verbs: list[str] = []
        self.records: list[tuple[CoreState, CycleInputs, CycleOutputs, WriteReceipt | None, Timings]] = []
        self.stops: list[StopRequest | None] = []
        self.fail: dict[str, Exception] = {}
        self.silent = False
        self.seq = 0
        self.q = vector(np.radians([0.0, 5.0, 10.0, 0.0, -75.0, 0.0])[:n])

    def __call__(self) -> int:
        self.now += 1000
        return self.now

    def _do(self, verb: str) -> None:
        self.verbs.append(verb)
        if verb in self.fail:
            raise self.fail[verb]

    def read(self, deadline_ns: int) -> JointState | None:
        self._do("read")
        if self.silent:
            self.now = deadline_ns
            return None
        self.now += PERIOD
        self.seq += 1
        zero = vector(np.zeros(len(self.q)))
        return JointState(self.now, 0, self.seq, self.q, zero, zero, RobotFlag.READY | RobotFlag.SERVO_ON, 0, True)

    def write(self, command: JointCommand) -> WriteReceipt:
        self._do("write")
        self.q = command.q
        return WriteReceipt(self.now, self.seq, command.q, ok=True)

    def stop(self, request: StopRequest | None = None) -> None:
        self.verbs.append("stop")
        self.stops.append(request)

    def put(self, *record: Any) -> None:
        self._do("put")
        self.records.append(record)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def system() -> System:
    return System(load_cell("fanuc-sim-truth").params)


def run(system: System, bench: Bench, operator: Box | None = None) -> CoreState:
    mail = Mail({1: Box()}, operator or Box(), Box(), joints=system.n, clock="test")
    return cycle.run(system, bench, mail, bench, DevicePaced(PERIOD, bench), bench)  # type: ignore[arg-type]


END = json.dumps({"id": 1, "kind": "END"}).encode()


def test_a_session_ends_at_rest_when_it_is_asked_to(system: System) -> None:
    bench = Bench()
    state = run(system, bench, Box(END))
    assert state.mode is Mode.ENDED and state.reason is StopReason.SESSION_END
    last = bench.records[-1][2].command
    assert last is not None and last.is_last
    assert bench.stops == [None]


def test_the_verbs_come_in_order_and_everything_is_recorded(system: System) -> None:
    bench = Bench()
    state = run(system, bench, Box(END))
    cycles = len(bench.records)
    assert bench.verbs == ["read", "write", "put"] * cycles + ["stop"]
    assert [x.tick for _, x, _, _, _ in bench.records] == list(range(cycles)) and state.tick == cycles
    befores = [before for before, *_ in bench.records]
    assert befores[0].mode is initial(system).mode is Mode.IDLE
    for _, x, out, sent, timings in bench.records:
        assert out.command is not None and sent is not None and sent.q is out.command.q
        assert timings.t_wake_ns <= timings.t_read_ns == x.t_ns <= timings.t_step_end_ns <= timings.t_write_end_ns


def test_a_silent_robot_ends_the_session_and_is_recorded(system: System) -> None:
    bench = Bench()
    bench.silent = True
    state = run(system, bench)
    assert state.mode is Mode.FAULT and state.reason is StopReason.ROBOT_SILENT
    assert bench.stops == [StopRequest(StopReason.ROBOT_SILENT), None]
    assert "write" not in bench.verbs
    assert len(bench.records) == system.params.silence_cycles


@pytest.mark.parametrize("verb", ["read", "write", "put"])
@pytest.mark.parametrize("error", [LinkError("gone"), RuntimeError("bug"), KeyboardInterrupt()], ids=repr)
def test_whatever_raises_the_robot_is_stopped_and_the_error_told(
    system: System, verb: str, error: BaseException
) -> None:
    bench = Bench()
    bench.fail[verb] = error  # type: ignore[assignment]
    with pytest.raises(type(error)):
        run(system, bench, Box(END))
    assert bench.verbs[-2:] == [verb, "stop"]


def test_a_decision_that_raises_sends_nothing_and_stops_the_robot(
    system: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    def raises(*_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(cycle, "step", raises)
    bench = Bench()
    with pytest.raises(ZeroDivisionError):
        run(system, bench)
    assert bench.verbs == ["read", "stop"]


def test_a_cycle_without_a_command_sends_nothing(system: System, monkeypatch: pytest.MonkeyPatch) -> None:
    real: Callable[..., tuple[CoreState, CycleOutputs]] = cycle.step

    def speechless(*args: Any) -> tuple[CoreState, CycleOutputs]:
        state, out = real(*args)
        return state, CycleOutputs(out.decision, None, None)

    monkeypatch.setattr(cycle, "step", speechless)
    bench = Bench()
    run(system, bench, Box(END))
    assert set(bench.verbs) == {"read", "put", "stop"}
    assert bench.verbs.count("stop") == 1  # silence in mid-session is not the end of it
    assert bench.records[0][3] is None


def test_a_cycle_that_does_not_fit_the_record_is_counted(system: System, tmp_path: Path) -> None:
    bench, layout = Bench(), RecordLayout(system.n)
    run(system, bench, Box(END))
    ring.create(tmp_path / "ring", layout.size, slots=4)
    with ring.RingWriter(tmp_path / "ring") as writer, ring.RingReader(tmp_path / "ring") as reader:
        recorder = RingRecorder(writer, layout)
        before, *rest = whole = bench.records[0]
        recorder.put(*whole)
        recorder.put(dataclasses.replace(before, q_cmd=np.zeros(system.n + 1)), *rest)  # type: ignore[arg-type]
        assert (recorder.unrecorded, writer.head) == (1, 1)
        recorder.put(*whole)
        buffer = layout.buffer()
        layout.pack(buffer, *whole)
        assert reader.drain() == [bytes(buffer)] * 2
