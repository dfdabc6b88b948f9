"""What happened, in words and as states over time; and the moments at which robot and person were nearest."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import rerun as rr

from asc_rt.core.types import EventKind, Health, MessageFault, Mode, Status, StopReason
from logs.recording import Recording
from logs.summary import exit_reason
from logs.view_columns import DECISION, HUMAN, Array, Canvas, Records
from logs.view_layout import NEAR_MISSES

NEAR = 2.0  # ASSUMED: a measured distance below this many d_min is a near miss
APART_NS = 1_000_000_000  # ASSUMED: what is nearer in time than this is one and the same near miss


class Event(NamedTuple):
    t_ns: int
    level: str  # of the viewer's log: INFO, WARN, ERROR
    text: str


class Chronicle:
    """Follows the cycles: draws their states, and tells what changed."""

    def __init__(self, canvas: Canvas) -> None:
        self._canvas = canvas
        self._shown: dict[str, str] = {}  # newest state of each lane

    def draw(self, now: Records, following: Records) -> list[Event]:
        """The cycles `now`; `following`: the cycle after each of them. Their events are not drawn yet."""
        t_ns = now["inputs.t_ns"]
        self._send_states("state/mode", t_ns, following["state.mode"], Mode)
        self._send_states("state/safety_filter", t_ns, now[f"{DECISION}.status"], Status)
        return changes(now, following)

    def _send_states(self, entity: str, t_ns: Array, values: Array, kind: Any) -> None:
        """Only where the state changes: the viewer holds it until then."""
        changed = np.flatnonzero(np.append(True, values[1:] != values[:-1]))
        if kind(int(values[0])).name == self._shown.get(entity):
            changed = changed[1:]
        if len(changed):
            names = [kind(int(values[i])).name for i in changed]
            time = self._canvas.time(t_ns[changed])
            self._canvas.recording.send_columns(entity, [time], rr.StateChange.columns(state=names))
            self._shown[entity] = names[-1]


def draw_events(canvas: Canvas, events: list[Event]) -> None:
    """Of one moment or one session together: the viewer mixes up the levels of interleaved parts."""
    if events:
        t_ns, levels, texts = zip(*sorted(events), strict=True)
        columns = rr.TextLog.columns(text=texts, level=levels)
        canvas.recording.send_columns("events", [canvas.time(np.array(t_ns))], columns)


def changes(now: Records, following: Records) -> list[Event]:
    """Everything that an operator would want told, once each."""
    t, found = now["inputs.t_ns"].tolist(), []
    mode, reason = following["state.mode"], following["state.reason"]
    for i in np.flatnonzero((mode != now["state.mode"]) | (reason != now["state.reason"])):
        name, why = Mode(int(mode[i])), StopReason(int(reason[i]))
        level = "ERROR" if name is Mode.FAULT else "WARN" if name in (Mode.STOPPING, Mode.STOPPED) else "INFO"
        found.append(Event(t[i], level, name.name + (f": {why.name}" if why else "")))
    for i in np.flatnonzero(following["state.reached_id"] > now["state.reached_id"]):
        found.append(Event(t[i], "INFO", f"goal {int(following['state.reached_id'][i])} reached"))
    for i in np.flatnonzero(now["inputs.events.count"]):
        kinds = now["inputs.events.kind"][i][: int(now["inputs.events.count"][i])]
        found.append(Event(t[i], "INFO", "operator: " + ", ".join(EventKind(int(k)).name for k in kinds)))
    for i in _rises(now[f"{DECISION}.status"] == Status.INFEASIBLE):
        found.append(Event(t[i], "ERROR", "no control keeps every row"))
    for i in _rises((now[f"{HUMAN}.present"] == 1) & (now[f"{HUMAN}.health"] != Health.OK)):
        found.append(Event(t[i], "WARN", f"person sensor: {Health(int(now[f'{HUMAN}.health'][i])).name}"))
    for k, fault in enumerate(now["inputs.sensors.fault"].T):
        for i in _rises(fault != MessageFault.NONE):
            sensor, refused = int(now["inputs.sensors.id"][i, k]), MessageFault(int(fault[i]))
            found.append(Event(t[i], "WARN", f"sensor {sensor}: message refused: {refused.name}"))
    for i in _rises(following["state.slow"] != StopReason.NONE):
        found.append(Event(t[i], "WARN", f"slow: {StopReason(int(following['state.slow'][i])).name}"))
    for i in np.flatnonzero(now["inputs.missed_ticks"]):
        found.append(Event(t[i], "WARN", f"{int(now['inputs.missed_ticks'][i])} samples of the robot lost"))
    return found


def ending(log: Recording) -> Event:
    """How the session ended, at its last cycle."""
    last = np.frombuffer(log.record(log.cycles - 1), log.layout.dtype)
    reason = exit_reason({name: last[name] for name in log.layout.dtype.names or ()})
    level = "INFO" if reason == StopReason.SESSION_END.name else "ERROR"
    return Event(int(last["inputs.t_ns"][0]), level, f"end of the session: {reason}")


def _rises(condition: Array) -> Array:
    return np.flatnonzero(condition & ~np.append(False, condition[:-1]))


# --- near misses -----------------------------------------------------------------------------------------------------


class Nearest(NamedTuple):
    """The moments that an auditor looks for."""

    t_ns: Array  # of every near miss, at its least distance
    distance: Array  # m, measured
    worst_ns: int  # the least of them, or of the session where nothing came near


class Focus(NamedTuple):
    """What to look at in one moment."""

    joint: int  # whose control the filter changed most around it
    towards: float  # rad from the base's x axis: where the person was


def nearest_moments(log: Recording) -> Nearest:
    """Every near miss while the robot was live (armed or braking). LogError: the file."""
    c = log.columns("inputs.t_ns", "state.mode", f"{DECISION}.d_measured")
    t_ns, d = c["inputs.t_ns"], c[f"{DECISION}.d_measured"]
    d = np.where(np.isin(c["state.mode"], (Mode.ACTIVE, Mode.STOPPING)), d, np.inf)
    near = np.flatnonzero(d < NEAR * log.params.safety.d_min)
    runs = np.split(near, np.flatnonzero(np.diff(t_ns[near]) > APART_NS) + 1) if len(near) else []
    at = np.array([run[d[run].argmin()] for run in runs], np.intp)
    return Nearest(t_ns[at], d[at], int(t_ns[d.argmin()]))


def focus(log: Recording, moment_ns: int, window_ns: int) -> Focus:
    """`moment_ns`: on the clock of the record."""
    c = log.columns("inputs.t_ns", f"{DECISION}.u_ref", f"{DECISION}.u_safe")
    around = np.abs(c["inputs.t_ns"] - moment_ns) <= window_ns
    change = np.abs(c[f"{DECISION}.u_ref"] - c[f"{DECISION}.u_safe"])[around].sum(axis=0)
    now = np.frombuffer(log.record(int(np.abs(c["inputs.t_ns"] - moment_ns).argmin())), log.layout.dtype)[0]
    count = int(now[f"{HUMAN}.count"])
    x, y, _ = now[f"{HUMAN}.p0"][:count].mean(axis=0) if count else (1.0, 0.0, 0.0)
    return Focus(int(change.argmax()), float(np.arctan2(y, x)))


def draw_near_misses(canvas: Canvas, found: Nearest) -> list[Event]:
    """A dot in the distance plots for each; their events are not drawn yet."""
    if not len(found.t_ns):
        return []
    columns = rr.Scalars.columns(scalars=found.distance)
    canvas.recording.send_columns(NEAR_MISSES, [canvas.time(found.t_ns)], columns)
    d_min = canvas.params.safety.d_min
    events = []
    for t_ns, distance in zip(found.t_ns.tolist(), found.distance.tolist(), strict=True):
        inside = distance < d_min
        words = "UNDER d_min" if inside else "near miss"
        events.append(Event(t_ns, "ERROR" if inside else "WARN", f"{words}: {distance:.3f} m (d_min {d_min:.3f} m)"))
    return events
