"""What the rules of the audit look at: the recording as numpy columns, read in one pass."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from asc_rt.core.types import Mode
from logs.reader import Records
from logs.recording import Recording
from logs.replay import ReplayReport
from logs.summary import STOP_COLUMNS
from logs.wire import FIELDS as WIRE_FIELDS

Column = np.ndarray[Any, Any]
Progress = Callable[[Iterable[int]], Iterable[int]]

MOVING = (Mode.ACTIVE, Mode.STOPPING)
_COLUMNS = tuple({  # each once
    *WIRE_FIELDS, *STOP_COLUMNS, "state.tick", "state.q_cmd", "state.dq_cmd", "state.ddq_cmd",
    "inputs.period_ns", "inputs.missed_ticks", "inputs.late", "inputs.events.count", "inputs.events.kind",
    "inputs.human.present", "inputs.human.health", "inputs.human_age_ns", "inputs.human_fault",
    "inputs.joint.present", "inputs.joint.q", "inputs.joint.dq", "inputs.joint.tool_id", "inputs.joint.t_rx_ns",
    "outputs.decision.status", "outputs.decision.share", "outputs.decision.d_measured",
    "outputs.command.kind", "outputs.command.q", "outputs.command.tau",
    "receipt.present", "receipt.ok", "receipt.seq", "receipt.t_tx_ns",
    "timings.t_wake_ns", "timings.t_write_end_ns",
})  # fmt: skip


@dataclass
class Evidence:
    """`c`: column by path of the field; derived ones have names without a dot."""

    log: Recording
    c: dict[str, Column]
    broken_records: int  # whose own checksum is wrong
    trusted: Ed25519PublicKey | None = None  # whose recordings the auditor trusts
    trusted_name: str = ""
    replay: ReplayReport | None = None
    notes: dict[str, Any] = field(default_factory=dict)  # what rules found out beside their verdict

    @property
    def cycles(self) -> int:
        return len(self.c["inputs.tick"])

    def at(self, index: int) -> str:
        """A moment in words."""
        tick, t_ns = self.c["inputs.tick"], self.c["inputs.t_ns"]
        return f"cycle {int(tick[index])}, {(int(t_ns[index]) - int(t_ns[0])) * 1e-9:.3f} s"

    @property
    def t_s(self) -> Column:
        t_ns = self.c["inputs.t_ns"]
        seconds: Column = (t_ns - t_ns[0]) * 1e-9
        return seconds

    @property
    def mode(self) -> Column:
        """Before each cycle."""
        return self.c["state.mode"]

    @property
    def mode_after(self) -> Column:
        """Of each cycle; after the last one it is taken as before it."""
        return np.append(self.mode[1:], self.mode[-1:])

    @property
    def moving(self) -> Column:
        """Cycles whose command may move the arm."""
        found: Column = np.isin(self.mode, MOVING) | np.isin(self.mode_after, MOVING)
        return found


def gather(log: Recording, progress: Progress = iter) -> Evidence:
    """LogError: the file."""
    parts: list[dict[str, Column]] = []
    broken, size = 0, log.layout.size
    batches = log.batches()
    for _ in progress(range(log.chunks_with_cycles)):
        batch = next(batches)
        raw = batch.tobytes()
        broken += sum(log.layout.syndrome(raw[k : k + size]) != 0 for k in range(0, len(raw), size))
        parts.append({path: batch[path].copy() for path in _COLUMNS} | _derived(batch))
    if not parts:
        parts.append({path: np.zeros(0, log.layout.dtype[path]) for path in _COLUMNS})
        parts[0] |= _derived(np.zeros(0, log.layout.dtype))
    columns = {path: np.concatenate([part[path] for part in parts]) for path in parts[0]}
    return Evidence(log, columns, broken)


def _derived(batch: Records) -> dict[str, Column]:
    """Of the pairs, which are too many to keep: the worst in each cycle; -inf or inf without a pair."""
    pairs = "outputs.decision.pairs"
    there = np.arange(batch[f"{pairs}.phi"].shape[1]) < batch[f"{pairs}.count"][:, None]
    with np.errstate(invalid="ignore"):  # rows without a floor have none to keep
        slack = batch[f"{pairs}.achieved"] - batch[f"{pairs}.floor"]
    return {
        "worst_phi": np.where(there, batch[f"{pairs}.phi"], -np.inf).max(axis=1, initial=-np.inf),
        "least_d": np.where(there, batch[f"{pairs}.d"], np.inf).min(axis=1, initial=np.inf),
        "least_slack": np.where(there, slack, np.inf).min(axis=1, initial=np.inf),
    }
