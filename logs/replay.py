"""Run the decision again on every record of a log and compare the bytes.

For each record: `step(state, inputs)` must give the outputs of the record and the state of the next one. The verdict
does not depend on where one starts or in which order one goes, because a record holds all that its cycle knew.
"""

from __future__ import annotations

import itertools
import math
import multiprocessing
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from asc_rt.core.params import Params
from asc_rt.core.types import CoreState, CycleInputs, CycleOutputs
from asc_rt.fingerprint import fingerprint
from asc_rt.packing import RecordError
from logs.diff import Difference, altered, differences
from logs.reader import Progress
from logs.recording import Recording, open_recording
from logs.wire import FIELDS, Column, Packets, replay_wire

Stepper = Callable[[CoreState, CycleInputs], tuple[CoreState, CycleOutputs]]

TOLERANCE = (
    1e-6  # SI units. Another processor rounds the QP and the trigonometry differently (ASSUMED; 1e-9 is typical)
)
PART = 500  # cycles that a worker takes at once


class Order(StrEnum):
    FORWARD = "forward"
    REVERSE = "reverse"


@dataclass(frozen=True, slots=True)
class FirstDifference:
    cycle: int  # tick
    field: str
    logged: Any
    replayed: Any


@dataclass(frozen=True, slots=True)
class ReplayReport:
    cycles: int  # that were run again
    mismatches: int  # cycles that differ: in any byte; by more than `tolerance` where the fingerprint does not match
    exact: bool  # no byte differs
    fingerprint_match: bool
    first_difference: FirstDifference | None  # the one of the lowest tick
    wire_mismatches: int  # cycles whose sample or command is not what passed on the wire
    wire_first: str  # the first of them, in words
    wire_decoded: bool  # by the driver's codec; False: only the presence of the packets was checked
    gaps: int  # places where records are missing
    tolerance: float  # 0: bytes were compared
    largest_difference: float  # of numbers, SI units
    truncated: bool

    def as_dict(self) -> dict[str, Any]:
        """JSON-able."""
        found = asdict(self)
        found["largest_difference"] = self.largest_difference if math.isfinite(self.largest_difference) else None
        return found


def core_stepper(params: Params) -> Stepper:
    """The decision of this code, ready to run."""
    from asc_rt.core.step import step
    from asc_rt.core.system import System

    system = System(params)
    return lambda state, inputs: step(system, state, inputs)


@dataclass(slots=True)
class _Found:
    """What a part of the log gave."""

    count: int = 0
    mismatches: int = 0
    largest: float = 0.0
    exact: bool = True
    first: FirstDifference | None = None

    def add(self, other: _Found) -> None:
        self.count += other.count
        self.mismatches += other.mismatches
        self.largest, self.exact = max(self.largest, other.largest), self.exact and other.exact
        if other.first is not None and (self.first is None or other.first.cycle < self.first.cycle):
            self.first = other.first


def replay(
    recording: str | Path | Recording,
    start: int = 0,
    order: Order = Order.FORWARD,
    *,
    stepper: Callable[[Params], Stepper] = core_stepper,
    cycles: Sequence[int] | None = None,
    columns: dict[str, Column] | None = None,
    packets: Packets | None = None,
    jobs: int = 1,
    progress: Progress = iter,
) -> ReplayReport:
    """Run the records from number `start` (0 = first) on again, or just `cycles`. `jobs`: processes that share it.
    `columns`: `logs.wire.FIELDS` of all cycles, `packets`: all of them, if they are at hand.

    LogError: the file. IndexError: fewer records than `start`.
    """
    log = recording if isinstance(recording, Recording) else open_recording(recording)
    if not 0 <= start < max(log.cycles, 1):
        raise IndexError(f"cycle {start}: the log has {log.cycles}")
    numbers: Sequence[int] = range(start, log.cycles) if cycles is None else cycles
    if order is Order.REVERSE:
        numbers = numbers[::-1]
    match = log.fingerprint.get("hash") == fingerprint()["hash"]
    tolerance = 0.0 if match else TOLERANCE
    found = _Found()
    if jobs == 1:
        found = _replay_part(log, stepper(log.params), progress(numbers), tolerance)
    else:
        _replay_shared(found, log.path, stepper, numbers, tolerance, jobs, progress)
    columns = columns or log.columns(*FIELDS)
    gaps, wire = int((np.diff(columns["inputs.tick"]) != 1).sum()), replay_wire(log, columns, cycles, packets)
    return ReplayReport(
        found.count, found.mismatches, found.exact, match, found.first, wire.mismatches, wire.first, wire.decoded, gaps,
        tolerance, found.largest, log.truncated,
    )  # fmt: skip


def _replay_part(log: Recording, again: Stepper, numbers: Iterable[int], tolerance: float) -> _Found:
    total = _Found()
    for index in numbers:
        total.count += 1
        found = compare(log, index, again)
        if not found:
            continue
        total.exact = False
        total.largest = max([total.largest, *(d.distance for d in found)])
        beyond = [d for d in found if d.distance > tolerance]
        total.mismatches += bool(beyond)
        tick = _tick(log, index)
        if beyond and (total.first is None or tick < total.first.cycle):
            total.first = FirstDifference(tick, beyond[0].field, beyond[0].logged, beyond[0].replayed)
    return total


def _replay_shared(
    found: _Found,
    path: str | Path,
    stepper: Callable[[Params], Stepper],
    numbers: Sequence[int],
    tolerance: float,
    jobs: int,
    progress: Progress,
) -> None:
    """The same on several cores: which cycle is run where makes no difference, because each record stands alone."""
    parts = [numbers[i : i + PART] for i in range(0, len(numbers), PART)]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, context, _begin_worker, (str(path), stepper)) as pool:
        done = pool.map(_worker_part, parts, itertools.repeat(tolerance))
        ends = progress(numbers)
        counted = iter(ends)
        for part in done:
            found.add(part)
            for _ in range(part.count):
                next(counted, None)


_worker: tuple[Recording, Stepper] | None = None  # of this process


def _begin_worker(path: str, stepper: Callable[[Params], Stepper]) -> None:
    global _worker
    log = open_recording(path)
    _worker = log, stepper(log.params)


def _worker_part(numbers: Sequence[int], tolerance: float) -> _Found:
    assert _worker is not None
    log, again = _worker
    return _replay_part(log, again, numbers, tolerance)


def compare(log: Recording, index: int, again: Stepper) -> list[Difference]:
    """All that differs in one cycle: the record itself if it was altered, its outputs, and the state after it."""
    layout, record = log.layout, log.record(index)
    found = [change] if (change := altered(layout, record)) else []
    try:
        after, outputs = again(*layout.unpack(record)[:2])
        replayed = bytearray(record)
        layout.parts["outputs"].pack_into(replayed, outputs)
        found += differences(layout, record, replayed, ("outputs",))
        if (following := _next(log, index, after)) is not None:
            layout.parts["state"].pack_into(replayed, after)
            found += [_of_next(d) for d in differences(layout, following, replayed, ("state",))]
    except RecordError as error:  # a value that no record can have
        found.append(Difference(str(error).split(":")[0], "as recorded", str(error), math.inf))
    except Exception as error:  # a decision that raises is a difference, not the end of the replay
        found.append(Difference("outputs", "as recorded", f"{type(error).__name__}: {error}", math.inf))
    return found


def _next(log: Recording, index: int, after: CoreState) -> bytes | None:
    """The record whose state must be `after`; None: it is missing, or was altered, which is told as its own fault."""
    if index + 1 >= log.cycles or _tick(log, index + 1) != after.tick:
        return None
    following = log.record(index + 1)
    return following if log.layout.syndrome(following) == 0 else None


def _of_next(found: Difference) -> Difference:
    return found._replace(field=found.field.replace("state.", "state_after.", 1))


def _tick(log: Recording, index: int) -> int:
    offset = log.layout.dtype.fields["inputs.tick"][1]  # type: ignore[index]
    return int.from_bytes(log.record(index)[offset : offset + 8], "little", signed=True)
