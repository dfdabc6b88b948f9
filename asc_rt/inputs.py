"""freeze(): everything that one cycle may know, read once. The only reader of the clock and of the mailboxes."""

from __future__ import annotations

import json
import math
from collections import deque
from typing import Protocol

from asc_rt.core.types import CycleInputs, EventKind, Goal, HumanState, JointState, OperatorEvent, vector
from asc_rt.human_codec import HumanCodecError, clock_id, decode
from asc_rt.pacing import Clock, Pacer

MAX_EVENTS = 4  # in one cycle; the rest waits for the next, nothing is lost
MAX_DRAIN = 64  # messages taken from the bus in one cycle: bounds the work, whoever floods us
ID_MAX = 2**63 - 1


class Inbox(Protocol):
    def take(self) -> bytes | None:
        """The next message, or None. Never waits."""


class MailFault(Exception):
    """An operator or goal message that cannot be used."""


class Mail:
    """The mailboxes of the control process and what was last in them.

    `faults` holds one line for every message that was refused, for the report; a refused human message also shows up as
    `human_fault` until a good one comes. `end_requested` may be set by a signal handler: the session ends as by END.
    """

    def __init__(self, human: Inbox, operator: Inbox, goal: Inbox, joints: int, clock: str | None = None) -> None:
        self._human_box, self._operator_box, self._goal_box = human, operator, goal
        self._joints = joints
        self._clock = clock or clock_id()
        self._events: deque[OperatorEvent] = deque()
        self._event_id = 0
        self._session = ""
        self._sessions: set[str] = set()
        self.human: HumanState | None = None
        self.human_fault = False
        self.goal: Goal | None = None
        self.faults: deque[str] = deque(maxlen=100)
        self.end_requested = False

    def collect(self) -> None:
        """Take over what has arrived."""
        if (data := self._human_box.take()) is not None:
            self._take_human(data)
        if (data := self._goal_box.take()) is not None:
            self._take_goal(data)
        for _ in range(MAX_DRAIN):
            if (data := self._operator_box.take()) is None:
                break
            self._take_event(data)
        if self.end_requested:
            self.end_requested = False
            self._add_event(self._event_id + 1, EventKind.END)

    def events(self) -> tuple[OperatorEvent, ...]:
        """The oldest operator events that no cycle has had yet."""
        return tuple(self._events.popleft() for _ in range(min(MAX_EVENTS, len(self._events))))

    def _take_human(self, data: bytes) -> None:
        """The newest state counts. One that runs backwards, or cannot be read, is a fault and changes nothing else."""
        self.human_fault = True
        try:
            state, session = decode(data, self._clock)
            self._check_order(state, session)
        except HumanCodecError as error:
            self.faults.append(f"human message: {error}")
            return
        self.human, self.human_fault = state, False

    def _check_order(self, state: HumanState, session: str) -> None:
        """Numbers increase within a session; a publisher may start anew, but two may not take turns."""
        if session != self._session and session in self._sessions:
            raise HumanCodecError(f"session {session!r} is back after another one: two publishers")
        last = self.human
        if last is not None and session == self._session and state.seq <= last.seq:
            raise HumanCodecError(f"number {state.seq} after {last.seq}")
        if last is not None and state.t_capture_ns < last.t_capture_ns:
            raise HumanCodecError(f"captured {(last.t_capture_ns - state.t_capture_ns) * 1e-6:.3f} ms before the last")
        self._session = session
        self._sessions.add(session)

    def _take_goal(self, data: bytes) -> None:
        try:
            found = _table(data)
            q = found.get("q")
            if not isinstance(q, list) or len(q) != self._joints or not all(_is_finite(value) for value in q):
                raise MailFault(f"q is not a list of {self._joints} finite angles")
            self.goal = Goal(_id(found), vector(q))
        except MailFault as error:
            self.faults.append(f"goal message: {error}")

    def _take_event(self, data: bytes) -> None:
        """An ARM counts once, and not after a later event. STOP and END always count and overtake an ARM that waits."""
        try:
            found = _table(data)
            name = found.get("kind")
            if not isinstance(name, str) or name not in EventKind.__members__:
                raise MailFault(f"kind is not one of {', '.join(EventKind.__members__)}")
            number, kind = _id(found), EventKind[name]
            if kind is EventKind.ARM and number <= self._event_id:
                raise MailFault(f"ARM number {number} after {self._event_id}: repeated or late")
        except MailFault as error:
            self.faults.append(f"operator message: {error}")
            return
        self._add_event(max(number, self._event_id + 1), kind)

    def _add_event(self, number: int, kind: EventKind) -> None:
        if kind is not EventKind.ARM:
            self._events = deque(event for event in self._events if event.kind is not EventKind.ARM)
        self._event_id = number
        self._events.append(OperatorEvent(number, kind))


def freeze(tick: int, period_ns: int, joint: JointState | None, mail: Mail, clock: Clock, pacer: Pacer) -> CycleInputs:
    """The inputs of cycle `tick`: the robot's sample, the newest messages, the time, and whether we are late."""
    mail.collect()
    t_ns = clock()
    pacer.began(t_ns, joint.seq if joint else None)
    human = mail.human
    return CycleInputs(
        tick=tick,
        t_ns=t_ns,
        period_ns=period_ns,
        joint=joint,
        human=human,
        human_age_ns=t_ns - human.t_capture_ns if human else 0,
        human_fault=mail.human_fault,
        goal=mail.goal,
        events=mail.events(),
        missed_ticks=pacer.missed,
        late=pacer.late,
    )


def _table(data: bytes) -> dict[str, object]:
    try:
        found = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise MailFault("not JSON") from error
    if not isinstance(found, dict):
        raise MailFault("not a JSON object")
    return found


def _id(found: dict[str, object]) -> int:
    number = found.get("id")
    if not isinstance(number, int) or isinstance(number, bool) or not 0 < number <= ID_MAX:
        raise MailFault(f"id is not a whole number within 1..{ID_MAX}")
    return number


def _is_finite(value: object) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer beyond any float
        return False
