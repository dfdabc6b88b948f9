"""The fault table of what is heard of people: every row is safe, whatever a sensor, a network or a stranger does.

A working arm, real messages through the control process's own mailbox, in lockstep. The person stands 1 m away and is
told truly until the fault begins.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from asc_rt import human_state_pb2 as pb
from asc_rt.config import load_cell
from asc_rt.core.step import step
from asc_rt.core.system import System, initial
from asc_rt.core.types import (
    CycleInputs,
    EventKind,
    Goal,
    JointState,
    Mode,
    OperatorEvent,
    RobotFlag,
    StopReason,
    vector,
)
from asc_rt.inputs import Mail, freeze
from asc_rt.pacing import DevicePaced
from sim_hil.seeing_cell import Box, Nothing

R = StopReason
CLOCK, PERIOD_NS, START_NS = "HOST_MONO:test", 8_000_000, 10**12
LATENCY_NS = 30_000_000
SENSORS = 'human.sensors=["a", "b"]'
FAULT_AT, CYCLES = 30, 160
HOME, AWAY = np.radians([0.0, 5.0, 10.0, 0.0, -75.0, 0.0]), np.radians([90.0, 5.0, 10.0, 0.0, -75.0, 0.0])

Fields = dict[str, Any]


def message(sensor: int, t_ns: int, k: int, **changes: Any) -> bytes:
    capsule = pb.Capsule(
        label="body", p0=[1.0, 0.0, -0.3], p1=[1.0, 0.0, 0.9], radius=0.2, v0=[0, 0, 0], v1=[0, 0, 0],
        position_bound=0.02, velocity_bound=0.3,
    )  # fmt: skip
    fields: Fields = {
        "schema_version": 1, "sensor_id": sensor, "session_uuid": f"s{sensor}", "seq": k + 1, "clock_id": CLOCK,
        "t_capture_ns": t_ns - LATENCY_NS, "frame_id": "robot_base", "coverage": 1.0, "empty_certified": True,
        "bodies": [pb.Body(capsules=[capsule])],
    }  # fmt: skip
    data: bytes = pb.HumanState(**(fields | changes)).SerializeToString()
    return data


Say = Callable[[int, int], bytes | None]  # (time, cycle) -> what the faulty sensor says in that cycle


@dataclass
class Story:
    slow: set[StopReason]
    reason: StopReason
    mode: Mode
    rest_after: int  # cycles from the fault until the arm stands; 0: it never does


def play(system: System, say: Say) -> Story:
    """Sensor 1 goes wrong at FAULT_AT; sensor 2 stays in order."""
    boxes = {1: Box(), 2: Box()}
    mail = Mail(boxes, Nothing(), Nothing(), joints=system.n, clock=CLOCK)
    pacer = DevicePaced(PERIOD_NS, lambda: START_NS)
    state, zero = initial(system), vector(np.zeros(system.n))
    slow: set[StopReason] = set()
    rest_after = 0
    for k in range(CYCLES):
        now = START_NS + k * PERIOD_NS
        clock = functools.partial(int, now)
        boxes[1].newest = say(now, k) if k >= FAULT_AT else message(1, now, k)
        boxes[2].newest = message(2, now, k)
        q = state.q_cmd if k else vector(HOME)
        joint = JointState(now, k, k, q, state.dq_cmd, zero, RobotFlag.READY | RobotFlag.SERVO_ON, 0, True)
        x = freeze(k, PERIOD_NS, joint, mail, clock, pacer)
        x = with_operator(x, k)
        state, _ = step(system, state, x)
        slow.add(state.slow)
        if k == FAULT_AT - 1:
            assert state.mode is Mode.ACTIVE and np.abs(state.dq_cmd).max() > 0.5, "the arm works"
            assert slow == {R.NONE}
        if k >= FAULT_AT and not rest_after and not np.any(state.dq_cmd):
            rest_after = k - FAULT_AT
        if state.mode.is_over:
            rest_after = rest_after or k - FAULT_AT
            break
    return Story(slow - {R.NONE}, state.reason, state.mode, rest_after)


def with_operator(x: CycleInputs, k: int) -> CycleInputs:
    """Armed once, towards a far goal; and again and again after the fault, as by somebody who does not look."""
    events = (OperatorEvent(k + 1, EventKind.ARM),) if k == 2 or k > FAULT_AT + 60 else ()
    return dataclasses.replace(x, events=events, goal=Goal(1, vector(AWAY)))


@pytest.fixture(scope="module")
def system() -> System:
    return System(load_cell("fanuc-sim-truth", [SENSORS]).params)


def good(t_ns: int, k: int, **changes: Any) -> bytes:
    return message(1, t_ns, k, **changes)


def frozen(t_ns: int, k: int) -> bytes:
    """The same image again and again, newly numbered and sent."""
    return good(START_NS + FAULT_AT * PERIOD_NS, k)


def behind(t_ns: int, k: int) -> bytes | None:
    """Its clock was set back: what it says now seems older than what it said before, and later just old."""
    return good(t_ns - OLDER, k)


def held_up(t_ns: int, k: int) -> bytes | None:
    """Messages begin to take 90 ms longer."""
    return good(t_ns - 90_000_000, k) if t_ns - 90_000_000 >= START_NS + FAULT_AT * PERIOD_NS else None


def turns(t_ns: int, k: int) -> bytes:
    return good(t_ns, k, session_uuid="thief") if k % 2 else good(t_ns, k)


def odd(number: int, say: Say, otherwise: Say) -> Say:
    return lambda t_ns, k: say(t_ns, k) if (k - FAULT_AT) % number == 0 else otherwise(t_ns, k)


OLDER = 250_000_000
CROWD = [pb.Body(capsules=[pb.Capsule(p0=[3, 0, 0], p1=[3, 0, 1], radius=0.1, v0=[0] * 3, v1=[0] * 3)] * 20)]
NO_BODY: Fields = {"bodies": [], "empty_certified": False}

# what goes wrong -> what it says, the rungs of slow on the way, the reason, whether the session is over
TABLE: dict[str, tuple[Say, set[StopReason], StopReason, bool]] = {
    "killed": (lambda t, k: None, {R.HUMAN_STALE}, R.HUMAN_STALE, False),
    "frozen image": (frozen, set(), R.HUMAN_INVALID, False),
    "blind": (lambda t, k: good(t, k, health=pb.HEALTH_FAULT), {R.HUMAN_UNHEALTHY}, R.HUMAN_UNHEALTHY, False),
    "covered": (lambda t, k: good(t, k, coverage=0.4), {R.HUMAN_COVERAGE}, R.HUMAN_COVERAGE, False),
    "covered in part": (lambda t, k: good(t, k, coverage=0.8), {R.HUMAN_COVERAGE}, R.NONE, False),
    "shifted: it says so": (lambda t, k: good(t, k, health=pb.HEALTH_DEGRADED), {R.HUMAN_UNHEALTHY}, R.NONE, False),
    "another calibration": (lambda t, k: good(t, k, calibration_hash=b"\1" * 32), set(), R.HUMAN_CALIBRATION, True),
    "sees nobody, is not sure": (lambda t, k: good(t, k, **NO_BODY), set(), R.HUMAN_UNHEALTHY, False),
    "clock set back": (behind, {R.HUMAN_STALE}, R.HUMAN_STALE, False),
    "clock ahead": (lambda t, k: good(t + OLDER, k), set(), R.HUMAN_CLOCK, True),
    "another clock": (lambda t, k: good(t, k, clock_id="HOST_MONO:other"), set(), R.HUMAN_CLOCK, True),
    "clock not known well": (lambda t, k: good(t, k, t_capture_sigma_ns=25_000_000), set(), R.HUMAN_UNSYNCED, False),
    "slow network": (
        lambda t, k: good(t - 90_000_000, k) if k > FAULT_AT + 11 else None,
        {R.HUMAN_STALE},
        R.NONE,
        False,
    ),
    "every other message lost": (odd(2, good, lambda t, k: None), set(), R.NONE, False),
    "duplicated": (lambda t, k: good(t, k - k % 2), set(), R.HUMAN_INVALID, False),
    "reordered": (lambda t, k: good(t, k - 2 * (k % 2)), set(), R.HUMAN_INVALID, False),
    "another schema": (lambda t, k: good(t, k, schema_version=2), set(), R.HUMAN_SCHEMA, True),
    "garbage": (lambda t, k: b"\xff" * 50, set(), R.HUMAN_INVALID, False),
    "not a number": (lambda t, k: good(t, k, coverage=float("nan")), set(), R.HUMAN_INVALID, False),
    "another sensor's": (lambda t, k: message(2, t, k), set(), R.HUMAN_INVALID, False),
    "claims to be safe": (lambda t, k: good(t, k, safety_rated=True), set(), R.HUMAN_INVALID, False),
    "two publishers": (turns, set(), R.HUMAN_INVALID, False),
    "too many people": (lambda t, k: good(t, k, bodies=CROWD), set(), R.HUMAN_INVALID, False),
}


@pytest.mark.parametrize("name", TABLE)
def test_every_row_is_safe(system: System, name: str) -> None:
    say, slow, reason, is_over = TABLE[name]
    story = play(system, say)
    assert story.slow == slow
    if reason is R.NONE:
        assert story.mode is Mode.ACTIVE
        return
    assert story.reason is reason
    assert story.mode is (Mode.FAULT if is_over else Mode.STOPPED), "nobody arms it while the fault is there"
    stale = system.params.human.age_limit_ns // PERIOD_NS if reason is R.HUMAN_STALE else 0
    assert 0 < story.rest_after <= stale + 70
