"""The fault table of the cameras in real time: `python -m sim_hil seeing --faults`.

Sessions of the cell that sees, with all its processes and its cameras on the wire. When the arm works, a fault begins
(`sim/camera_fault`, or a signal to a process); it ends, and for a while longer nobody arms: the arm must rest until
then. Then the operator arms again, for the next row. What is told comes from the recording.
"""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from asc_rt import human_state_pb2 as pb
from asc_rt import topics
from asc_rt.bus import Bus
from asc_rt.config import Cell, load_cell
from asc_rt.console import Operator
from asc_rt.core.types import Mode, StopReason
from asc_rt.perception.eye import CameraFault
from asc_rt.perception.sensor import NO_JOINTS, UNWATCHED
from asc_rt.supervisor import run_cell
from logs.recording import Recording, open_recording
from sim_hil.camera_faults import Fault

WORK_S = 1.0  # the arm works undisturbed before a fault
FAULT_S = 1.5
REST_S = 3.5  # after it, in which nobody arms: cameras are believed again after a second
FAST, STILL = 0.2, 0.01  # rad/s: it works; it rests
LASTING_MS = 150  # more than two pictures
REACTION_MS = 400  # age limit 200 ms, two pictures, and one more for a picture that this PC was late with
PATIENCE_S = 60.0  # until the arm works, or the table ends where it is
OUTSIDE = ("sim.human.start_s=1000000",)  # the person stands outside all the time


@dataclass(frozen=True, slots=True)
class Row:
    name: str
    fault: str  # of `camera_faults`, or a signal's name
    whom: str = ""  # a camera, "": all; or the process that gets the signal, which is the last row of a session
    value: float = 1.0


Rows = tuple[Row, ...]
CAMERAS: Rows = (
    Row("one camera frozen", "freeze", "left"),
    Row("both frozen", "freeze"),
    Row("one unplugged", "silent", "left"),
    Row("both unplugged", "silent"),
    Row("one covered", "cover", "left"),
    Row("both covered", "cover"),
    Row("one sends damaged pictures", "damage", "left"),
    Row("one shifted by 50 mm", "shift_mm", "left", 50.0),
    Row("one turned by 1 degree", "turn_deg", "left", 1.0),
    Row("one's clock 300 ms ahead", "clock_ms", "left", 300.0),
    Row("one's clock 150 ms behind", "clock_ms", "left", -150.0),
    Row("one's clock 600 ms behind", "clock_ms", "left", -600.0),
    Row("both clocks 300 ms ahead", "clock_ms", "", 300.0),
    Row("perception killed", "SIGKILL", "perception"),
)
DEVICES = (Row("both cameras killed", "SIGKILL", "camera"),)
HANGING = (Row("perception hangs", "SIGSTOP", "perception"),)
SESSIONS = (CAMERAS, DEVICES, HANGING)


@dataclass(slots=True)
class Struck:
    row: Row
    t_ns: int  # when it began
    until_ns: int = 0  # when the operator armed again
    bits: int = 0  # of what perception said meanwhile


class Saboteur(Operator):
    """Arms, works, does harm, looks on without arming; row after row."""

    def __init__(self, bus: Bus, cell: Cell, rows: Rows) -> None:
        super().__init__(
            bus.event_publisher(topics.OPERATOR.key), bus.event_publisher(topics.GOAL.key), cell.goals, arms_itself=True
        )
        assert cell.perception is not None
        self._rows, self.struck = list(rows), list[Struck]()
        self._faults = bus.event_publisher(topics.CAMERA_FAULT.key)
        self._said = bus.queue(topics.human(cell.perception.sensor).key)
        self._ready = {name: bus.latest(topics.ready(name).key) for name in ("camera", topics.PERCEPTION)}
        self._pids: dict[str, int] = {}
        self._since = self._waits_since = time.monotonic()

    def hear(self, state: dict[str, Any], now: float) -> None:
        super().hear(state, now)
        self._listen()
        if not self._arms_itself:
            self._look_on(now)
        elif state.get("mode") != Mode.ACTIVE.name or max(map(abs, state["dq_cmd"])) < FAST:
            self._since = now if state.get("mode") != Mode.ACTIVE.name else self._since
            self.is_done = now - self._waits_since > PATIENCE_S
        elif now - self._since > WORK_S:
            self._strike(self._rows.pop(0), now)

    def _strike(self, row: Row, now: float) -> None:
        self._arms_itself, self._since = False, now
        self.struck.append(Struck(row, time.monotonic_ns()))
        if row.fault.startswith("SIG"):
            os.kill(self._pids[row.whom], signal.Signals[row.fault])
        else:
            self._faults.put_json(dataclasses.asdict(Fault(0.0, row.fault, row.whom, row.value, FAULT_S)))

    def _look_on(self, now: float) -> None:
        if now - self._since < FAULT_S + REST_S:
            return
        last = self.struck[-1]
        last.until_ns = time.monotonic_ns()
        if last.row.fault == "SIGSTOP":
            os.kill(self._pids[last.row.whom], signal.SIGKILL)
        self.is_done = not self._rows
        self._arms_itself, self._since, self._waits_since = True, now, now

    def _listen(self) -> None:
        for name, box in self._ready.items():
            if (data := box.take()) is not None:
                self._pids[name] = json.loads(data)["pid"]
        while (data := self._said.take()) is not None:
            message = pb.HumanState.FromString(data)
            if self.struck and message.t_publish_ns > self.struck[-1].t_ns and not self._arms_itself:
                self.struck[-1].bits |= message.health_bits


def run(cell: Cell, log: Path, rows: Rows) -> list[dict[str, Any]]:
    """One session: each row that began."""
    made: list[Saboteur] = []

    def operator(bus: Bus, cell: Cell) -> Saboteur:
        made.append(Saboteur(bus, cell, rows))
        return made[0]

    run_cell(cell, log, None, operator)
    recording = open_recording(log)
    return [told(recording, struck) for struck in made[0].struck]


def told(recording: Recording, struck: Struck) -> dict[str, Any]:
    """One row of the table. Times in ms after the fault was sent to its device; None: never."""
    columns = ("inputs.t_ns", "state.mode", "state.reason", "state.slow", "state.dq_cmd", "inputs.joint.dq")
    t_ns, *rest = recording.columns(*columns).values()
    during = (t_ns >= struck.t_ns) & (t_ns < (struck.until_ns or t_ns[-1] + 1))
    t_ms = (t_ns[during] - struck.t_ns) * 1e-6
    mode, reason, slow, commanded, measured = (column[during] for column in rest)
    speed = np.maximum(np.abs(commanded).max(1, initial=0.0), np.abs(measured).max(1, initial=0.0))
    works, rests = mode == Mode.ACTIVE, (mode != Mode.ACTIVE) & (speed < STILL)
    reacts_ms, rests_ms = _lasting(t_ms, ~works | (slow != StopReason.NONE)), _lasting(t_ms, rests)
    bits: dict[int, str] = {int(fault): str(fault.name) for fault in CameraFault}
    bits |= {NO_JOINTS: "NO_JOINTS", UNWATCHED: "UNWATCHED"}
    return {
        "fault": struck.row.name,
        "perception": [name for bit, name in bits.items() if struck.bits & bit],
        "control": [StopReason(n).name for n in dict.fromkeys([*slow.tolist(), *reason.tolist()]) if n],
        "reacts_ms": reacts_ms,
        "rests_ms": rests_ms,
        "greatest_speed_then": None if rests_ms is None else round(float(speed[t_ms >= rests_ms].max()), 4),
        "full_speed_ms": _spent(t_ms, works & (slow == StopReason.NONE) & (t_ms < FAULT_S * 1e3)),
        "unarmed_s": round(float(t_ms[-1]) * 1e-3, 1) if len(t_ms) else 0.0,
    }


def is_safe(row: dict[str, Any]) -> bool:
    """It rests until somebody arms, or goes on slowly as long as the fault lasts; soon in both cases."""
    if row["reacts_ms"] is None or row["reacts_ms"] > REACTION_MS:
        return False
    if row["rests_ms"] is not None:
        return bool(row["greatest_speed_then"] < STILL)
    return bool(row["full_speed_ms"] < REACTION_MS)


def _lasting(t_ms: np.ndarray, holds: np.ndarray) -> int | None:
    """When it begins to hold for LASTING_MS at least; None: never. Data that are old for a moment are no reaction."""
    since = None
    for t, one in zip(t_ms.tolist(), holds.tolist(), strict=True):
        since = (t if since is None else since) if one else None
        if since is not None and t - since >= LASTING_MS:
            return round(since)
    return None


def _spent(t_ms: np.ndarray, holds: np.ndarray) -> int:
    return round(float(np.diff(t_ms, prepend=0.0)[holds].sum()))


def table(cell_name: str, overrides: Sequence[str] = (), sessions: Sequence[Rows] = SESSIONS) -> list[dict[str, Any]]:
    """Every row of these sessions. StartError, BusError: one did not begin."""
    rows = []
    for session in sessions:
        with TemporaryDirectory() as folder:
            rows += run(load_cell(cell_name, (*OUTSIDE, *overrides)), Path(folder) / "log.mcap", session)
    return rows
