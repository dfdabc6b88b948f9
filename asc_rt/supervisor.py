"""`asc run`: start a cell's processes, operate it, watch it, end it, and tell what happened."""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tqdm import tqdm

from asc_rt import clock_sync, realtime, ring, topics
from asc_rt.bus import Bus, open_router
from asc_rt.config import Cell
from asc_rt.console import Keyboard, Operator
from asc_rt.core.types import EventKind, StopReason
from asc_rt.processes import Death, Process, Processes, Spec, describe, table
from asc_rt.record import RecordLayout
from asc_rt.remote import door
from asc_rt.stop_hints import HINTS

READY_TIMEOUT_S = 180.0  # of one process, compiling included: 40 s of CPU the first time, on a loaded machine
CONTROL_END_TIMEOUT_S = 15.0
LAST_WORDS_S = 1.0  # for what the control process said last to arrive
POLL_S = 0.02
BAR = "{l_bar}{bar}| {n:.0f}/{total:.0f} s"
SAY_READY = (*topics.SIM_DEVICES, topics.PERCEPTION)


class StartError(Exception):
    """The session did not begin. The process at fault has said why on stderr."""


@dataclass(slots=True)
class Session:
    """What the supervisor found out; the rest is in the log."""

    log: Path
    started: bool = False
    control_code: int | None = None
    end: dict[str, Any] = field(default_factory=dict)  # what the control process said last
    deaths: list[str] = field(default_factory=list)  # processes that ended before they were asked to
    cpu_share: dict[str, float] = field(default_factory=dict)  # of one core, by process, while the cell ran
    recorded: bool = True  # the logger lived to the end

    @property
    def completed(self) -> bool:
        """It ended as asked, and all of it is in the log."""
        return self.control_code == 0 and self.recorded

    def exit_reason(self, logged: str) -> str:
        """Why it ended; `logged`: what the log says."""
        if self.completed:
            return "completed"
        if self.control_code == 0:
            return "LOGGER_DIED"
        return str(self.end.get("reason", "CONTROL_DIED")) if logged in ("UNFINISHED", "SESSION_END") else logged


def cell_operator(bus: Bus, cell: Cell) -> Operator:
    """Works through the goals of the cell; arms a simulated one."""
    events, goals = bus.event_publisher(topics.OPERATOR.key), bus.event_publisher(topics.GOAL.key)
    return Operator(events, goals, cell.goals, arms_itself=cell.simulated)


def run_cell(
    cell: Cell, log: Path, duration_s: float | None, operator: Callable[[Bus, Cell], Operator] = cell_operator
) -> Session:
    """Run `cell` for `duration_s`, or until Ctrl-C or until `operator` is done, and record it to `log`.

    BusError, RingError: nothing was started. StartError: a process did not become ready; all are ended.
    """
    realtime.leave(cell.realtime.cpu)
    ring_path = Path(f"/dev/shm/asc-{cell.name}-{os.getpid()}")
    session = Session(log)
    with open_router(cell.bus_endpoint, door(cell)) as bus:
        bus.answer(topics.CLOCK.key, clock_sync.answer)
        ring.create_session(ring_path, RecordLayout(cell.params.n).size, cell.params.period_ns)
        processes = Processes()
        interrupts: list[int] = []
        old = {s: signal.signal(s, lambda n, _: interrupts.append(n)) for s in (signal.SIGINT, signal.SIGTERM)}
        try:
            _Supervisor(cell, operator(bus, cell), bus, processes, session, interrupts).run(ring_path, duration_s)
        finally:
            processes.end_all_but_logger()
            ring.RingWriter(ring_path).close()  # on behalf of a control process that was killed
            processes.end_logger()
            session.control_code = processes.code("control")
            for number, handler in old.items():
                signal.signal(number, handler)
            session.recorded = processes.code("logger") == 0
            if session.recorded or not session.started:
                ring.remove_session(ring_path)
            else:
                print(f"the logger failed: cycles that are not in the log are in {ring_path}", file=sys.stderr)
    return session


class _Supervisor:
    def __init__(
        self,
        cell: Cell,
        operator: Operator,
        bus: Bus,
        processes: Processes,
        session: Session,
        interrupts: list[int],
    ) -> None:
        self._cell, self._operator, self._processes = cell, operator, processes
        self._session, self._interrupts = session, interrupts
        self._state_box = bus.latest(topics.STATE.key)
        self._control_box = bus.queue(topics.CONTROL.key)
        self._device_boxes = {name: bus.latest(topics.ready(name).key) for name in SAY_READY}
        self._keyboard = None if cell.simulated else Keyboard()
        self._said: tuple[Any, ...] = ()

    def run(self, ring_path: Path, duration_s: float | None) -> None:
        self._start(ring_path)
        began, before = time.monotonic(), self._processes.cpu_s()
        self._operate(duration_s)
        spent, seconds = self._processes.cpu_s(), time.monotonic() - began
        self._session.cpu_share = {name: round((s - before.get(name, 0.0)) / seconds, 3) for name, s in spent.items()}
        self._finish()

    # --- start -------------------------------------------------------------------------------------------------------

    def _start(self, ring_path: Path) -> None:
        """Everything that the control process relies on, then the control process."""
        specs = table(self._cell, ring_path, self._session.log)
        control = specs.pop("control")
        self._start_and_await(*specs.values())
        self._start_and_await(control)
        self._session.started = True

    def _start_and_await(self, *specs: Spec) -> None:
        """Start these together; StartError if one ends or does not become ready."""
        print(f"start {', '.join(spec.name for spec in specs)}", file=sys.stderr)
        for spec in specs:
            self._processes.start(spec)
        deadline = time.monotonic() + READY_TIMEOUT_S
        waiting = [spec.name for spec in specs]
        while waiting := [name for name in waiting if not self._is_ready(name)]:
            for name in waiting:
                if (code := self._processes.code(name)) is not None:
                    raise StartError(f"{name} did not start: {describe(code)}")
            if self._interrupts:
                raise StartError(f"interrupted while {' and '.join(waiting)} started")
            if time.monotonic() > deadline:
                raise StartError(f"not ready after {READY_TIMEOUT_S:g} s: {', '.join(waiting)}")
            time.sleep(POLL_S)

    def _is_ready(self, name: str) -> bool:
        if name == "logger":
            return self._session.log.exists()
        if name == "control":
            return self._heard("start") is not None
        return self._device_boxes[name].take() is not None

    def _heard(self, event: str) -> dict[str, Any] | None:
        """What the control process said; the end of the session is remembered."""
        while (data := self._control_box.take()) is not None:
            message: dict[str, Any] = json.loads(data)
            if message["event"] == "end":
                self._session.end = message
            if message["event"] == event:
                _tell_missing(message.get("realtime", {}))
                return message
        return None

    # --- operate -----------------------------------------------------------------------------------------------------

    def _operate(self, duration_s: float | None) -> None:
        """Until the duration is over, somebody interrupts, or a process ends that the session needs."""
        started = time.monotonic()
        if self._keyboard:
            print("type arm, stop or end; tool NUMBER says which tool is mounted", file=sys.stderr)
        with tqdm(total=duration_s, unit="s", disable=None, bar_format=None if duration_s is None else BAR) as bar:
            while not self._interrupts and not self._must_end():
                elapsed = time.monotonic() - started
                if self._operator.is_done or (duration_s is not None and elapsed >= duration_s):
                    return
                bar.update(elapsed - bar.n)
                self._hear_state()
                if self._keyboard and self._type(self._keyboard):
                    return
                time.sleep(POLL_S)

    def _hear_state(self) -> None:
        if (data := self._state_box.take()) is None:
            return
        state = json.loads(data)
        self._operator.hear(state, time.monotonic())
        while self._operator.takes_away:
            self._processes.end(self._operator.takes_away.pop())
        said = (state["mode"], state["reason"], state["reached_id"])
        if said != self._said:
            self._said = said
            hint = HINTS.get(StopReason[state["reason"]], "")
            reason = f" ({state['reason']}: {hint})" if hint else ""
            tqdm.write(f"{state['mode']}{reason}, goals reached: {state['reached_id']}", file=sys.stderr)

    def _type(self, keyboard: Keyboard) -> bool:
        """Act on what a person typed; True: end the session."""
        typed = keyboard.read()
        if isinstance(typed, int) and not isinstance(typed, EventKind):
            self._operator.say(EventKind.TOOL, typed)
        elif isinstance(typed, EventKind) and typed is not EventKind.END:
            self._operator.say(typed)
        elif isinstance(typed, str) and typed:
            print(f"{typed!r}? type arm, stop, end or tool NUMBER", file=sys.stderr)
        return typed is EventKind.END

    def _must_end(self) -> bool:
        """Tell of every process that ended by itself; True: the session cannot go on."""
        ended = list(self._processes.newly_ended())
        for process in ended:
            self._note_death(process)
        return any(process.spec.death is not Death.ROBOT_STOPS for process in ended)

    def _note_death(self, process: Process) -> None:
        code = process.code if process.code is not None else 0
        line = f"{process.name} ended ({describe(code)}): {process.spec.death}"
        self._session.deaths.append(line)
        tqdm.write(line, file=sys.stderr)

    # --- end ---------------------------------------------------------------------------------------------------------

    def _finish(self) -> None:
        """Ask the control process to end, and hear why it did; the caller ends the rest."""
        if self._processes.code("control") is None:
            self._operator.say(EventKind.END)
            self._processes.wait("control", CONTROL_END_TIMEOUT_S)
        deadline = time.monotonic() + LAST_WORDS_S
        while self._heard("end") is None and not self._session.end and time.monotonic() < deadline:
            time.sleep(POLL_S)


def _tell_missing(realtime: dict[str, Any]) -> None:
    for line in realtime.get("missing", []):
        print(f"real-time set-up lacks {line}", file=sys.stderr)
