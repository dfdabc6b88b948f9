"""What the rules of the audit look at: the recording as numpy columns, read in one pass."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from asc_rt.core.types import Mode
from asc_rt.record import RecordLayout
from logs import schema
from logs.reader import Log, Progress, Records
from logs.recording import Recording, open_recording
from logs.replay import ReplayReport
from logs.summary import STOP_COLUMNS
from logs.wire import FIELDS as WIRE_FIELDS
from logs.wire import Packets

Column = np.ndarray[Any, Any]

BLOCK = 500  # cycles that are made columns at once
_WIRES = {schema.WIRE_RX.topic: "rx", schema.WIRE_TX.topic: "tx"}
MOVING = (Mode.ACTIVE, Mode.STOPPING)
SENSOR_COLUMNS = (
    "id", "seq", "age_ns", "sigma_ns", "fault", "health", "says_nothing", "coverage", "calibration_hash",
)  # fmt: skip
_COLUMNS = tuple({  # each once
    *WIRE_FIELDS, *STOP_COLUMNS, "state.tick", "state.tool", "state.q_cmd", "state.dq_cmd", "state.ddq_cmd",
    "inputs.period_ns", "inputs.missed_ticks", "inputs.late", "inputs.events.count", "inputs.events.kind",
    "inputs.human.present", "inputs.human_age_ns", "inputs.sensors.count",
    *(f"inputs.sensors.{name}" for name in SENSOR_COLUMNS),
    "inputs.joint.present", "inputs.joint.q", "inputs.joint.dq", "inputs.joint.tool_id", "inputs.joint.t_rx_ns",
    "outputs.decision.status", "outputs.decision.share", "outputs.decision.d_measured",
    "outputs.command.kind", "outputs.command.q", "outputs.command.tau",
    "outputs.command.present", "receipt.present", "receipt.ok", "receipt.seq", "receipt.t_tx_ns",
    "timings.t_wake_ns", "timings.t_write_end_ns",
})  # fmt: skip


@dataclass
class Evidence:
    """`c`: column by path of the field; derived ones have names without a dot."""

    log: Recording
    c: dict[str, Column]
    broken_records: int  # whose own checksum is wrong
    packets: Packets  # by their time
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


def gather(path: str | Path, progress: Progress = iter) -> Evidence:
    """Open the recording and take all that is needed in the same pass. LogError: the file."""
    harvest = _Harvest()
    log = open_recording(path, harvest, progress)
    harvest.condense(log.layout)  # the rest
    return Evidence(log, harvest.columns(), harvest.broken, (harvest.packets["rx"], harvest.packets["tx"]))


class _Harvest:
    """A `Visitor` that keeps columns of the cycles, and the packets."""

    def __init__(self) -> None:
        self._columns: dict[str, Column] = {}
        self._count = 0  # cycles in them; behind it they have room
        self.packets: dict[str, dict[int, bytes]] = {"rx": {}, "tx": {}}
        self.broken = 0  # records whose own checksum is wrong
        self._waiting: list[bytes] = []

    def __call__(self, log: Log, topic: str, messages: list[bytes]) -> None:
        if topic == schema.CYCLE.topic:
            self.broken += sum(log.layout.syndrome(record) != 0 for record in messages)
            self._waiting += messages
            if len(self._waiting) >= BLOCK:
                self.condense(log.layout)
        elif topic in _WIRES:
            kept = self.packets[_WIRES[topic]]
            for message in messages:
                t_ns, _, data = schema.parse_wire_message(message)
                kept[t_ns] = data

    def condense(self, layout: RecordLayout) -> None:
        """Keep the columns of the records that wait."""
        block = np.frombuffer(b"".join(self._waiting), layout.dtype)
        self._waiting = []
        first, self._count = self._count, self._count + len(block)
        for path, values in ({path: block[path] for path in _COLUMNS} | _derived(block)).items():
            column = self._columns.setdefault(path, np.empty((0, *values.shape[1:]), values.dtype))
            if len(column) < self._count:
                _resize(column, self._count + self._count // 4)
            column[first : self._count] = values

    def columns(self) -> dict[str, Column]:
        for column in self._columns.values():
            _resize(column, self._count)
        return self._columns


def _resize(column: Column, length: int) -> None:
    """In place: pieces that are joined at the end would be in memory twice."""
    column.resize((length, *column.shape[1:]), refcheck=False)


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
