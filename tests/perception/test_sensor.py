"""From frames to messages: what is told when cameras and joints are in order, and when they are not."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asc_rt import human_state_pb2 as pb
from asc_rt.cell_cameras import CameraOptions
from asc_rt.config import load_cell
from asc_rt.core.system import System
from asc_rt.human_codec import decode
from asc_rt.perception import background
from asc_rt.perception.arm import Arm
from asc_rt.perception.background import Background, BackgroundError, belongs_to
from asc_rt.perception.cameras import grid_of, mismatches, with_lens
from asc_rt.perception.eye import GOOD_AGAIN, Eye
from asc_rt.perception.grid import Grid, View, rays_of
from asc_rt.perception.observer import Observer
from asc_rt.perception.process import hear
from asc_rt.perception.sensor import ENTRY_S, NO_JOINTS, UNWATCHED, Identity, Sensor, around
from calibration.geometry import look_at
from calibration.result import Result, pose_value, rows
from drivers.cameras.base import CameraInfo, DepthFrame, Intrinsics, frozen
from drivers.cameras.watch import CameraFault
from tests.box import Box

PERIOD_NS, LATENCY_NS, START_NS = 66_000_000, 20_000_000, 10**12
LENS = Intrinsics(80, 60, 60.0, 60.0, 39.5, 29.5)
OTHER_LENS = Intrinsics(80, 60, 61.0, 60.0, 39.5, 29.5)
WALL = np.full((60, 80), 4000, np.uint16)
INFO = CameraInfo("test", "S1", "1", LENS, 0.001, PERIOD_NS, LATENCY_NS)
CALIBRATION = b"\7" * 32
FAR_AWAY = np.radians([0.0, 0.0, 0.0, 0.0, -90.0, 0.0])


@pytest.fixture(scope="module")
def system() -> System:
    return System(load_cell("fanuc-sim-truth").params)


class Rig:
    """Two cameras 3 m from a volume behind the arm that look at a wall; `shoot` is one period of both."""

    def __init__(self, system: System, around: float = -9.0) -> None:
        """`around`: the arm stands outside this volume, and may."""
        grid = Grid.over(np.array([-2.6, -0.6, -0.4]), np.array([-1.4, 0.6, 0.4]), 0.05)
        poses = [look_at((0.5, y, 0), (-1, y, 0)) for y in (-0.8, 0.8)]
        views = [View(LENS, 0.001, pose, WALL, grid) for pose in poses]
        self.eyes = [Eye(name, INFO, view) for name, view in zip("ab", views, strict=True)]
        observer = Observer(system.model, grid, views, [0.004, 0.009])
        self.offset: tuple[int, int] | None = (0, 0)
        self.sensor = Sensor(
            Identity(3, CALIBRATION, 0.06, 0.07, around), self.eyes, observer, lambda: "C",
            lambda t_ns: self.offset and (t_ns + self.offset[0], self.offset[1]),
        )  # fmt: skip
        self.rng, self.k, self.joints = np.random.default_rng(1), 0, True

    def frame(self, **changes: Any) -> DepthFrame:
        t_ns = START_NS + self.k * PERIOD_NS
        depth = frozen(WALL + self.rng.integers(-3, 4, WALL.shape))
        return dataclasses.replace(DepthFrame(depth, t_ns, 0, t_ns, t_ns + LATENCY_NS, self.k), **changes)

    def frame_from(self, earlier_ns: int) -> DepthFrame:
        """Captured so much before this period's."""
        t_ns = START_NS + self.k * PERIOD_NS - earlier_ns
        return self.frame(t_capture_ns=t_ns, t_device_ns=t_ns)

    def shoot(self, *frames: Callable[[], DepthFrame] | None) -> list[pb.HumanState]:
        """`frames`: makers, one for each camera; None: it says nothing."""
        self.k += 1
        now_ns = START_NS + self.k * PERIOD_NS + LATENCY_NS
        if self.joints:
            offset = self.offset[0] if self.offset else 0
            for t_ns in (now_ns - 60_000_000, now_ns - 30_000_000):
                self.sensor.joints.add(t_ns + offset, FAR_AWAY)
        got = {i: make() for i, make in enumerate(frames or (self.frame, self.frame)) if make}
        messages = self.sensor.take(got, now_ns) if got else self.sensor.wait(now_ns)
        assert all(decode(data, "C") for data in messages)
        return [pb.HumanState.FromString(data) for data in messages]

    def warm(self) -> pb.HumanState:
        for _ in range(GOOD_AGAIN + 1):
            messages = self.shoot()
        (message,) = messages
        return message


@pytest.fixture
def rig(system: System) -> Rig:
    return Rig(system)


def test_cameras_are_believed_after_some_good_frames_and_then_nobody_is_nobody(rig: Rig) -> None:
    early = [message for _ in range(GOOD_AGAIN - 1) for message in rig.shoot()]
    assert early and all(m.health == pb.HEALTH_FAULT and not m.empty_certified and m.bodies[0].capsules for m in early)
    rig.shoot()
    (message,) = rig.shoot()
    assert (message.health, message.health_bits, message.empty_certified) == (pb.HEALTH_OK, 0, True)
    assert not message.bodies[0].capsules and message.coverage > 0.8
    assert message.t_capture_ns == START_NS + rig.k * PERIOD_NS
    assert (message.sensor_id, message.calibration_hash, message.safety_rated) == (3, CALIBRATION, False)


def test_somebody_is_told_with_the_bound_of_the_worse_calibration(rig: Rig) -> None:
    rig.warm()
    board = WALL.copy()
    board[20:40, 5:75] = 2500
    for _ in range(3):
        (message,) = rig.shoot(*[lambda: rig.frame(depth=frozen(board + rig.rng.integers(-3, 4, board.shape)))] * 2)
    capsules = message.bodies[0].capsules
    assert capsules and all(c.visibility == pb.OBSERVED for c in capsules)
    assert capsules[0].position_bound == pytest.approx(0.05 * np.sqrt(0.75) + 0.009)


def test_one_camera_lost_is_told_and_what_it_saw_alone_grows(rig: Rig) -> None:
    whole = rig.warm().coverage
    for _ in range(6):
        messages = rig.shoot(rig.frame, None)
    assert messages[0].health == pb.HEALTH_DEGRADED and messages[0].health_bits == CameraFault.SILENT
    assert not messages[0].empty_certified and messages[0].coverage < whole


def test_without_cameras_it_tells_where_people_may_be_by_now(rig: Rig) -> None:
    rig.warm()
    told = [message for _ in range(8) for message in rig.shoot(None, None)]
    assert told[-1].health == pb.HEALTH_FAULT and told[-1].coverage == 0.0
    capsules = told[-1].bodies[0].capsules
    assert capsules and all(c.visibility == pb.PREDICTED for c in capsules)
    assert [m.seq for m in told] == list(range(told[0].seq, told[-1].seq + 1))
    assert told[-1].t_capture_ns > told[0].t_capture_ns


def test_without_joints_nothing_is_told_from_the_robot(rig: Rig) -> None:
    rig.warm()
    rig.joints = False
    for _ in range(3):
        (message,) = rig.shoot()
    assert message.health == pb.HEALTH_FAULT and message.health_bits == NO_JOINTS
    assert not message.empty_certified and not [c for body in message.bodies for c in body.capsules]


def test_where_people_may_come_upon_the_arm_unseen_nobody_is_not_told(system: System) -> None:
    message = Rig(system, around(1.0)).warm()
    assert message.health == pb.HEALTH_DEGRADED and message.health_bits == UNWATCHED
    assert not message.empty_certified
    assert around(1.0) == pytest.approx(1.0 + 2.0 * ENTRY_S)


@pytest.mark.parametrize("name", ["fanuc-sim"])
def test_around_the_arm_at_its_goals_all_is_watched(name: str) -> None:
    cell = load_cell(name)
    assert cell.perception is not None
    model, grid = System(cell.params).model, grid_of(cell.perception)
    arm, least = Arm(model), around(cell.params.safety.activation_distance)
    for a, b in zip(cell.goals, cell.goals[1:] + cell.goals[:1], strict=True):
        for share in np.linspace(0.0, 1.0, 20):
            q = np.array(a) + share * (np.array(b) - np.array(a))
            assert grid.around(*arm.capsules(q), model.capsules.radius) > least + 0.05, "and room to give way"


@pytest.mark.parametrize(
    ("wrong", "fault"),
    [
        (lambda rig: {"depth": frozen(np.zeros_like(WALL))}, CameraFault.COVERED),
        (lambda rig: {"depth": frozen(WALL + 400)}, CameraFault.MOVED),
        (lambda rig: {"t_capture_ns": START_NS + rig.k * PERIOD_NS + LATENCY_NS}, CameraFault.CLOCK),
        (lambda rig: {"seq": 1}, CameraFault.CLOCK),
    ],
)
def test_a_wrong_picture_is_not_used_and_its_camera_not_believed_for_a_while(
    rig: Rig, wrong: Callable[[Rig], dict[str, Any]], fault: CameraFault
) -> None:
    rig.warm()
    (message,) = rig.shoot(rig.frame, lambda: rig.frame(**wrong(rig)))
    assert message.health == pb.HEALTH_DEGRADED and message.health_bits & fault
    healths = [rig.shoot()[0].health for _ in range(GOOD_AGAIN + 1)]
    assert healths[-1] == pb.HEALTH_OK and healths[GOOD_AGAIN - 3] == pb.HEALTH_DEGRADED


def test_cameras_that_look_at_different_moments_are_told_one_after_the_other(rig: Rig) -> None:
    rig.warm()
    late = 5_000_000
    messages = rig.shoot(lambda: rig.frame_from(late), rig.frame)
    assert [m.t_capture_ns for m in messages] == [START_NS + rig.k * PERIOD_NS - late, START_NS + rig.k * PERIOD_NS]
    assert messages[1].health == pb.HEALTH_OK


def test_a_camera_whose_frames_always_come_too_late_is_silent(rig: Rig) -> None:
    rig.warm()
    for _ in range(2 * GOOD_AGAIN):
        messages = rig.shoot(lambda: rig.frame_from(100_000_000), rig.frame)
    assert messages[-1].health == pb.HEALTH_DEGRADED


def test_stamps_are_the_cells_with_how_far_they_may_be_off(rig: Rig) -> None:
    rig.offset = None
    assert not rig.shoot(), "the cell has not told its time yet"
    rig.offset = (5_000_000_000, 700_000)
    message = rig.warm()
    assert message.t_capture_ns == START_NS + rig.k * PERIOD_NS + 5_000_000_000
    assert message.t_capture_sigma_ns == 700_000 and message.clock_id == "C"
    assert message.t_publish_ns - message.t_capture_ns == LATENCY_NS
    assert message.health == pb.HEALTH_OK, "joints are the cell's, too"


def test_the_arm_is_where_it_was_by_its_own_clock_and_an_uncertain_stamp_is_told(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig.warm()
    asked: list[int] = []
    monkeypatch.setattr(rig.sensor.joints, "at", lambda t_ns: asked.append(t_ns) or FAR_AWAY)
    rig.eyes[0].offset_ns = 7_000_000
    (message,) = rig.shoot(lambda: rig.frame(t_capture_sigma_ns=400_000), rig.frame)
    assert asked == [message.t_capture_ns + 7_000_000]
    assert message.t_capture_sigma_ns == 400_000


def test_only_whole_batches_of_joints_are_heard(rig: Rig) -> None:
    bad = [b"{", b"[]", b'{"t_ns": [1]}', b'{"t_ns": [1], "q": [[0, 0]]}', b'{"t_ns": [1], "q": [[0,0,0,0,0,NaN]]}']
    hear(Box(*bad), rig.sensor, 6)  # type: ignore[arg-type]
    assert rig.sensor.joints.at(1) is None
    hear(Box(b'{"t_ns": [1, 9], "q": [[0,0,0,0,0,0], [8,0,0,0,0,0]]}'), rig.sensor, 6)  # type: ignore[arg-type]
    assert rig.sensor.joints.at(5) == pytest.approx([4, 0, 0, 0, 0, 0])


# --- the background --------------------------------------------------------------------------------------------------


def test_a_background_belongs_to_one_camera_mode_and_calibration(tmp_path: Any) -> None:
    path = tmp_path / "a" / "left.npz"
    Background(frozen(WALL), belongs_to(INFO, CALIBRATION)).save(path)
    assert np.array_equal(background.load(path, INFO, CALIBRATION).depth, WALL)
    others = [
        dataclasses.replace(INFO, serial="S2"),
        dataclasses.replace(INFO, intrinsics=Intrinsics(80, 60, 61, 60, 39.5, 29.5)),
    ]
    for info, calibration in [*((other, CALIBRATION) for other in others), (INFO, b"\1" * 32)]:
        with pytest.raises(BackgroundError, match="another camera, mode or calibration"):
            background.load(path, info, calibration)
    path.write_bytes(b"no zip")
    with pytest.raises(BackgroundError, match="no background"):
        background.load(path, INFO, CALIBRATION)
    with pytest.raises(BackgroundError, match="--background"):
        background.load(tmp_path / "none.npz", INFO, CALIBRATION)


def test_the_background_is_the_median_of_what_is_not_the_arm(system: System) -> None:
    """The camera looks at the arm from 2 m in front of it, a wall 4 m away behind."""
    pose = look_at((2.0, 0.0, 0.3), (0.0, 0.0, 0.3))
    grid = Grid.over(np.array([-1.0, -0.5, 0]), np.array([1.0, 0.5, 0.5]), 0.1)
    rays = View(LENS, 0.001, pose, WALL, grid).rays
    rng = np.random.default_rng(2)
    frames = [np.rint(WALL + rng.normal(0, 5, WALL.shape)).astype(np.uint16) for _ in range(background.FRAMES)]
    for frame in frames:
        frame[20:40, 38:42] = 2000  # the arm's column
        frame[rng.random(frame.shape) < 0.2] = 0
    learnt = background.learn(frames, rays, pose, 0.001, system.model, np.zeros(6), 0.06)
    assert not learnt[25:35, 38:42].any(), "what the arm hides is not known"
    known = learnt[learnt > 0].astype(int)
    assert len(known) > 0.9 * WALL.size and np.abs(known - 4000).max() < 8
    elsewhere = np.where(learnt == 0, 3990, 0).astype(np.uint16)
    assert background.known(background.merged(learnt, elsewhere)) == 1.0


def test_a_binned_picture_has_the_rays_between_those_of_the_lens_that_was_calibrated() -> None:
    """Independent: the mean direction of the pixels that make one."""
    bins, fine = 4, Intrinsics(640, 480, 448.0, 450.0, 325.0, 236.0)
    value = (fine.fx, fine.fy, fine.cx, fine.cy, 0.0, 0.0, 0.0, 0.0, 0.0)
    lens = Result("intrinsics", "cam", value, rows(np.eye(9)), "made up", mode="640x480", serials={"camera": "S"})
    info = CameraInfo("m", "S", "1", Intrinsics(160, 120, 112.0, 112.0, 79.5, 59.5), 1e-3, 66_000_000, 20_000_000)
    pose = Result("hand-eye", "T_base_cam", pose_value(np.eye(4)), rows(np.eye(6)), "made up", serials={"camera": "S"})
    options = CameraOptions("one", "depth-stream", {}, pose, lens, None, Path("none"), bins)
    coarse = rays_of(with_lens(info, options).intrinsics)
    of_all = rays_of(fine).reshape(120, bins, 160, bins, 3).mean((1, 3))
    np.testing.assert_allclose(coarse, of_all, atol=1e-12)
    assert mismatches(options, info) == []
    (line,) = mismatches(dataclasses.replace(options, binning=2), info)
    assert "640x480" in line and "320x240" in line
