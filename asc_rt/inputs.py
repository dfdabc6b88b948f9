"""freeze(): everything that one cycle may know, read once. The only reader of the clock and of the mailboxes."""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Mapping

from asc_rt.core.fusion import union
from asc_rt.core.types import (
    MAX_CAPSULES,
    CycleInputs,
    EventKind,
    Goal,
    HumanState,
    JointState,
    OperatorEvent,
    SensorReport,
    Vector,
    vector,
)
from asc_rt.human_codec import clock_id
from asc_rt.pacing import Clock, Pacer
from asc_rt.sensor_mail import Inbox, SensorMail

MAX_EVENTS = 4  # in one cycle; the rest waits for the next, nothing is lost
MAX_DRAIN = 64  # messages taken from the bus in one cycle: bounds the work, whoever floods us
ID_MAX = 2**63 - 1
TOOL_MAX = 2**31 - 1


class MailFault(Exception):
    """An operator or goal message that cannot be used."""


class Mail:
    """The mailboxes of the control process and what was last in them.

    `faults` holds one line for every message that was refused, for the report; a refused human message also shows up in
    its sensor's report until good ones have come. `end_requested` may be set by a signal handler: the session ends as
    by END.
    """

    def __init__(
        self,
        people: Mapping[int, Inbox],
        operator: Inbox,
        goal: Inbox,
        joints: int,
        clock: str | None = None,
        reach: tuple[Vector, Vector] | None = None,
    ) -> None:
        """`people`: a box for every expected sensor, by its id. `reach`: least and greatest angles of a goal, rad."""
        clock = clock or clock_id()
        self._sensors = [SensorMail(number, box, clock) for number, box in people.items()]
        self._operator_box, self._goal_box = operator, goal
        self._joints, self._reach = joints, reach
        self._events: deque[OperatorEvent] = deque()
        self._event_id = 0
        self.human: HumanState | None = None
        self.goal: Goal | None = None
        self.faults: deque[str] = deque(maxlen=100)
        self.end_requested = False

    def collect(self) -> None:
        """Take over what has arrived."""
        self._take_people()
        if (data := self._goal_box.take()) is not None:
            self._take_goal(data)
        for _ in range(MAX_DRAIN):
            if (data := self._operator_box.take()) is None:
                break
            self._take_event(data)
        if self.end_requested:
            self.end_requested = False
            self._add_event(self._event_id + 1, EventKind.END)

    def reports(self, t_ns: int) -> tuple[SensorReport, ...]:
        """What every expected sensor says of itself, as of `t_ns`."""
        return tuple(sensor.report(t_ns) for sensor in self._sensors)

    def events(self) -> tuple[OperatorEvent, ...]:
        """The oldest operator events that no cycle has had yet."""
        return tuple(self._events.popleft() for _ in range(min(MAX_EVENTS, len(self._events))))

    def _take_people(self) -> None:
        """The newest message of every sensor, and what all of them see together."""
        before = [sensor.newest for sensor in self._sensors]
        for sensor in self._sensors:
            others = sum(len(other.state.radius) for other in self._sensors if other is not sensor and other.state)
            if wrong := sensor.collect(MAX_CAPSULES - others):
                self.faults.append(f"human message of sensor {sensor.id}: {wrong}")
        if any(sensor.newest is not old for sensor, old in zip(self._sensors, before, strict=True)):
            self.human = union([sensor.state for sensor in self._sensors if sensor.state is not None])

    def _take_goal(self, data: bytes) -> None:
        try:
            found = _table(data)
            q = found.get("q")
            if not isinstance(q, list) or len(q) != self._joints or not all(_is_finite(value) for value in q):
                raise MailFault(f"q is not a list of {self._joints} finite angles")
            if self._reach and (wrong := _out_of_reach(q, *self._reach)):
                raise MailFault(wrong)
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
            number, kind, tool = _id(found), EventKind[name], found.get("tool", 0)
            if not isinstance(tool, int) or isinstance(tool, bool) or not abs(tool) <= TOOL_MAX:
                raise MailFault(f"tool is not a whole number within {TOOL_MAX}")
            if kind is EventKind.ARM and number <= self._event_id:
                raise MailFault(f"ARM number {number} after {self._event_id}: repeated or late")
        except MailFault as error:
            self.faults.append(f"operator message: {error}")
            return
        self._add_event(max(number, self._event_id + 1), kind, tool)

    def _add_event(self, number: int, kind: EventKind, tool: int = 0) -> None:
        if kind is not EventKind.ARM:
            self._events = deque(event for event in self._events if event.kind is not EventKind.ARM)
        self._event_id = number
        self._events.append(OperatorEvent(number, kind, tool))


def _out_of_reach(q: list[float], least: Vector, greatest: Vector) -> str:
    """The first joint that cannot be where it should; empty: all can."""
    for i, (angle, low, high) in enumerate(zip(q, least, greatest, strict=True)):
        if not low <= angle <= high:
            given, *limits = (f"{math.degrees(value):.6g}" for value in (angle, low, high))
            return f"joint {i + 1} at {given} deg is out of reach; {limits[0]} to {limits[1]} deg"
    return ""


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
        sensors=mail.reports(t_ns),
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
