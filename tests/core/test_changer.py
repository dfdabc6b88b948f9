"""Tools that come and go: which cycle takes one over, which one is not moved with, and what a swap in motion may do."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from asc_rt.core.changer import knows, may_go_on, torque_misfit
from asc_rt.core.params import STAND_IN, ChangerParams, Mount
from asc_rt.core.robot_model import load
from asc_rt.core.rows import Rows
from asc_rt.core.safety_index import JERK_SHARE, psi
from asc_rt.core.step import step
from asc_rt.core.system import System, initial
from asc_rt.core.types import EventKind, Goal, Mode, OperatorEvent, Status, StopReason, vector

R, T = StopReason, 0.008
TOOLS = ("drill", "bat", "bare")
LEFT, RIGHT = np.radians([80.0, 20.0, 10.0, 0.0, -75.0, 0.0]), np.radians([-80.0, 20.0, 10.0, 0.0, -75.0, 0.0])


def changer(bench: Any, covered: bool = True, speed: float = 1.0, stand_in: bool = False, **given: Any) -> Any:
    """drill 1, bat 2 (covered or not, maybe slower), bare 3, and perhaps the drill for whatever else there is."""
    mounts = [Mount(i + 1, bench.params(tool).tool, 1.0, True) for i, tool in enumerate(TOOLS)]
    mounts[1] = replace(mounts[1], covered=covered, speed_share=speed)
    if stand_in:
        mounts.append(Mount(STAND_IN, bench.params("drill").tool, 1.0, True))
    return ChangerParams(**({"mounts": tuple(mounts), "told_by_robot": True} | given))


@cache
def make(bench: Any, **given: Any) -> System:
    return System(replace(bench.params(), changer=changer(bench, **given)))


def rig(bench: Any, people: Any = None, tool: int = 1, **given: Any) -> Any:
    made = bench.Rig(make(bench, **given), people or (lambda t: bench.NOBODY))
    made.tool = tool
    return made


def cycle(bench: Any, made: Any, *events: Any, goal: Any = LEFT, **changes: Any) -> Any:
    joint = bench.joint(made.q_true(), seq=made.tick, tool_id=made.tool)
    return made.cycle(events, Goal(1, vector(goal)), **({"joint": joint} | changes))


def moving(bench: Any, made: Any, seconds: float = 0.3) -> Any:
    cycle(bench, made)
    cycle(bench, made, made.arm())
    for _ in range(round(seconds / T)):
        cycle(bench, made)
    assert made.state.mode is Mode.ACTIVE
    assert np.abs(made.state.dq_cmd).max() > 0.3
    return made


def post(bench: Any, x: float, y: float) -> Any:
    return lambda t: bench.human([[x, y, -0.2]], [[x, y, 0.6]], 0.1)


@pytest.mark.parametrize(("number", "index"), [(1, 0), (2, 1), (3, 2), (0, 0), (-1, 0), (7, 0)])
def test_the_number_that_is_told_picks_the_tool_and_an_unknown_one_may_not_move(
    bench: Any, number: int, index: int
) -> None:
    made = rig(bench, tool=number)
    cycle(bench, made)
    after = cycle(bench, made, made.arm()).state
    assert after.tool == index
    known = number in (1, 2, 3)
    assert after.mode is (Mode.ACTIVE if known else Mode.HOLD)
    assert after.reason is (R.NONE if known else R.TOOL_UNKNOWN if number == -1 else R.TOOL_MISMATCH)


@pytest.mark.parametrize("number", [-1, 0, 7])
def test_a_stand_in_takes_the_place_of_whatever_is_not_known(bench: Any, number: int) -> None:
    made = rig(bench, tool=number, stand_in=True)
    cycle(bench, made)
    after = cycle(bench, made, made.arm()).state
    assert (after.tool, after.mode) == (3, Mode.ACTIVE)


def test_no_certificate_no_motion(bench: Any) -> None:
    made = rig(bench, tool=2, covered=False)
    cycle(bench, made)
    after = cycle(bench, made, made.arm()).state
    assert (after.mode, after.reason, after.tool) == (Mode.HOLD, R.TOOL_UNCERTIFIED, 1)
    made = moving(bench, rig(bench, covered=False))
    made.tool = 2
    after = cycle(bench, made).state
    assert (after.mode, after.reason, after.tool) == (Mode.STOPPING, R.TOOL_UNCERTIFIED, 1)


@pytest.mark.parametrize("goes_on", [False, True])
@pytest.mark.parametrize("index", [1, 2])
def test_from_the_cycle_that_tells_it_the_decision_is_the_new_tools_alone(
    bench: Any, goes_on: bool, index: int
) -> None:
    """Byte for byte what a controller says that never had another tool."""
    made = moving(bench, rig(bench, post(bench, 1.2, 0.5), goes_on=goes_on))
    old = cycle(bench, made)
    alone = System(bench.params(TOOLS[index]))
    made.tool = index + 1
    for k in range(20):
        new = cycle(bench, made)
        joint = replace(new.x.joint, tool_id=0)
        before = replace(new.before, tool=0)
        if not goes_on and k == 0:  # braking: as the single one that has just been stopped for it
            before = replace(before, mode=Mode.STOPPING, reason=R.TOOL_CHANGED)
        state, out = step(alone, before, replace(new.x, joint=joint))
        assert new.state.tool == index
        for ours, theirs in ((new.out.decision.pairs, out.decision.pairs), (new.out.command, out.command)):
            for name in ours.__slots__:
                np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name), name)
        assert (new.state.mode, new.state.reason) == (state.mode, state.reason)
        assert new.state.mode is (Mode.ACTIVE if goes_on else Mode.STOPPING)
        if k == 0:
            nearest = np.array([old.out.decision.pairs.M[0], new.out.decision.pairs.M[0]])
            assert abs(np.diff(nearest)[0]) > 0.2  # m/s2: no swap without another M


def test_a_swap_in_motion_stops_where_the_new_tool_is_too_near(bench: Any) -> None:
    """The bat reaches 0.35 m farther than the drill: what was well outside is at the person's chest."""
    for x, y, goes_on in ((1.0, 0.3, False), (1.4, 0.5, True)):
        made = moving(bench, rig(bench, post(bench, x, y), goes_on=True))
        made.tool = 2
        after = cycle(bench, made).state
        assert after.mode is (Mode.ACTIVE if goes_on else Mode.STOPPING)
        assert after.reason is (R.NONE if goes_on else R.TOOL_CHANGED)


@pytest.mark.compiled
def test_with_swaps_at_any_time_the_robot_causes_no_violation(bench: Any) -> None:
    """A person on the way; a tool appears wherever it is not inside the person's reach already."""
    rng = np.random.default_rng(4)
    went_on = 0
    for trial in range(6):
        made = rig(bench, post(bench, 0.62 + 0.04 * trial, 0.35), goes_on=True)
        goals, inside = [LEFT, RIGHT], []
        for k in range(500):
            rest = made.state.mode in (Mode.HOLD, Mode.STOPPED)
            if k and k % 60 == 0:
                wanted = int(rng.integers(1, 4))
                human = made.people(0.0)
                clear = bench.true_distance(made.system.holding(wanted - 1), made.q_true(), human)
                if clear > 0.3:
                    went_on += made.tool != wanted and made.state.mode is Mode.ACTIVE
                    made.tool = wanted
            goal = goals[made.state.reached_id % 2]
            joint = bench.joint(made.q_true(), seq=made.tick, tool_id=made.tool)
            made.cycle((made.arm(),) if rest else (), Goal(made.state.reached_id + 1, vector(goal)), joint=joint)
            d = bench.true_distance(made.system.holding(made.state.tool), made.q_true(), made.people(0.0))
            inside.append((d, made.tool))
        for (a, tool), (b, same) in zip(inside, inside[1:], strict=False):
            assert not (tool == same and b < 0.1 and (a - b) / T > 0.01)
        assert not made.state.mode.is_over
    assert went_on > 5


def test_a_slower_tool_may_come_while_the_arm_is_fast(bench: Any) -> None:
    made = moving(bench, rig(bench, goes_on=True, speed=0.1))
    made.tool = 2
    while cycle(bench, made).state.mode is Mode.STOPPING:
        assert made.state.reason is R.TOOL_CHANGED
    assert made.state.mode is Mode.STOPPED  # no defect was seen in the stop
    cycle(bench, made, made.arm())
    for _ in range(300):
        cycle(bench, made)
    assert made.state.mode is Mode.ACTIVE
    speeds = [np.abs(c.state.dq_cmd) for c in made.cycles[-290:]]
    assert np.all(np.max(speeds, axis=0) <= 0.1 * np.array(bench.params().robot.dq_max) * (1 + 1e-9))


def test_a_person_names_the_tool_at_rest_only(bench: Any) -> None:
    made = rig(bench, tool=0, told_by_robot=False)
    cycle(bench, made)

    def named(tool: int) -> Any:
        made.event += 1
        return cycle(bench, made, OperatorEvent(made.event, EventKind.TOOL, tool)).state

    assert [(state.tool, state.reason) for state in map(named, (2, 3, 1))] == [(1, R.NONE), (2, R.NONE), (0, R.NONE)]
    unknown = named(9)
    assert (unknown.tool, unknown.reason) == (0, R.TOOL_MISMATCH)
    cycle(bench, made, made.arm())
    assert named(2).tool == 0
    assert made.state.mode is Mode.ACTIVE
    made.tool = 2  # a robot that numbers its tools, in a cell that does not listen
    assert cycle(bench, made).state.reason is R.TOOL_MISMATCH


def test_without_a_robots_word_the_events_of_a_person_count_for_nothing(bench: Any) -> None:
    made = rig(bench)
    cycle(bench, made)
    made.event += 1
    assert cycle(bench, made, OperatorEvent(made.event, EventKind.TOOL, 2)).state.tool == 0


def holding_currents(bench: Any, tool: str, q: Any, per_nm: float, extra: float = 0.0) -> Any:
    """Amperes without sign, by Pinocchio's gravity of the arm with the tool, `extra` kg more of it."""
    params = bench.params(tool)
    heavy = replace(params.tool, mass=params.tool.mass + extra)
    model = load(params.robot, heavy).pin_model
    return np.abs(pin.computeGeneralizedGravity(model, model.createData(), np.array(q))) * per_nm


def test_the_currents_tell_what_weight_is_where(bench: Any) -> None:
    """One kilogram of tool loads the joints at 9.81 m/s2 times its lever: at least one joint, in most poses."""
    rng = np.random.default_rng(0)
    for _ in range(200):
        q = bench.HOME + rng.uniform(-0.6, 0.6, 6)
        for tool in TOOLS[:2]:
            for extra in (-0.7, 0.0, 0.9):
                joint = bench.joint(q, current=vector(holding_currents(bench, tool, q, 0.05, extra)))
                for sign in (1.0, -1.0):  # of an amplifier that tells one
                    misfit = torque_misfit(bench.system(tool), joint, np.full(6, sign * 20.0))
                    assert misfit > 1.0 if extra else misfit < 1e-6


@pytest.mark.parametrize(("held", "armed"), [("drill", True), ("bat", False), ("bare", False)])
def test_a_tool_that_weighs_something_else_is_not_armed(bench: Any, held: str, armed: bool) -> None:
    made = rig(bench, nm_per_ampere=(20.0,) * 6, torque_tolerance=0.8)
    current = vector(holding_currents(bench, held, bench.HOME, 0.05))
    joint = bench.joint(bench.HOME, tool_id=1, current=current)
    cycle(bench, made, joint=joint)
    after = cycle(bench, made, made.arm(), joint=joint).state
    assert (after.mode, after.reason) == ((Mode.ACTIVE, R.NONE) if armed else (Mode.HOLD, R.TOOL_MISMATCH))


def test_no_cycle_of_a_swap_is_another_kind_of_cycle(bench: Any) -> None:
    """Every cycle around it has a set-point and rows; the stop is planned from what was sent."""
    made = moving(bench, rig(bench, post(bench, 0.9, 0.55)))
    made.tool = 2
    cycles = [cycle(bench, made) for _ in range(100)]
    assert all(c.out.command is not None and len(c.out.decision.pairs.M) for c in cycles)
    assert {c.out.decision.status for c in cycles} == {Status.STOPPED}
    assert cycles[-1].state.mode is Mode.STOPPED


def test_a_person_names_only_what_is_mounted_and_not_what_the_robot_tells(bench: Any) -> None:
    for told_by_robot, stand_in, number, may in (
        (False, False, 2, True),
        (False, False, 7, False),
        (False, True, 7, True),
        (True, False, 2, False),
    ):
        params = make(bench, told_by_robot=told_by_robot, stand_in=stand_in).params
        assert knows(params, number) is may


def of_one_pair(n: int, d: float, d_dot: float, own: float, M: float, C: Any = None, drift: float = 0.0) -> Rows:
    """What may_go_on looks at: one pair, as `rows` would hand it over."""
    values = np.array([M, 0.0, 0.0, 0.0, 0.0, d, d_dot, drift, own, 0.0])[:, None]
    return Rows(np.zeros((4, 1), np.int64), values, np.zeros((1, n)) if C is None else C[None], np.zeros((2, n)))


def swap(bench: Any, dq: Any, found: Rows, d: float = 1.0, ddq: Any = None) -> bool:
    system = make(bench, goes_on=True)
    held = system.holding(1)
    zero = vector(np.zeros(6))
    state = replace(initial(system), dq_cmd=vector(dq), ddq_cmd=zero if ddq is None else vector(ddq))
    return may_go_on(system.params, held, state, found, d)


@pytest.mark.parametrize("joint", range(6))
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_swap_goes_on_at_no_more_than_the_new_tools_speed(bench: Any, joint: int, side: float) -> None:
    far = of_one_pair(6, 5.0, 0.0, 0.0, 0.0)
    fastest = side * make(bench, goes_on=True).holding(1).bounds.dq_max * np.eye(6)[joint]
    assert swap(bench, 0.99 * fastest, far) and not swap(bench, 1.01 * fastest, far)
    rearm = bench.params().safety.rearm_distance
    assert swap(bench, 0.5 * fastest, far, rearm) and not swap(bench, 0.5 * fastest, far, rearm - 1e-6)


@pytest.mark.parametrize(("d_dot", "own", "closing"), [(-0.3, 0.0, 0.3), (0.1, -0.2, 0.2), (-0.1, -0.4, 0.4)])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_where_the_control_hardly_reaches_there_is_room_for_the_whole_brake(
    bench: Any, d_dot: float, own: float, closing: float, side: float
) -> None:
    """The slowest joint's S-curve, |dq| / A + A / J, at the closing speed, on top of d_min."""
    held = make(bench, goes_on=True).holding(1)
    dq = side * np.array([0.1, 0.9, 0.2, 0.1, 0.3, 0.1])
    takes = max(abs(v) / A + A / J for v, A, J in zip(dq, held.bounds.ddq_max, held.bounds.dddq_max, strict=True))
    needed = held.params.safety.d_min + closing * takes
    for share in (-1e-4, 1e-4):
        assert swap(bench, dq, of_one_pair(6, needed + share, d_dot, own, 0.0)) is (share > 0.0)


def test_where_it_reaches_the_pair_has_to_be_in_the_set_that_the_rows_keep(bench: Any) -> None:
    held, rng = make(bench, goes_on=True).holding(1), np.random.default_rng(2)
    for _ in range(30):
        C, ddq, drift = rng.normal(0.0, 0.3, 6), rng.normal(0.0, 1.0, 6), rng.normal(0.0, 0.3)
        v, M = rng.uniform(0.05, 0.6), rng.uniform(0.5, 3.0)
        J = JERK_SHARE * float(np.abs(C) @ held.bounds.dddq_max)
        excess = [psi(d, v, -(float(C @ ddq) + drift), M, 0.0, J, held.index) for d in np.linspace(0.05, 3.0, 60)]
        for d, value in zip(np.linspace(0.05, 3.0, 60), excess, strict=True):
            found = of_one_pair(6, float(d), -v, 0.0, M, C, drift)
            assert swap(bench, np.full(6, 0.1), found, ddq=ddq) is bool(value <= 0.0)
        assert min(excess) <= 0.0 < max(excess)
