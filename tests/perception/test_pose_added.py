"""The rule: whatever a pose estimator says, people are told as by the depth layer alone, and what is more is added.

Two sensors live through the same frames, one of them with limbs: all that the other one tells must be in its message.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asc_rt import human_state_pb2 as pb
from asc_rt.config import load_cell
from asc_rt.core.system import System
from asc_rt.core.types import MAX_CAPSULES, HumanState
from asc_rt.human_codec import decode
from asc_rt.perception.pose.added import NEAR, OLDEST_NS, POSE_BODY
from asc_rt.perception.pose.limbs import LIMBS, Found
from asc_rt.perception.pose.link import LARGEST
from asc_rt.perception.sensor import Sensor
from asc_rt.perception.volume import REACH_SPEED
from drivers.cameras.base import DepthFrame, frozen
from drivers.cameras.watch import CameraFault
from tests.perception.test_sensor import FAR_AWAY, PERIOD_NS, START_NS, WALL, Rig

BESIDE = np.array([-1.9, 0.0, 0.0])  # the middle of the board that the cameras see
WARM = 16  # shots until they are believed


class Two:
    """The same cameras, frames and noise; `limbs` are told to the second sensor only."""

    def __init__(self, system: System, capsules: int = MAX_CAPSULES, **changes: Any) -> None:
        self.limbs: list[Found] = []
        self.without, self.rig = Rig(system), Rig(system)
        for rig in (self.without, self.rig):
            old = rig.sensor
            identity = type(old._identity)(3, old._identity.calibration, 0.06, 0.07, -9.0, capsules)
            rig.sensor = Sensor(identity, rig.eyes, old.observer, lambda: "C", old._stamp)
        self.rig.sensor._limbs = lambda: self.limbs

    def shoot(self, empty: bool = False, lost: bool = False) -> tuple[pb.HumanState, pb.HumanState]:
        """One period of both; the message of each. Somebody holds a board, or nobody is there; `lost`: a camera is."""
        told = []
        for rig in (self.without, self.rig):
            make = rig.frame if empty else functools.partial(with_board, rig)
            (message,) = rig.shoot(make, None if lost else make)
            told.append(message)
        return told[0], told[1]

    def warm(self) -> Two:
        self.without.warm(), self.rig.warm()
        for _ in range(3):
            self.shoot()
        return self

    def at(self, ends: Any, age_ns: int = 0, radius: float = 0.06, bound: float = 0.1, camera: int = 0) -> Found:
        """Limbs of the coming capture, `age_ns` before it; `ends` (m, 2, 3) m."""
        ends = np.array(ends, float).reshape(-1, 2, 3)
        m = len(ends)
        t_ns = START_NS + (self.rig.k + 1) * PERIOD_NS - age_ns
        names = tuple(LIMBS[i % len(LIMBS)].name for i in range(m))
        return Found(camera, t_ns, names, ends[:, 0], ends[:, 1], np.full(m, radius), np.full(m, bound))


def with_board(rig: Rig) -> DepthFrame:
    board = WALL.copy()
    board[20:40, 5:75] = 2500
    return rig.frame(depth=frozen(board + rig.rng.integers(-3, 4, board.shape)))


@pytest.fixture(scope="module")
def system() -> System:
    return System(load_cell("fanuc-sim-truth").params)


@pytest.fixture(scope="module")
def two(system: System) -> Two:
    return Two(system).warm()


def is_told_as_without(without: pb.HumanState, told: pb.HumanState) -> list[pb.Capsule]:
    """Everything of the depth layer is there to the byte; gives what is added."""
    depth, rest = told.bodies[:1], told.bodies[1:]
    assert [body.SerializeToString() for body in depth] == [body.SerializeToString() for body in without.bodies]
    bare = pb.HumanState.FromString(told.SerializeToString())
    del bare.bodies[1:]
    bare.method, bare.session_uuid = without.method, without.session_uuid
    assert bare.SerializeToString() == without.SerializeToString()
    assert told.method == (pb.METHOD_FUSED if rest else pb.METHOD_DEPTH)
    assert [body.id for body in rest] == [POSE_BODY] * len(rest)
    return [capsule for body in rest for capsule in body.capsules]


def distance(human: HumanState, point: np.ndarray, horizon: float) -> float:
    """m from `point` to the nearest capsule `horizon` s later, grown by its bounds. By sampling: no code of ours."""
    s = np.linspace(0.0, 1.0, 201)[:, None, None]
    p0, p1 = human.p0 + horizon * human.v0, human.p1 + horizon * human.v1
    off = np.linalg.norm(point - (p0 + s * (p1 - p0)), axis=2).min(0, initial=math.inf)
    return float((off - human.radius - human.position_bound - horizon * human.velocity_bound).min(initial=math.inf))


def surface(two: Two, y: float = 0.0) -> float:
    """x (m) where, from the cameras, the told begins at this y and z = 0."""
    two.limbs = []
    human = decode(two.shoot()[0].SerializeToString(), "C").state
    return next(float(x) for x in np.arange(1.0, -3.0, -0.001) if distance(human, np.array([x, y, 0.0]), 0.0) <= 0.0)


within = st.floats(-3.0, 3.0)
points = st.tuples(within, within, within)
near = st.tuples(*[st.floats(-0.8, 0.8)] * 3).map(lambda p: tuple(BESIDE + p))
limb = st.tuples(near | points, near | points)
limbs = st.lists(
    st.tuples(
        st.lists(limb, max_size=20), st.integers(-OLDEST_NS, 2 * OLDEST_NS), st.floats(0.01, LARGEST),
        st.floats(0.001, LARGEST), st.integers(0, 1),
    ),
    max_size=3,
)  # fmt: skip


@settings(max_examples=60, deadline=None)
@given(limbs, st.lists(st.tuples(points, st.floats(0.0, 0.5)), min_size=1, max_size=8))
def test_no_distance_is_ever_enlarged(two: Two, said: list[Any], asked: list[Any]) -> None:
    two.limbs = [two.at(ends, *rest) for ends, *rest in said]
    without, told = two.shoot()
    extra = is_told_as_without(without, told)
    assert len(extra) <= MAX_CAPSULES - len(without.bodies[0].capsules)
    plain, more = (decode(message.SerializeToString(), "C").state for message in (without, told))
    for point, horizon in asked:
        assert distance(more, np.array(point), horizon) <= distance(plain, np.array(point), horizon)


def test_limbs_beside_somebody_are_added_and_no_others(two: Two) -> None:
    x = surface(two)
    at, off = ([x + d, 0.0, 0.0] for d in (NEAR - 0.02, NEAR + 0.02))
    assert is_told_as_without(*two.shoot()) == []
    for ends, count in [((at, at), 1), ((off, off), 0), ((at, off), 0)]:
        two.limbs = [two.at([ends])]
        assert len(is_told_as_without(*two.shoot())) == count, ends
    two.limbs = [two.at([(at, at)])]
    (capsule,) = is_told_as_without(*two.shoot())
    assert capsule.label == LIMBS[0].name and list(capsule.p0) == at and capsule.radius == 0.06
    assert capsule.position_bound == 0.1 and capsule.velocity_bound == REACH_SPEED
    assert capsule.visibility == pb.PREDICTED


def test_a_limb_that_is_inside_what_is_told_says_nothing_new(two: Two) -> None:
    two.limbs = []
    widest = max(two.shoot()[0].bodies[0].capsules, key=lambda capsule: capsule.radius)
    out = widest.radius + widest.position_bound
    for radius, count in [(out - 0.03, 0), (out + 0.03, 1)]:
        two.limbs = [two.at([(widest.p0, widest.p0)], radius=radius - 0.01, bound=0.01)]
        assert len(is_told_as_without(*two.shoot())) == count


def test_a_limb_has_grown_since_its_capture_and_is_none_when_it_is_old(two: Two) -> None:
    at = [surface(two) + 0.05, 0.0, 0.0]
    for age_ns in (0, 66_000_000, OLDEST_NS):
        two.limbs = [two.at([(at, at)], age_ns)]
        (capsule,) = is_told_as_without(*two.shoot())
        assert capsule.position_bound == pytest.approx(0.1 + REACH_SPEED * age_ns * 1e-9)
    two.limbs = [two.at([(at, at)], OLDEST_NS + 1)]
    assert is_told_as_without(*two.shoot()) == []


@pytest.mark.parametrize("capsules", [MAX_CAPSULES, MAX_CAPSULES // 2, 16, 17])
def test_a_full_message_has_no_room_and_else_the_nearest_to_the_arm_come_first(system: System, capsules: int) -> None:
    two = Two(system, capsules).warm()
    plain, _ = two.shoot()
    count = len(plain.bodies[0].capsules)
    assert count == 16
    points = [[surface(two, y) + 0.03, float(y), 0.0] for y in np.linspace(-0.4, 0.4, 9)]
    ends = [(point, point) for point in points]
    two.limbs = [two.at(ends)]
    extra = is_told_as_without(*two.shoot())
    assert len(extra) == max(capsules - count, 0)
    order = two.rig.sensor.observer.to_arm(np.array(points), FAR_AWAY)
    nearest = [points[i] for i in np.argsort(order)][: len(extra)]
    assert [list(capsule.p0) for capsule in extra] == nearest


def test_where_nobody_is_told_nobody_is_and_it_is_certified(system: System) -> None:
    two = Two(system)
    two.without.warm(), two.rig.warm()
    two.limbs = [two.at([(BESIDE, BESIDE), (BESIDE, BESIDE + 0.1)])]
    without, told = two.shoot(empty=True)
    assert is_told_as_without(without, told) == [] and told.empty_certified


def test_of_a_camera_that_is_not_believed_no_limb_is(system: System) -> None:
    two = Two(system).warm()
    at = [surface(two) + 0.05, 0.0, 0.0]
    two.limbs = [two.at([(at, at)], camera=1)]
    assert len(is_told_as_without(*two.shoot())) == 1
    for rig in (two.without, two.rig):
        rig.eyes[1].fault, rig.eyes[1]._good = CameraFault.MOVED, 0
    two.limbs = [two.at([(at, at)], camera=1)]
    without, told = two.shoot()
    assert is_told_as_without(without, told) == [] and told.health == pb.HEALTH_DEGRADED


def test_limbs_mend_neither_health_nor_coverage(system: System) -> None:
    two = Two(system).warm()
    whole, _ = two.shoot()
    for _ in range(8):
        without, _ = two.shoot(lost=True)
    assert without.health == pb.HEALTH_DEGRADED and without.coverage < whole.coverage
    points = np.linspace([-2.3, 0.0, 0.0], [-1.5, 0.0, 0.0], 9)
    two.limbs = [two.at([(point, point) for point in points], radius=0.3)]
    assert is_told_as_without(*two.shoot(lost=True))
