"""Run the decision again on every record of a log and compare the bytes.

For each record: `step(state, inputs)` must give the outputs of the record and the state of the next one. The verdict
does not depend on where one starts or in which order one goes, because a record holds all that its cycle knew.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from asc_rt.core.params import Params
from asc_rt.core.types import CoreState, CycleInputs, CycleOutputs
from asc_rt.fingerprint import fingerprint
from asc_rt.fixed_protobuf import RecordError
from logs import schema
from logs.diff import Difference, altered, differences
from logs.reader import Log, open_log

Stepper = Callable[[CoreState, CycleInputs], tuple[CoreState, CycleOutputs]]
Progress = Callable[[Iterable[int]], Iterable[int]]  # like tqdm

TOLERANCE = (
    1e-6  # SI units. Another processor rounds the QP and the trigonometry differently (ASSUMED; 1e-9 is typical)
)
WIRE_TOLERANCE = 1e-6  # rad: float32 degrees of the wire are up to 2.7e-7 rad off


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


def replay(
    path: str | Path,
    start: int = 0,
    order: Order = Order.FORWARD,
    *,
    stepper: Callable[[Params], Stepper] = core_stepper,
    params: Params | None = None,
    progress: Progress = iter,
) -> ReplayReport:
    """Run the records from number `start` (0 = first) on again. `params`: a what-if instead of the logged ones.

    LogError: the file. IndexError: fewer records than `start`.
    """
    log = open_log(path)
    if not 0 <= start < max(log.cycles, 1):
        raise IndexError(f"cycle {start}: the log has {log.cycles}")
    again = stepper(params or log.params)
    match = log.fingerprint.get("hash") == fingerprint()["hash"]
    tolerance = 0.0 if match else TOLERANCE
    numbers: Iterable[int] = range(start, log.cycles)
    if order is Order.REVERSE:
        numbers = reversed(range(start, log.cycles))
    count, mismatches, largest, exact = 0, 0, 0.0, True
    first: FirstDifference | None = None
    for index in progress(numbers):
        count += 1
        found = compare(log, index, again)
        if not found:
            continue
        exact = False
        largest = max([largest, *(d.distance for d in found)])
        beyond = [d for d in found if d.distance > tolerance]
        mismatches += bool(beyond)
        tick = _tick(log, index)
        if beyond and (first is None or tick < first.cycle):
            first = FirstDifference(tick, beyond[0].field, beyond[0].logged, beyond[0].replayed)
    gaps, wire = _gaps(log), wire_mismatches(log)
    return ReplayReport(
        count, mismatches, exact, match, first, wire, gaps, tolerance, largest, log.truncated
    )  # fmt: skip


def compare(log: Log, index: int, again: Stepper) -> list[Difference]:
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


def _next(log: Log, index: int, after: CoreState) -> bytes | None:
    """The record whose state must be `after`; None: it is missing, or was altered, which is told as its own fault."""
    if index + 1 >= log.cycles or _tick(log, index + 1) != after.tick:
        return None
    following = log.record(index + 1)
    return following if log.layout.syndrome(following) == 0 else None


def _of_next(found: Difference) -> Difference:
    return found._replace(field=found.field.replace("state.", "state_after.", 1))


def _tick(log: Log, index: int) -> int:
    offset = log.layout.dtype.fields["inputs.tick"][1]  # type: ignore[index]
    return int.from_bytes(log.record(index)[offset : offset + 8], "little", signed=True)


def _gaps(log: Log) -> int:
    ticks = log.columns("inputs.tick")["inputs.tick"]
    return int((ticks[1:] != ticks[:-1] + 1).sum())


def wire_mismatches(log: Log) -> int:
    """Cycles whose joint sample or sent command has no packet of its moment in the log, or was sent as something else.

    0 for a log without packets: there is nothing to compare with.
    """
    received, sent = (
        {schema.parse_wire_message(m.data)[0] for m in log.messages(channel.topic)}
        for channel in (schema.WIRE_RX, schema.WIRE_TX)
    )
    if not received and not sent:
        return 0
    return sum(not (_was_heard(row, received) and _was_sent(row, sent)) for batch in log.batches() for row in batch)


def _was_heard(row: Any, received: set[int]) -> bool:
    return not row["inputs.joint.present"] or int(row["inputs.joint.t_rx_ns"]) in received


def _was_sent(row: Any, sent: set[int]) -> bool:
    if not (row["receipt.present"] and row["receipt.ok"]):
        return True  # nothing claims to have been sent
    told = abs(row["receipt.q"] - row["outputs.command.q"]).max()
    return int(row["receipt.t_tx_ns"]) in sent and bool(told <= WIRE_TOLERANCE)
