"""The real decision, recorded and run again: not a bit may differ."""

import dataclasses
import functools
import inspect
import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from asc_rt.core import step as step_module
from asc_rt.core.params import Params
from asc_rt.core.system import System
from asc_rt.core.types import (
    CoreState,
    CycleInputs,
    CycleOutputs,
    Mode,
    Status,
)
from logs.commands import told
from logs.recording import open_recording
from logs.replay import Order, Stepper, core_stepper, replay
from logs.whatif import _stop_changes, what_if


def test_the_core_replays_to_the_bit(core_session: tuple[Path, list[Any]]) -> None:
    path, cycles = core_session
    assert cycles[-1][0].mode is Mode.ACTIVE
    assert {Status.PASS, Status.FILTERED} <= {out.decision.status for _, _, out, _, _ in cycles}
    for start, order in ((0, Order.FORWARD), (60, Order.FORWARD), (0, Order.REVERSE)):
        report = replay(path, start, order)
        assert (report.cycles, report.mismatches, report.exact) == (150 - start, 0, True)


def test_several_processes_give_the_same_verdict(core_session: tuple[Path, list[Any]]) -> None:
    assert replay(core_session[0], jobs=2).as_dict() == replay(core_session[0]).as_dict()


def changed(line: str, by: str) -> Callable[[Params], Stepper]:
    """The decision of this code with one line of it written otherwise."""
    source = inspect.getsource(step_module)
    assert source.count(line) == 1
    module = ModuleType("changed")
    exec(compile(source.replace(line, by), "changed", "exec"), module.__dict__)
    return lambda params: functools.partial(module.step, System(params))


def always(cycle: Any) -> bool:
    return True


def moves(cycle: Any) -> bool:
    return bool(cycle[2].command.dq.any())


def is_filtered(cycle: Any) -> bool:
    return bool(cycle[2].decision.status is Status.FILTERED)


@pytest.mark.parametrize(
    ("line", "by", "tells", "field"),
    [
        (
            "= nearest_measured(system, x)",
            "= nearest_measured(system, x) - 1e-9",
            always,
            "outputs.decision.d_measured",
        ),
        ("level.kind, point.q, point.dq,", "level.kind, point.q, point.ddq,", moves, "outputs.command.dq"),
        ("q_cmd=point.q, dq_cmd=point.dq,", "q_cmd=point.q, dq_cmd=point.ddq,", moves, "state_after.dq_cmd"),
        ("if not solution.feasible:", "if solution.filtered:", is_filtered, "outputs.decision.status"),
    ],
)
def test_a_changed_line_of_the_core_is_found_where_it_first_tells(
    core_session: tuple[Path, list[Any]], line: str, by: str, tells: Callable[[Any], bool], field: str
) -> None:
    path, cycles = core_session
    found = replay(path, stepper=changed(line, by)).first_difference
    assert found is not None
    assert found.field.startswith(field)
    assert found.cycle == next(k for k, cycle in enumerate(cycles) if tells(cycle))
    assert found.logged != found.replayed


def with_d_min(params: Params, d_min: float) -> Params:
    return dataclasses.replace(params, safety=dataclasses.replace(params.safety, d_min=d_min))


def test_what_if_nothing_changes_then_nothing_differs(core_session: tuple[Path, list[Any]]) -> None:
    log = open_recording(core_session[0])
    found = what_if(log, core_stepper(log.params), log.params)
    assert (found.cycles, found.differing, found.first, found.ended) == (150, 0, None, "")
    assert found.waveforms == {}
    assert told({**found.as_dict()}) == ["150 cycles, nothing differs"]


def test_what_if_the_distance_were_another(core_session: tuple[Path, list[Any]]) -> None:
    log = open_recording(core_session[0])
    params = with_d_min(log.params, 0.2)
    found = what_if(log, core_stepper(params), params)
    assert found.first is not None
    assert found.first["field"].startswith("outputs.decision.")
    assert found.differing > 0
    assert found.fields["outputs.decision.pairs.phi"].largest > 0.01
    assert "greatest phi" in found.waveforms
    assert json.dumps(found.as_dict(), allow_nan=False)
    assert told(found.as_dict())[1].startswith("first: cycle ")


def test_what_if_goes_on_from_its_own_state(core_session: tuple[Path, list[Any]]) -> None:
    """A change of one cycle reaches the later ones, which a replay must not show."""
    log = open_recording(core_session[0])
    decide = core_stepper(log.params)

    def nudged(state: CoreState, x: CycleInputs) -> tuple[CoreState, CycleOutputs]:
        after, out = decide(state, x)
        return (dataclasses.replace(after, event_id=77) if x.tick == 40 else after), out

    found = what_if(log, nudged, log.params)
    assert found.fields["state.event_id"].cycles == 150 - 41


def test_code_that_raises_ends_the_what_if_and_says_where(core_session: tuple[Path, list[Any]]) -> None:
    log = open_recording(core_session[0])
    decide = core_stepper(log.params)

    def broken(state: CoreState, x: CycleInputs) -> tuple[CoreState, CycleOutputs]:
        if x.tick == 30:
            raise ZeroDivisionError("by zero")
        return decide(state, x)

    found = what_if(log, broken, log.params)
    assert (found.cycles, found.ended) == (30, "cycle 30: ZeroDivisionError: by zero")


def test_stops_are_told_by_what_becomes_of_them() -> None:
    def stop(reason: str, t_s: float) -> dict[str, Any]:
        return {"reason": reason, "t_s": t_s}

    logged = [stop("HUMAN_STALE", 3.2), stop("LATE", 5.0), stop("GATE", 6.0)]
    replayed = [stop("HUMAN_STALE", 3.224), stop("GATE", 6.0), stop("INFEASIBLE", 7.5)]
    assert _stop_changes(logged, replayed) == [
        "HUMAN_STALE at 3.200 s: stops 24 ms later",
        "LATE at 5.000 s: does not stop",
        "GATE at 6.000 s: stops at the same time",
        "INFEASIBLE at 7.500 s: stops, and did not",
    ]
