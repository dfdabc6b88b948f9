"""From images to capsules: what is seen is covered, the unseen is occupied, the robot and an empty cell are nobody."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asc_rt.perception import kernels
from asc_rt.perception.arm import EXTRAPOLATION_NS, Arm, JointHistory
from asc_rt.perception.grid import Grid, View, depth_sigma, without_specks
from asc_rt.perception.parts import PARTS, Tracker, capsule
from asc_rt.perception.volume import LEAST_INTRUSION, PERSON_VOLUME, REACH_SPEED, Volume
from calibration.geometry import look_at
from drivers.cameras.base import Intrinsics
from sim_hil import seeing, seeing_rods

NOWHERE = np.zeros((1, 3)), np.zeros((1, 3)), np.array([-9.0])  # an arm that is not there
STEP_NS = 66_000_000
LENS = Intrinsics(80, 60, 60.0, 60.0, 39.5, 29.5)
WALL = np.full((60, 80), 4000, np.uint16)


def one_camera(half_width: float = 0.6) -> Volume:
    """It looks along +x at a wall 4 m away."""
    grid = Grid.over(np.array([1.0, -half_width, -0.4]), np.array([3.0, half_width, 0.4]), 0.05)
    return Volume(grid, [View(LENS, 0.001, look_at((0, 0, 0), (1, 0, 0)), WALL, grid)])


def with_board(distance_mm: int) -> np.ndarray:
    """Something 0.5 m wide and high in the middle of the picture."""
    depth = WALL.copy()
    half = round(60.0 * 250 / distance_mm)
    depth[30 - half : 30 + half, 40 - half : 40 + half] = distance_mm
    return depth


# --- the volume ------------------------------------------------------------------------------------------------------


def test_nobody_is_in_an_empty_volume_and_what_is_behind_a_surface_is_occupied() -> None:
    volume = one_camera()
    assert volume.coverage([True]) > 0.9 and volume.coverage([False]) == 0.0
    assert not len(volume.update(0, [WALL], NOWHERE))
    for k in range(1, 9):
        told = volume.update(k * STEP_NS, [with_board(2000)], NOWHERE)
    assert abs(told[:, 0].min() - 2.0) < 0.08, "nothing is claimed before the surface"
    behind = told[(np.abs(told[:, 1]) < 0.2) & (np.abs(told[:, 2]) < 0.2)]
    assert behind[:, 0].max() > 2.8, "the shadow is occupied"


def test_what_was_hidden_stays_until_it_is_seen_free() -> None:
    volume = one_camera(half_width=1.2)
    volume.update(0, [WALL], NOWHERE)
    for k in range(1, 5):
        told = volume.update(k * STEP_NS, [with_board(2000)], NOWHERE)
    blind = [volume.update(k * STEP_NS, [None], NOWHERE) for k in range(5, 8)]
    grown = front(told) - front(blind[-1])
    assert grown >= 3 * REACH_SPEED * STEP_NS * 1e-9 - 0.05, "blind, they may have come nearer at 2 m/s"
    assert len(blind[1]) > len(blind[0]) > len(told)
    assert not len(volume.update(8 * STEP_NS, [WALL], NOWHERE))


def front(told: np.ndarray) -> float:
    """m, where the occupied begins in the middle of the picture, but for who came in at the near end."""
    return float(told[(np.abs(told[:, 1:]) < 0.2).all(1) & (told[:, 0] > 1.5), 0].min())


@pytest.mark.parametrize(("side", "fits"), [(6, False), (8, True)])
def test_a_dark_pocket_is_somebody_if_a_person_fits_in(side: int, fits: bool) -> None:
    volume = one_camera()
    dark = np.zeros(volume.grid.shape, bool)
    dark[12 : 12 + side, 8 : 8 + side, 4 : 4 + side] = True
    volume.views[0].pixel[dark.ravel()] = -1
    assert (side**3 * volume.grid.size**3 >= PERSON_VOLUME) == fits
    for k in range(3):
        assert len(volume.update(k * STEP_NS, [WALL], NOWHERE)) == (dark.sum() if fits else 0)


def test_nobody_comes_out_of_a_pocket_that_nobody_fits_in() -> None:
    """It grows dark around one that was found empty: the shadow of the robot has moved."""
    volume, middle = one_camera(), np.array([16, 12, 8])
    open_pixel = volume.views[0].pixel.copy()
    for k, half in enumerate([3, 3, 4, 5]):
        dark = np.zeros(volume.grid.shape, bool)
        dark[tuple(slice(m - half, m + half) for m in middle)] = True
        volume.views[0].pixel[:] = np.where(dark.ravel(), -1, open_pixel)
        assert not len(volume.update(k * STEP_NS, [WALL], NOWHERE))


def test_a_blind_camera_frees_nothing() -> None:
    volume = one_camera()
    assert len(volume.update(0, [None], NOWHERE)) == np.count_nonzero(volume.guarded)
    assert len(volume.update(STEP_NS, [np.zeros_like(WALL)], NOWHERE)) == np.count_nonzero(volume.guarded)


def test_what_is_never_seen_says_nothing_new_and_who_comes_out_of_it_is_told() -> None:
    """Left and right of the picture lies a dark wedge that people walk into unseen; beside it is watched."""
    volume = one_camera(half_width=1.2)
    dark = ~volume.guarded.reshape(volume.grid.shape)
    beside = np.zeros_like(dark)
    beside[:, 1:-1] = ~dark[:, 1:-1] & (dark[:, :-2] | dark[:, 2:])
    at = np.flatnonzero(beside)
    assert len(at) > LEAST_INTRUSION / volume.grid.size**3
    assert not len(volume.update(0, [WALL], NOWHERE))
    volume.views[0].pixel[at[:1]] = -1  # one is not seen free: noise, nobody's arm
    assert not len(volume.update(STEP_NS, [WALL], NOWHERE))
    pixel = volume.views[0].pixel.copy()
    volume.views[0].pixel[at] = -1
    assert not len(volume.update(2 * STEP_NS, [WALL], NOWHERE)), "once is noise, too"
    assert len(volume.update(3 * STEP_NS, [WALL], NOWHERE)) == len(at)
    volume.views[0].pixel[:] = pixel
    assert not len(volume.update(4 * STEP_NS, [WALL], NOWHERE))
    volume.views[0].pixel[at] = -1
    assert not len(volume.update(5 * STEP_NS, [WALL], NOWHERE)), "from the beginning"


def test_the_nearest_side_is_told_from_the_whole_arm() -> None:
    grid = Grid.over(np.array([-1.0, -2.0, 0.0]), np.array([3.0, 2.0, 1.0]), 0.1)
    p0, p1, radius = np.array([[0.0, 0, 0], [0, 0, 0]]), np.array([[0.0, 0, 9], [0, 1.5, 0]]), np.array([0.1, 0.2])
    assert grid.around(p0, p1, radius) == pytest.approx(0.3)
    assert grid.around(p0[:1], p1[:1], radius[:1]) == pytest.approx(0.9), "nobody comes in from above"
    assert grid.around(p0 + [0, 1, 0], p1 + [0, 1, 0], radius) == pytest.approx(-0.7)


def test_a_voxel_is_free_if_all_of_it_lies_before_what_is_seen_noise_and_all() -> None:
    volume = one_camera()
    view, centres = volume.views[0], volume.grid.centres()
    middle = (np.abs(centres[:, 1:]) < 0.15).all(1)
    z = centres[view.free(with_board(1960)) & middle, 0]
    assert len(z) and (z + volume.grid.size / 2 + 3.0 * depth_sigma(z) < 1.96).all()


def test_a_voxel_is_free_if_nothing_narrow_stands_beside_its_middle() -> None:
    """A bar of one column of pixels: no voxel whose picture touches that column is free."""
    volume = one_camera()
    view, (x, y, _) = volume.views[0], volume.grid.centres().T
    column = LENS.cx - LENS.fx * y / x  # the camera looks along +x, right is -y
    half = LENS.fx * volume.grid.size / 2 / x
    for bar in range(30, 50):
        depth = WALL.copy()
        depth[:, bar] = 900
        free = view.free(depth)
        assert free.any() and not np.any(free & (np.abs(column - bar) < half + 0.5))


def test_a_lone_missing_pixel_is_filled_with_the_nearest_and_two_are_not() -> None:
    depth = WALL.copy()
    depth[10, 10], depth[9, 9] = 0, 1500
    depth[30, 30] = depth[30, 31] = 0
    filled = without_specks(depth)
    assert filled[10, 10] == 1500
    assert filled[30, 30] == filled[30, 31] == 0


def test_components_join_over_corners() -> None:
    block = np.zeros((4, 4, 4), np.uint8)
    block[0, 0, 0] = block[1, 1, 1] = block[3, 3, 3] = 1
    found, label = kernels.components(block.ravel(), block.shape)
    assert label[0] == label[1] != label[2]
    assert len(found) == 3


# --- capsules and tracks ---------------------------------------------------------------------------------------------

points = st.lists(st.tuples(*[st.floats(-2, 2)] * 3), min_size=1, max_size=60).map(lambda rows: np.array(rows, float))


def outside(p: np.ndarray, p0: np.ndarray, p1: np.ndarray, radius: np.ndarray) -> float:
    return float(kernels.distances(p, np.atleast_2d(p0), np.atleast_2d(p1), np.atleast_1d(radius)).max())


@settings(max_examples=60, deadline=None)
@given(points)
def test_a_capsule_covers_all_its_points(cloud: np.ndarray) -> None:
    p0, p1, radius = capsule(cloud)
    assert outside(cloud, p0, p1, np.array(radius)) <= 1e-6


@settings(max_examples=30, deadline=None)
@given(st.lists(points, min_size=1, max_size=4))
def test_the_parts_cover_every_point_whatever_came_before(clouds: list[np.ndarray]) -> None:
    tracker = Tracker()
    for k, cloud in enumerate(clouds):
        parts = tracker.update(k * STEP_NS, cloud, np.ones(len(cloud)))
        assert 0 < len(parts.radius) <= PARTS
        for point in cloud:
            assert kernels.to_capsules(*point, parts.p0, parts.p1, parts.radius) <= 1e-6


def test_a_steady_motion_is_known_within_its_bound_and_a_jump_begins_anew() -> None:
    tracker, rng = Tracker(1), np.random.default_rng(1)
    cloud = rng.uniform(-0.1, 0.1, (200, 3))
    velocity = np.array([1.2, -0.5, 0.0])
    for k in range(20):
        parts = tracker.update(k * STEP_NS, cloud + k * STEP_NS * 1e-9 * velocity, np.ones(200))
    assert np.linalg.norm(parts.velocity[0] - velocity) < 0.1
    assert parts.velocity_bound[0] < REACH_SPEED + np.linalg.norm(velocity)
    jumped = tracker.update(20 * STEP_NS, cloud + 5.0, np.ones(200))
    assert np.linalg.norm(jumped.velocity[0]) == 0.0
    assert jumped.velocity_bound[0] == pytest.approx(REACH_SPEED)
    assert not len(tracker.update(21 * STEP_NS, np.zeros((0, 3)), np.zeros(0)).radius)


def test_nobody_is_told_to_be_faster_than_anybody_is() -> None:
    tracker, rng = Tracker(1), np.random.default_rng(1)
    cloud = rng.uniform(-0.1, 0.1, (200, 3))
    for k in range(12):
        parts = tracker.update(k * STEP_NS, cloud + [2.6 * k * STEP_NS * 1e-9, 0, 0], np.ones(200))
        assert np.linalg.norm(parts.velocity[0]) <= REACH_SPEED + 1e-9
    assert np.linalg.norm(parts.velocity[0]) > 1.9


def test_who_is_near_the_robot_is_told_more_finely() -> None:
    cloud = np.random.default_rng(1).uniform(-0.5, 0.5, (400, 3))
    both, apart = np.concatenate([cloud, cloud + [4.0, 0, 0]]), np.repeat([0.1, 2.0], 400)
    parts = Tracker(10).update(0, both, apart)
    near = np.count_nonzero(np.maximum(parts.p0[:, 0], parts.p1[:, 0]) < 2.0)
    assert near >= 7 and len(parts.radius) == 10


# --- joints at the moment of capture ---------------------------------------------------------------------------------


def test_joints_are_those_of_the_capture_or_none() -> None:
    history = JointHistory()
    assert history.at(0) is None
    for k in range(5):
        history.add(k * 8_000_000, np.array([0.1 * k, -0.2 * k]))
    history.add(1, np.array([9.0, 9.0]))  # late: of no use
    assert history.at(12_000_000) == pytest.approx([0.15, -0.3])
    assert history.at(40_000_000) == pytest.approx([0.5, -1.0]), "carried on"
    assert history.at(32_000_000 + EXTRAPOLATION_NS + 1) is None
    assert history.at(-1) is None


# --- the whole, judged by the truth ----------------------------------------------------------------------------------


def test_no_distance_is_overestimated_and_an_empty_cell_is_empty() -> None:
    """The short version of `python -m sim_hil seeing -n 200`."""
    looks = [look for seed in (7, 11) for look in seeing.episode(seed, 2.5)]
    result = seeing.table(looks, [])
    assert result["judged"] > 20
    assert result["over_bound"] == 0 and result["over_later"] == 0
    assert result["median_under_m"] < 0.2


def test_who_comes_in_is_told_before_they_are_near() -> None:
    """A seed whose person is still outside when the episode begins, 1.01 m from the arm, and 0.9 m 0.1 s later."""
    s = seeing.studio()
    for seed in (100_065, 100_073):
        assert not any(map(seeing.is_over, seeing.episode(seed, 0.2)))
    least = seeing.NEAR + REACH_SPEED * seeing.HORIZON
    arm, radius = Arm(s.system.model), s.system.model.capsules.radius
    poses = [seeing.arm_at(seed, 2.0 * leg) for seed in range(40) for leg in range(4)]
    assert min(s.grid.around(*arm.capsules(q), radius) for q in poses) > least


def test_the_robot_at_work_is_nobody() -> None:
    looks = seeing.episode(5, 2.0, people=False)
    assert sum(look.told < seeing.NEAR for look in looks) == 0


@pytest.mark.parametrize(
    ("look", "over"),
    [
        ((0.5, 0.53, 0.5, 0.4), False), ((0.5, 0.55, 0.5, 0.4), True), ((0.5, 0.4, 0.5, 0.51), True),
        ((1.1, math.inf, 0.9, math.inf), True), ((1.1, math.inf, 1.0, math.inf), False), ((0.1, 9.0, 0.1, 9.0), False),
    ],
)  # fmt: skip
def test_over_is_who_is_near_and_told_farther_now_or_soon(look: tuple[float, ...], over: bool) -> None:
    assert seeing.is_over(seeing.Look(*look, 0.04, 0.0)) == over


def test_a_start_that_is_refused_is_no_stop_and_what_comes_later_is_one() -> None:
    def told(*distances: float) -> list[seeing.Look]:
        return [seeing.Look(math.inf, d, math.inf, d, 0.04, 0.0) for d in distances]

    looks = [seeing.Look(0.5, 0.4, 0.5, 0.3, 0.04, 0.0)]
    result = seeing.table(looks, [told(0.2, 0.3, 9.0, 9.0), told(9.0, 0.9, 0.9, 9.0, 0.1), told(9.0, 1.1)])
    assert (result["starts_refused"], result["false_stops"]) == (1, 2)


@pytest.mark.parametrize("width", [0.03, 0.07])
@pytest.mark.parametrize("far", [1.0, 3.5])
def test_a_rod_is_seen_at_once(width: float, far: float) -> None:
    """The short version of `python -m sim_hil seeing --rods`."""
    assert seeing_rods.seen("160x120", width, far, 2) == 1.0


def test_a_wire_is_not_seen() -> None:
    """So the table can fail."""
    assert seeing_rods.seen("160x120", 0.002, 3.5, 4) < 0.5


# --- does the camera stand where it stood ----------------------------------------------------------------------------


def test_a_camera_that_has_moved_a_little_is_found_and_one_that_has_not_is_left_alone() -> None:
    """The corner of a room, and somebody in it; true displacements of the farthest corner of the volume."""
    from asc_rt.perception.stance import LIMIT, Stance

    s = seeing.studio()
    eye, view, person = s.eyes[0], s.views[0], seeing.Roamer(3)
    for moved, low, high in [(0.0, 0.0, LIMIT / 2), (0.03, 0.02, 0.04), (0.08, 0.06, 0.1)]:
        stance, T = Stance(view, s.grid.corners()), np.eye(4)
        T[0, 3] = moved
        eye.move(T)
        for k in range(20):
            s.scene.set_person(person.at(2.0 + 0.1 * k))
            shift = stance.shift(eye.sense())
        assert shift is not None and low <= shift <= high
    eye.move(np.eye(4))
    assert Stance(view, s.grid.corners()).shift(np.zeros_like(view.background)) is None
