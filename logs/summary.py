"""What happened in a session, computed from its log alone: the numbers that `asc run` prints."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from asc_rt.core.types import Mode, Status, StopReason
from logs import latency, schema
from logs.mcap_scan import LogError
from logs.recording import Recording, open_recording

APPROACH_M_S = 0.01  # ASSUMED: slower is the servo's trembling about its set-point, not the robot coming closer

Column = np.ndarray[Any, Any]

STOP_COLUMNS = (  # what `stops` needs
    "state.mode", "state.reason", "inputs.tick", "inputs.t_ns", "outputs.decision.reason", "outputs.command.present",
    "outputs.command.is_last", "outputs.stop.present",
)  # fmt: skip
_AT_STOP = (Mode.STOPPING, Mode.STOPPED, Mode.FAULT)
_COLUMNS = (
    "state.mode", "state.reason", "state.reached_id",
    "inputs.tick", "inputs.t_ns", "inputs.missed_ticks", "inputs.late", "inputs.joint.present", "inputs.joint.t_rx_ns",
    "outputs.decision.status", "outputs.decision.reason", "outputs.decision.d_measured", "outputs.decision.d_goal",
    "state.goal.id",
    "outputs.command.present", "outputs.command.is_last", "outputs.stop.present",
    "timings.t_wake_ns", "timings.t_write_end_ns",
)  # fmt: skip


def summarise(path: str | Path) -> dict[str, Any]:
    """JSON-able; None where the log cannot tell. LogError: the file."""
    log = open_recording(path)
    c = log.columns(*dict.fromkeys((*_COLUMNS, *latency.COLUMNS)))
    truth = Truth(log, c["inputs.t_ns"])
    truth_distance = truth.distance[np.isfinite(truth.distance)]
    measured = c["outputs.decision.d_measured"]
    distances = truth_distance if len(truth.distance) else measured[np.isfinite(measured)]
    return {
        "cycles": log.cycles,
        "period_ms": log.params.period_ns * 1e-6,
        "missed_deadlines": int(np.maximum(c["inputs.missed_ticks"], c["inputs.late"]).sum()),
        "cycle_us": _percentiles(c["timings.t_write_end_ns"] - c["timings.t_wake_ns"]),
        "wake_us": _percentiles(_wake_ns(c)),
        "photon_to_command_ms": latency.statistics(latency.photon_to_command_ns(c)),
        "min_distance_m": float(distances.min()) if len(distances) else None,
        "robot_caused_violations": truth.violations(log.params.safety.d_min) if len(truth.distance) else None,
        "contacts": truth.contacts,
        "infeasible_cycles": int((c["outputs.decision.status"] == Status.INFEASIBLE).sum()),
        "goals_reached": int((np.diff(c["state.reached_id"]) > 0).sum()),
        "goal_blocked_s": round(int(_blocked(c, log.params.safety.d_min).sum()) * log.params.period, 3),
        "stops": stops(c),
        "dropped_records": dropped(log, c["inputs.tick"]),
        "log": str(path),
        "exit_reason": exit_reason(c),
        "truncated": log.truncated,
    }


def _blocked(c: dict[str, Column], d_min: float) -> Column:
    """Cycles in which the arm worked towards a goal where it would have been nearer to a person than d_min."""
    underway = (c["state.mode"] == Mode.ACTIVE) & (c["state.goal.id"] != c["state.reached_id"])
    return underway & (c["outputs.decision.d_goal"] < d_min)


def stops(c: dict[str, Column]) -> list[dict[str, Any]]:
    """Every time the robot was stopped against the will of its goal: where in the session, why, for how long it braked.

    The end of the session on request is none.
    """
    mode, reason, tick, t_ns = c["state.mode"], c["state.reason"], c["inputs.tick"], c["inputs.t_ns"]
    if not len(mode):
        return []
    # Mode and reason after each cycle: what the next record begins with; after the last one, what its outputs tell.
    mode_after = np.append(mode[1:], _last_mode(c))
    reason_after = np.append(reason[1:], c["outputs.decision.reason"][-1])
    stopped, was_stopped = np.isin(mode_after, _AT_STOP), np.isin(mode, _AT_STOP)
    again = (mode == Mode.STOPPED) & np.isin(mode_after, (Mode.STOPPING, Mode.FAULT))
    found = []
    for i in np.flatnonzero((stopped & ~was_stopped) | again):
        braking = np.flatnonzero(mode_after[i:] != Mode.STOPPING)
        rest = i + int(braking[0]) if len(braking) else len(mode) - 1
        if reason_after[i] != StopReason.SESSION_END or reason_after[rest] != StopReason.SESSION_END:
            found.append(
                {
                    "cycle": int(tick[i]),
                    "t_s": round(float(t_ns[i] - t_ns[0]) * 1e-9, 6),
                    "reason": StopReason(int(reason_after[i])).name,
                    "final_reason": StopReason(int(reason_after[rest])).name,
                    "braking_s": round(float(t_ns[rest] - t_ns[i]) * 1e-9, 6),
                }
            )
    return found


def exit_reason(c: dict[str, Column]) -> str:
    """Name of the StopReason that ended the session; UNFINISHED: the log stops in mid-session."""
    ended = len(c["state.mode"]) and _last_mode(c).is_over
    return StopReason(int(c["outputs.decision.reason"][-1])).name if ended else "UNFINISHED"


def dropped(log: Recording, tick: Column) -> int:
    """Cycles that were run and are not in the log: what the logger counted, and what the ticks show."""
    counted = [json.loads(message.data)["cycle"] for message in log.messages(schema.DROPOUT.topic)]
    missing = int(tick[-1] - tick[0]) + 1 - len(tick) if len(tick) else 0
    return max([missing, *counted])


def _last_mode(c: dict[str, Column]) -> Mode:
    """After the last cycle."""
    over = c["outputs.stop.present"][-1] or (c["outputs.command.present"][-1] and c["outputs.command.is_last"][-1])
    if not over:
        return Mode(int(c["state.mode"][-1]))
    return Mode.FAULT if StopReason(int(c["outputs.decision.reason"][-1])).is_fault else Mode.ENDED


def _wake_ns(c: dict[str, Column]) -> Column:
    """From the sample's arrival in this process to the loop having it, where there was a sample."""
    heard = c["inputs.joint.present"] == 1
    delay: Column = (c["timings.t_wake_ns"] - c["inputs.joint.t_rx_ns"])[heard]
    return delay


def _percentiles(ns: Column) -> dict[str, float | None]:
    if not len(ns):
        return {"p50": None, "p99": None, "max": None}
    p50, p99 = np.percentile(ns, [50, 99])
    return {
        "p50": round(float(p50) * 1e-3, 3),
        "p99": round(float(p99) * 1e-3, 3),
        "max": round(float(ns.max()) * 1e-3, 3),
    }


class Truth:
    """What the simulated plant says really happened while the session ran; empty for a real robot."""

    def __init__(self, log: Recording, t_ns: Column) -> None:
        begin, end = (int(t_ns[0]), int(t_ns[-1])) if len(t_ns) else (0, -1)  # the plant is there before and after
        try:
            told = (m for m in log.messages(schema.TRUTH.topic) if begin <= m.t_ns <= end)
            rows = [json.loads(message.data) for message in told]
            far = math.inf
            self.distance = np.array([far if r["distance_m"] is None else r["distance_m"] for r in rows], float)
            self.approach = np.array([r["approach_m_s"] for r in rows], float)
            self.q = [np.array(r.get("q", []), float) for r in rows]
            contact = np.array([r["contact"] for r in rows], bool)
        except (ValueError, TypeError, KeyError) as error:
            raise LogError(f"{log.path}: {schema.TRUTH.topic} holds something else than the plant's truth") from error
        self.contacts = _episodes(contact, np.ones(len(rows), bool))

    def violations(self, d_min: float) -> int:
        """Times that the person was nearer than d_min while the robot itself came closer.

        A person who walks up to a robot at rest violates the distance, but not by the robot's doing.
        """
        return _episodes(self.distance < d_min, self.approach > APPROACH_M_S)


def _episodes(condition: Column, blame: Column) -> int:
    """Unbroken runs of `condition` in which `blame` holds at least once."""
    starts = condition & ~np.append(False, condition[:-1])
    number = np.cumsum(starts)
    return len(np.unique(number[condition & blame]))
