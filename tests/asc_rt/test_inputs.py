"""What a cycle may know is read once, in order, and a message that is not in order never looks like a good one."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asc_rt import human_state_pb2 as pb
from asc_rt.core.types import CycleInputs, EventKind, JointState, MessageFault, RobotFlag, vector
from asc_rt.inputs import MAX_EVENTS, Mail, freeze
from asc_rt.pacing import DevicePaced
from asc_rt.sensor_mail import GOOD_AGAIN
from tests.box import Box

CLOCK = "HOST_MONO:test"
NOW = 5_000_000_000
N = 2
SENSOR = 1


class Desk:
    """Mail with boxes that the test fills."""

    def __init__(self) -> None:
        self.human, self.operator, self.goal = Box(), Box(), Box()
        reach = np.full(N, -np.pi), np.full(N, np.pi)
        self.mail = Mail({SENSOR: self.human}, self.operator, self.goal, joints=N, clock=CLOCK, reach=reach)
        self.pacer = DevicePaced(8_000_000, lambda: NOW)

    def person(self, seq: int, t_ns: int = 0, session: str = "a") -> None:
        t_ns = t_ns or NOW - 1000 + seq
        message = pb.HumanState(
            schema_version=1,
            sensor_id=SENSOR,
            session_uuid=session,
            seq=seq,
            clock_id=CLOCK,
            t_capture_ns=t_ns,
            frame_id="robot_base",
        )
        self.human.waiting.append(message.SerializeToString())

    def event(self, number: object, kind: object) -> None:
        self.operator.waiting.append(json.dumps({"id": number, "kind": kind}).encode())

    def aim(self, number: object, q: object) -> None:
        self.goal.waiting.append(json.dumps({"id": number, "q": q}).encode())

    def freeze(self, joint: JointState | None = None) -> CycleInputs:
        return freeze(3, 8_000_000, joint, self.mail, lambda: NOW, self.pacer)


@pytest.fixture
def desk() -> Desk:
    return Desk()


def sample(seq: int) -> JointState:
    q = vector(np.zeros(N))
    return JointState(NOW, 0, seq, q, q, q, RobotFlag.READY, 0, False)


def test_nothing_is_none_and_no_fault(desk: Desk) -> None:
    x = desk.freeze()
    assert (x.tick, x.t_ns, x.period_ns) == (3, NOW, 8_000_000)
    assert x.joint is None and x.human is None and x.goal is None
    assert (x.human_age_ns, x.events, x.missed_ticks, x.late) == (0, (), 0, False)
    assert [(r.id, r.seq, r.fault) for r in x.sensors] == [(SENSOR, 0, MessageFault.NONE)]


def test_everything_arrives_at_once(desk: Desk) -> None:
    desk.freeze(sample(10))
    desk.person(1, NOW - 7000)
    desk.event(1, "ARM")
    desk.aim(4, [0.1, 0.2])
    x = desk.freeze(sample(13))
    assert x.joint is not None and x.joint.seq == 13 and x.missed_ticks == 2
    assert x.human is not None and x.human.seq == 1 and x.human_age_ns == 7000
    assert x.goal is not None and x.goal.id == 4 and x.goal.q.tolist() == [0.1, 0.2]
    assert [(e.id, e.kind) for e in x.events] == [(1, EventKind.ARM)]


# --- people ----------------------------------------------------------------------------------------------------------


def test_the_newest_state_stays_until_a_newer_one_comes(desk: Desk) -> None:
    desk.person(1)
    assert desk.freeze().human is desk.freeze().human
    desk.person(2)
    x = desk.freeze()
    assert x.human is not None and x.human.seq == 2 and not is_faulty(x)


def test_a_stamp_ahead_of_us_is_a_negative_age(desk: Desk) -> None:
    desk.person(1, NOW + 500)
    assert desk.freeze().human_age_ns == -500


def is_faulty(x: CycleInputs) -> bool:
    return any(report.fault for report in x.sensors)


def faulty(desk: Desk) -> CycleInputs:
    """The fault is seen, stays, keeps the last good state, and goes with good messages."""
    good = desk.mail.human
    for x in (desk.freeze(), desk.freeze()):
        assert is_faulty(x)
        assert x.human is good
    assert desk.mail.faults
    return x


def test_bytes_that_are_no_state_are_a_fault_until_good_ones_come(desk: Desk) -> None:
    desk.person(1)
    desk.freeze()
    desk.human.waiting.append(b"\xff\xff")
    faulty(desk)
    for seq in range(2, 2 + GOOD_AGAIN):
        assert is_faulty(desk.freeze())
        desk.person(seq)
    assert not is_faulty(desk.freeze())


@pytest.mark.parametrize("seq", [4, 5])
def test_numbers_that_do_not_increase_are_a_fault(desk: Desk, seq: int) -> None:
    desk.person(5)
    desk.freeze()
    desk.person(seq)
    faulty(desk)


def test_capture_stamps_that_run_backwards_are_a_fault(desk: Desk) -> None:
    desk.person(1, NOW - 1000)
    desk.freeze()
    desk.person(2, NOW - 1001)
    faulty(desk)


def test_a_publisher_may_start_anew_but_two_may_not_take_turns(desk: Desk) -> None:
    desk.person(900, NOW - 3000, "a")
    desk.freeze()
    desk.person(1, NOW - 2000, "b")
    assert not is_faulty(desk.freeze())
    desk.person(901, NOW - 1000, "a")
    faulty(desk)


# --- the operator ----------------------------------------------------------------------------------------------------


def events(desk: Desk) -> list[str]:
    return [event.kind.name for event in desk.freeze().events]


def test_no_event_is_lost_and_few_come_at_once(desk: Desk) -> None:
    for number in range(1, 2 * MAX_EVENTS + 2):
        desk.event(number, "STOP")
    ids = [[event.id for event in desk.freeze().events] for _ in range(3)]
    assert [len(batch) for batch in ids] == [MAX_EVENTS, MAX_EVENTS, 1]
    assert sum(ids, []) == list(range(1, 2 * MAX_EVENTS + 2))


def test_an_event_comes_once(desk: Desk) -> None:
    desk.event(1, "ARM")
    assert events(desk) == ["ARM"]
    assert events(desk) == []


@pytest.mark.parametrize("kind", ["STOP", "END"])
def test_a_stop_overtakes_and_removes_an_arm_that_waits(desk: Desk, kind: str) -> None:
    for number in range(1, 30):
        desk.event(number, "ARM")
    desk.event(30, kind)
    desk.event(31, "ARM")
    assert events(desk) == [kind, "ARM"]


def test_an_old_arm_is_refused_but_an_old_stop_still_counts(desk: Desk) -> None:
    desk.event(5, "STOP")
    desk.event(5, "ARM")
    desk.event(4, "ARM")
    desk.event(2, "STOP")
    x = desk.freeze()
    assert [event.kind for event in x.events] == [EventKind.STOP, EventKind.STOP]
    assert [event.id for event in x.events] == [5, 6]  # increasing, so that the core hears both


def test_a_signal_ends_the_session_as_the_operator_would(desk: Desk) -> None:
    desk.event(3, "ARM")
    desk.freeze()
    desk.mail.end_requested = True
    (event,) = desk.freeze().events
    assert event.kind is EventKind.END and event.id == 4
    assert desk.freeze().events == ()


@pytest.mark.parametrize(
    ("number", "kind"), [(1, "GO"), (1, 1), (1, None), ("1", "ARM"), (True, "ARM"), (0, "ARM"), (2**63, "ARM")]
)
def test_events_that_are_none_are_noted_and_do_nothing(desk: Desk, number: object, kind: object) -> None:
    desk.event(number, kind)
    assert events(desk) == []
    assert len(desk.mail.faults) == 1


# --- goals -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("number", "q"),
    [(1, [0.0]), (1, [0.0] * 3), (1, "xy"), (1, [0.0, None]), (1, [0.0, True]), (1, [0.0, 10**400]), (-1, [0.0, 0.0])],
)
def test_goals_that_are_none_are_noted_and_change_nothing(desk: Desk, number: object, q: object) -> None:
    desk.aim(7, [0.5, 0.5])
    desk.freeze()
    desk.aim(number, q)
    x = desk.freeze()
    assert x.goal is not None and x.goal.id == 7
    assert len(desk.mail.faults) == 1


def test_a_goal_out_of_reach_is_noted_with_the_figure(desk: Desk) -> None:
    desk.aim(1, [0.5, -0.5])
    assert desk.freeze().goal is not None
    desk.aim(2, [0.5, 3.2])
    x = desk.freeze()
    assert x.goal is not None and x.goal.id == 1
    assert list(desk.mail.faults) == ["goal message: joint 2 at 183.346 deg is out of reach; -180 to 180 deg"]


@pytest.mark.parametrize("text", ['{"id": 1, "q": [NaN, 0]}', '{"id": 1, "q": [0, Infinity]}', "[]", "null", "{"])
def test_numbers_that_json_should_not_have_are_refused(desk: Desk, text: str) -> None:
    desk.goal.waiting.append(text.encode())
    assert desk.freeze().goal is None
    assert len(desk.mail.faults) == 1


@given(st.binary(max_size=60), st.binary(max_size=60), st.binary(max_size=60))
def test_whatever_arrives_freeze_returns_and_arms_nothing(human: bytes, operator: bytes, goal: bytes) -> None:
    desk = Desk()
    desk.human.waiting.append(human)
    desk.operator.waiting.append(operator)
    desk.goal.waiting.append(goal)
    x = desk.freeze()
    assert is_faulty(x) and x.human is None and x.goal is None and x.events == ()


def test_a_flood_of_messages_is_bounded_work(desk: Desk) -> None:
    for number in range(1, 10_000):
        desk.event(number, "ARM")
    desk.freeze()
    assert len(desk.operator.waiting) > 9_000
