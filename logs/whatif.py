"""What would have happened: the session once more with other parameters, or other code, told as a readable diff.

Unlike a replay, each cycle goes on from the state that the one before it *now* leads to. The recorded world answers as
far as it can: people, operator and goals as logged; the arm is where it was, moved by as much as its set-points of one
command latency ago differ from the logged ones. That is good for milliseconds and centimetres, not for another story.
"""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from asc_rt.core.params import Params
from asc_rt.core.types import CoreState, CycleInputs, CycleOutputs, Vector, vector
from asc_rt.fixed_protobuf import Leaf
from logs.diff import differences
from logs.reader import Records
from logs.recording import Recording
from logs.summary import STOP_COLUMNS, stops

Stepper = Callable[[CoreState, CycleInputs], tuple[CoreState, CycleOutputs]]
Progress = Callable[[Iterable[int]], Iterable[int]]
Column = np.ndarray[Any, Any]

BLOCK = 1000  # cycles compared at once
POINTS = 200  # of a waveform
_PARTS = ("state", "outputs")


@dataclass(slots=True)
class FieldChange:
    cycles: int = 0  # in which it differs
    largest: float = 0.0  # difference of numbers, SI units; inf: not numbers that can be compared
    at: int = 0  # cycle of the largest


@dataclass(slots=True)
class WhatIf:
    cycles: int = 0
    differing: int = 0
    first: dict[str, Any] | None = None  # cycle, t_s, field, logged, replayed
    fields: dict[str, FieldChange] = field(default_factory=dict)
    stops: list[str] = field(default_factory=list)  # "HUMAN_STALE at 3.200 s: stops 24 ms later"
    waveforms: dict[str, Any] = field(default_factory=dict)  # name -> t_s, logged, replayed
    ended: str = ""  # why it went no further; "": the whole log

    def as_dict(self) -> dict[str, Any]:
        """JSON-able."""
        found = dataclasses.asdict(self)
        for change in found["fields"].values():
            change["largest"] = change["largest"] if math.isfinite(change["largest"]) else None
        return found


def what_if(log: Recording, again: Stepper, params: Params, progress: Progress = iter) -> WhatIf:
    """Run the whole log anew with the decision `again`, made of `params`."""
    found = WhatIf()
    kept: list[tuple[dict[str, Column], dict[str, Column]]] = []
    for logged, replayed in _blocks(log, _run(found, log, again, params, progress)):
        _compare(found, log, logged, replayed)
        kept.append((_columns(logged), _columns(replayed)))
    if kept:
        a, b = ({name: np.concatenate([k[side][name] for k in kept]) for name in kept[0][0]} for side in (0, 1))
        found.stops = _stop_changes(stops(a), stops(b))
        found.waveforms = _waveforms(a, b)
    return found


def _run(
    found: WhatIf, log: Recording, again: Stepper, params: Params, progress: Progress
) -> Iterator[tuple[bytes, bytes]]:
    """Pairs of records: as logged, and as it would be now."""
    delay = max(1, round(params.robot.command_latency_ns / params.period_ns))
    shifts: deque[Vector] = deque(maxlen=delay)  # by how much the set-points differ, oldest first
    state: CoreState | None = None
    for index in progress(range(log.cycles)):
        record = log.record(index)
        before, inputs, _ = log.layout.unpack(record)
        state = before if state is None or before.tick != state.tick else state
        if shifts and inputs.joint is not None and shifts[0].any():
            moved = dataclasses.replace(inputs.joint, q=vector(inputs.joint.q + shifts[0]))
            inputs = dataclasses.replace(inputs, joint=moved)
        shifts.append(vector(state.q_cmd - before.q_cmd))
        made = bytearray(record)
        try:
            after, outputs = again(state, inputs)
            for name, obj in (("state", state), ("inputs", inputs), ("outputs", outputs)):
                log.layout.parts[name].pack_into(made, obj)
        except Exception as error:  # code under trial may raise anything; that is a result
            found.ended = f"cycle {before.tick}: {type(error).__name__}: {error}"
            return
        yield record, bytes(made)
        state = after
        if after.mode.is_over and index + 1 < log.cycles:
            found.ended = f"cycle {after.tick}: the session is over ({after.reason.name})"
            return


def _blocks(log: Recording, pairs: Iterator[tuple[bytes, bytes]]) -> Iterator[tuple[Records, Records]]:
    while block := [pair for _, pair in zip(range(BLOCK), pairs, strict=False)]:
        logged, replayed = (np.frombuffer(b"".join(side), log.layout.dtype) for side in zip(*block, strict=True))
        yield logged, replayed


# --- what differs ----------------------------------------------------------------------------------------------------


def _compare(found: WhatIf, log: Recording, logged: Records, replayed: Records) -> None:
    """Add the differences of a block to `found`."""
    differs = np.zeros(len(logged), bool)
    for leaf in log.layout.leaves:
        if leaf.path.split(".")[0] in _PARTS:
            differs |= _compare_field(found, leaf, logged, replayed)
    found.cycles += len(logged)
    found.differing += int(differs.sum())
    if found.first is None and differs.any():
        i = int(differs.argmax())
        first = next(differences(log.layout, logged[i].tobytes(), replayed[i].tobytes(), _PARTS))
        t0_ns = int(np.frombuffer(log.record(0), log.layout.dtype)["inputs.t_ns"][0])
        found.first = {
            "cycle": int(logged[i]["inputs.tick"]),
            "t_s": round((int(logged[i]["inputs.t_ns"]) - t0_ns) * 1e-9, 6),
            "field": first.field,
            "logged": first.logged,
            "replayed": first.replayed,
        }


def _compare_field(found: WhatIf, leaf: Leaf, logged: Records, replayed: Records) -> Column:
    """In which records the field differs, to the bit."""
    a, b = (np.ascontiguousarray(side[leaf.path]) for side in (logged, replayed))
    raw_a, raw_b = (side.view("u1").reshape(len(logged), -1) for side in (a, b))
    differs: Column = (raw_a != raw_b).any(axis=1)
    if differs.any():
        change = found.fields.setdefault(leaf.path, FieldChange())
        change.cycles += int(differs.sum())
        with np.errstate(invalid="ignore"):
            distance = np.abs(a.astype(float) - b.astype(float)).reshape(len(logged), -1).max(axis=1)
        distance = np.where(differs, np.where(np.isfinite(distance), distance, np.inf), -1.0)
        worst = int(distance.argmax())
        if distance[worst] >= change.largest:
            change.largest, change.at = float(distance[worst]), int(logged["inputs.tick"][worst])
    return differs


# --- stops and waveforms ---------------------------------------------------------------------------------------------


def _columns(records: Records) -> dict[str, Column]:
    """What stops and waveforms are told from; the records themselves need not stay."""
    pairs = records["outputs.decision.pairs.phi"]
    there = np.arange(pairs.shape[1]) < records["outputs.decision.pairs.count"][:, None]
    waves = {
        "greatest phi": np.where(there, pairs, -np.inf).max(axis=1),
        "d_measured": records["outputs.decision.d_measured"].copy(),
        "norm of u_safe": np.linalg.norm(records["outputs.decision.u_safe"], axis=1),
        "norm of dq_cmd": np.linalg.norm(records["state.dq_cmd"], axis=1),
    }
    return waves | {name: records[name].copy() for name in STOP_COLUMNS}


def _stop_changes(logged: list[dict[str, Any]], replayed: list[dict[str, Any]]) -> list[str]:
    """Each logged stop with what becomes of it, then the stops that are new. Stops of the same reason belong together
    in their order."""
    told, left = [], list(replayed)
    for stop in logged:
        where = f"{stop['reason']} at {stop['t_s']:.3f} s"
        match = next((other for other in left if other["reason"] == stop["reason"]), None)
        if match is None:
            told.append(f"{where}: does not stop")
            continue
        left.remove(match)
        shift = (match["t_s"] - stop["t_s"]) * 1e3
        when = "at the same time" if abs(shift) < 1e-3 else f"{abs(shift):.0f} ms {'later' if shift > 0 else 'earlier'}"
        told.append(f"{where}: stops {when}")
    return told + [f"{stop['reason']} at {stop['t_s']:.3f} s: stops, and did not" for stop in left]


def _waveforms(a: dict[str, Column], b: dict[str, Column]) -> dict[str, Any]:
    t_s = (a["inputs.t_ns"] - a["inputs.t_ns"][0]) * 1e-9
    places = np.unique(np.linspace(0, len(t_s) - 1, POINTS).astype(int))

    def values(column: Column) -> list[float | None]:
        return [round(float(v), 6) if math.isfinite(v) else None for v in column[places]]

    waves = [name for name in a if name not in STOP_COLUMNS]
    return {
        name: {"t_s": values(t_s), "logged": values(a[name]), "replayed": values(b[name])}
        for name in waves
        if not np.array_equal(a[name], b[name], equal_nan=True)
    }
