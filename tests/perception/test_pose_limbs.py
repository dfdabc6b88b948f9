"""From a picture and its depth to limbs: who is shown to the estimator, where its landmarks are, which are dropped."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from asc_rt.perception.grid import NOISE_SIGMAS, Grid, View, depth_sigma
from asc_rt.perception.pose.backend_mediapipe import NAMES, MediaPipe
from asc_rt.perception.pose.limbs import LANDMARK, LIMBS, PEOPLE, Landmark, PoseError, Scene, found, people
from asc_rt.perception.pose.link import scene
from calibration.geometry import look_at
from drivers.cameras import pcd
from drivers.cameras.base import Depth, Intrinsics, frozen, frozen_image
from tests.perception import test_five_people as five

LENS = Intrinsics(80, 60, 60.0, 60.0, 39.5, 29.5)
WALL = np.full((60, 80), 4000, np.uint16)
IMAGE = frozen_image(np.stack([*np.indices(WALL.shape), np.zeros(WALL.shape)], -1))  # red: the row, green: the column
POSE = look_at((0.5, 0.3, 1.0), (3.0, 0.0, 0.8))
ENDS = {name for limb in LIMBS for name in (*limb.a, *limb.b)}


def a_scene(background: np.ndarray = WALL) -> Scene:
    grid = Grid.over(np.array([1.0, -0.6, -0.4]), np.array([3.0, 0.6, 0.4]), 0.2)
    return scene(View(LENS, 0.001, POSE, frozen(background), grid), 0.02)


def with_boards(*boards: tuple[slice, slice, int]) -> Depth:
    depth = WALL.copy()
    for rows, columns, mm in boards:
        depth[rows, columns] = mm
    return frozen(depth)


class Scripted:
    """Says the same landmarks, in px of the whole picture, of everybody, and keeps what it was shown."""

    version = "scripted"

    def __init__(self, landmarks: Sequence[tuple[str, float, float]] = ()) -> None:
        self.landmarks = landmarks
        self.shown: list[np.ndarray] = []

    def estimate(self, image: np.ndarray) -> list[Landmark]:
        self.shown.append(image)
        row, column, _ = image[0, 0].tolist()
        return [Landmark(name, u - column, v - row) for name, u, v in self.landmarks]


BOARD = (slice(10, 55), slice(30, 51), 2000)
FOREARM = [("left elbow", 35.0, 30.0), ("left wrist", 40.0, 34.0)]


def told(landmarks: Sequence[tuple[str, float, float]], depth: Depth | None = None) -> dict[str, tuple]:
    depth = with_boards(BOARD) if depth is None else depth
    return {name: rest for name, *rest in found(depth, IMAGE, a_scene(), Scripted(landmarks))}  # type: ignore[misc]


def test_each_person_is_shown_alone_the_largest_first_and_small_things_are_not() -> None:
    left, right = (slice(5, 55), slice(10, 40), 2200), (slice(10, 50), slice(40, 60), 1900)
    estimator = Scripted()
    found(with_boards(left, right, (slice(20, 24), slice(70, 74), 2000)), IMAGE, a_scene(), estimator)
    spans = [(image[0, 0, 1], image[0, -1, 1]) for image in estimator.shown]
    assert len(spans) == 2, "one stands before the other: two people"
    for (low, high), (_, columns, _) in zip(spans, (left, right), strict=True):
        assert low <= columns.start and high >= columns.stop - 1 and high - low < columns.stop - columns.start + 6


def test_of_a_crowd_the_largest_are_shown() -> None:
    crowd = [(slice(5, 55), slice(2 + 11 * i, 11 + 11 * i), 2000 + 10 * i) for i in range(PEOPLE + 2)]
    estimator = Scripted()
    found(with_boards(*crowd), IMAGE, a_scene(), estimator)
    assert len(estimator.shown) == PEOPLE


def test_a_limb_lies_its_radius_behind_the_surface_between_its_landmarks() -> None:
    """The oracle: a pinhole by hand."""
    (limb,) = [limb for limb in LIMBS if limb.name == "left forearm"]
    p0, p1, radius, bound = told(FOREARM)["left forearm"]
    for point, (_, u, v) in zip((p0, p1), FOREARM, strict=True):
        ray = np.array([(u - 39.5) / 60.0, (v - 29.5) / 60.0, 1.0])
        camera = 2.0 * ray + limb.radius * ray / math.sqrt(float(ray @ ray))
        assert point == pytest.approx(POSE[:3, :3] @ camera + POSE[:3, 3])
    assert radius == limb.radius
    assert bound == pytest.approx(0.02 + LANDMARK + NOISE_SIGMAS * float(depth_sigma(np.array(2.0))))


def test_a_limb_of_several_landmarks_needs_all_of_them() -> None:
    corners = [("left shoulder", 34.0, 20.0), ("right shoulder", 46.0, 20.0), ("left hip", 35.0, 38.0)]
    assert told(corners).keys() == set()
    p0, p1, *_ = told([*corners, ("right hip", 45.0, 38.0)])["torso"]
    assert np.linalg.norm(np.subtract(p1, p0)) == pytest.approx(18.0 / 60.0 * 2.0, rel=0.1)


@pytest.mark.parametrize(
    "wrist",
    [
        (math.nan, 30.0), (40.0, math.inf), (-math.inf, 30.0), (-1.0, 30.0), (40.0, 60.0), (1e300, 1e300),
        (65.0, 30.0),  # the wall
    ],
)  # fmt: skip
def test_a_landmark_that_is_nowhere_or_on_the_background_is_none(wrist: tuple[float, float]) -> None:
    assert told([FOREARM[0], ("left wrist", *wrist)]) == {}
    assert told(FOREARM).keys() == {"left forearm"}


def test_a_landmark_on_somebody_else_or_on_too_little_is_none() -> None:
    behind = (slice(10, 55), slice(51, 70), 3300)
    estimator = Scripted([("left elbow", 55.0, 30.0), ("left wrist", 58.0, 30.0)])
    rows = found(with_boards(BOARD, behind), IMAGE, a_scene(), estimator)
    assert len(estimator.shown) == 2 and [name for name, *_ in rows] == ["left forearm"], "of the one behind alone"
    corner = [("left elbow", 46.0, 50.0), ("left wrist", 52.4, 55.4)]
    assert told(corner) == {}, "two pixels of the corner"
    assert told([corner[0], ("left wrist", 51.4, 54.4)]).keys() == {"left forearm"}


def test_a_limb_longer_than_anybodys_is_none() -> None:
    wide = with_boards((slice(10, 55), slice(5, 75), 2000))
    near, far = ([("left elbow", 10.0, 30.0), ("left wrist", 10.0 + px, 30.0)] for px in (20.0, 40.0))
    assert told(near, wide).keys() == {"left forearm"} and told(far, wide) == {}


def test_landmarks_by_the_thousand_or_of_other_names_are_no_more_limbs() -> None:
    many = [("left wrist", 40.0, 34.0)] * 5000 + [(f"eye {i}", 40.0, 34.0) for i in range(5000)]
    assert told([*FOREARM, *many]).keys() == {"left forearm"}


def test_before_an_unknown_background_nobody_is_found() -> None:
    estimator = Scripted(FOREARM)
    assert found(with_boards(BOARD), IMAGE, a_scene(np.zeros_like(WALL)), estimator) == []
    assert not estimator.shown


# --- five people before a real Kinect --------------------------------------------------------------------------------

needs_frame = pytest.mark.skipif(not five.FRAME.is_file(), reason=f"{five.FRAME.name} is not beside the checkout")


def five_scene() -> Scene:
    T = np.eye(4)
    T[:3, :3] = five.LEVEL
    grid = Grid.over(np.array([1.3, -1.4, -0.7]), np.array([3.2, 1.4, 0.95]), 0.2)
    return scene(View(five.LENS, 0.001, T, five.empty_room(), grid), 0.02)


@needs_frame
def test_each_of_the_five_is_shown_alone() -> None:
    depth, scene = pcd.depth_image(five.FRAME), five_scene()
    z = np.where((depth > 0) & (depth < scene.far), depth * 0.001, 0.0)
    spans = sorted((p.columns.start, p.columns.stop) for p in people(z, scene.lens))
    assert len(spans) == len(five.COLUMNS)
    for (low, high), (left, right) in zip(spans, five.COLUMNS, strict=True):
        assert abs(low + high - left - right) < 40 and high - low < right - left + 80


# --- the backend without a model -------------------------------------------------------------------------------------


def test_the_backend_names_all_landmarks_that_limbs_are_made_of() -> None:
    assert {f"{side} {name}" for name in NAMES.values() for side in ("left", "right")} == ENDS


def test_without_the_library_it_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mediapipe", None)
    with pytest.raises(PoseError, match="uv sync --extra pose") as error:
        MediaPipe(Path("x.task"))
    assert len(error.value.lines) == 1
