"""Each method against known truth: right within its own error bars; bad data are refused with the reason."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from asc_rt.config import load_arm
from calibration import hand_eye, intrinsics, montecarlo, payload, synthetic, time_offset, tool, vision
from calibration.geometry import inverse
from calibration.hand_eye import RobotNoise, Views
from calibration.result import CalibrationError
from calibration.touch import Touch
from sim_hil.board_camera import Lens, render

NOISE = RobotNoise()
BOARD = vision.Board()


def views(n: int = 24, tilt: float = 0.52, seed: int = 3) -> tuple[Views, np.ndarray]:
    data, Z, _ = synthetic.views(np.random.default_rng(seed), n, tilt, NOISE, montecarlo.PIXEL)
    return data, Z


def check_rows(rows: Iterator[montecarlo.Row], low: float, high: float) -> None:
    ours = 0.0
    for row in rows:
        if np.isnan(row.ratio):
            assert np.hypot(row.bias, row.spread) >= ours, row
        else:
            assert low < row.ratio < high, row
            ours = float(np.hypot(row.bias, row.spread))


def test_error_bars_are_honest_in_few_trials() -> None:
    noise = NOISE
    errors = []
    for seed in range(15):
        data, Z, _ = synthetic.views(np.random.default_rng(seed), 12, 0.52, noise, montecarlo.PIXEL)
        found = hand_eye.solve(data, noise)
        xi = hand_eye.difference(found.T_base_cam, Z)
        errors.append(xi @ np.linalg.solve(found.covariance[:6, :6], xi) / 6)
    assert 0.6 < np.mean(errors) < 1.5
    check_rows(montecarlo.other_rows(4), 0.4, 1.9)


@pytest.mark.slow
@pytest.mark.timeout(3000)
def test_error_bars_are_honest() -> None:
    check_rows(montecarlo.table(100), 0.8, 1.25)


def test_acceptance_lets_good_data_pass_and_finds_bad_ones() -> None:
    found = montecarlo.acceptance(2)
    assert 0.6 < found["chi2 / dof of good data, mean"] < 1.4
    assert 0.4 < found["jack-knife sigma / true error, rms"] < 2.5
    assert found["good data refused"] == found["good data refused by the touch check"] == 0
    assert found["camera 10 mm off refused by the touch check"] == 1
    assert found["robot 3 mm off in half of the views refused"] == 1


# --- hand-eye --------------------------------------------------------------------------------------------------------


def test_a_good_hand_eye_is_accepted() -> None:
    data, Z = views()
    result, solution = hand_eye.calibrate(data)
    assert result.accepted, result.reasons
    assert np.linalg.norm(result.pose()[:3, 3] - Z[:3, 3]) < 3 * np.sqrt(np.trace(solution.covariance[:3, :3]))


def test_what_the_lens_and_the_print_may_be_wrong_by_is_in_the_error_bar() -> None:
    data = views(16)[0]
    wrong = synthetic.shared_errors(np.random.default_rng(1), data)
    alone, shared = (hand_eye.solve(v, NOISE).covariance[:3, :3] for v in (data, wrong))
    assert np.trace(shared) > np.trace(alone) + 0.8e-6  # 0.1 % of 1.3 m, less what the views tell of it


BAD_VIEWS = {
    "swapped frames": (lambda v: replace(v, flange=inverse(v.flange)), "fit as T_flange_base"),
    "camera frames swapped": (lambda v: replace(v, board=inverse(v.board)), "fit as T_flange_base"),
    "millimetres": (lambda v: replace(v, flange=scaled(v.flange, 1000)), "poses are millimetres"),
    "square size": (lambda v: replace(v, board=scaled(v.board, 1.05)), "says 0.95"),
    "square a little off": (lambda v: replace(v, board=scaled(v.board, 1.005)), "says 0.99"),
    "pairs out of order": (lambda v: replace(v, board=np.roll(v.board, 1, axis=0)), "out of order"),
}


def scaled(T: np.ndarray, factor: float) -> np.ndarray:
    T = T.copy()
    T[:, :3, 3] *= factor
    return T


@pytest.mark.parametrize("name", BAD_VIEWS)
def test_hand_eye_refuses(name: str) -> None:
    spoil, words = BAD_VIEWS[name]
    result, _ = hand_eye.calibrate(spoil(views()[0]))
    assert any(words in reason for reason in result.reasons), result.reasons


def test_hand_eye_refuses_motion_about_one_axis_and_too_few_views() -> None:
    result, _ = hand_eye.calibrate(views(tilt=0.05)[0])
    assert any("rotation" in reason for reason in result.reasons), result.reasons
    with pytest.raises(CalibrationError, match="views: 9 are too few"):
        hand_eye.calibrate(views(9)[0])


def test_the_touch_check_finds_what_the_fit_cannot() -> None:
    data, Z = views()
    seen = np.random.default_rng(1).uniform(-0.3, 0.3, (5, 3)) + [0, 0, 1.3]
    tip = seen @ Z[:3, :3].T + Z[:3, 3]
    assert hand_eye.calibrate(data, touch=Touch(tip, seen))[0].accepted
    result, _ = hand_eye.calibrate(data, touch=Touch(tip + [0.03, 0, 0], seen))
    assert any("touch check" in reason for reason in result.reasons)


# --- tool, payload, time offset --------------------------------------------------------------------------------------


def test_tool_refuses_what_gives_a_plausible_wrong_tip() -> None:
    rng = np.random.default_rng(2)
    good, tip = synthetic.touches(rng, 8, 0.8, 5e-4)
    found = tool.calibrate(good)
    assert found.accepted
    assert np.all(np.abs(found.value - tip) < 4 * found.sigma)
    narrow, _ = synthetic.touches(rng, 8, 0.1, 5e-4)
    for flange, word in (
        (narrow, "condition"),
        (np.tile(good[:1], (8, 1, 1)), "condition"),
        (inverse(good), "swapped frames"),
        (scaled(good, 1000), "millimetres"),
    ):
        assert any(word in reason for reason in tool.calibrate(flange).reasons), word
    with pytest.raises(CalibrationError, match="poses: 3 are too few"):
        tool.calibrate(good[:3])


def test_payload_refuses_what_it_cannot_see() -> None:
    robot, _ = load_arm("lrmate_200id", "drill")
    q, tau, empty, load = synthetic.held(np.random.default_rng(5), robot, 12)
    found = payload.calibrate(robot, q, tau, empty)
    assert found.accepted
    assert np.all(np.abs(found.value - load) < 4 * found.sigma)
    assert f"mass_kg = {found.value[0]:.4f}" in payload.tool_lines(found)
    one = np.tile(q[:1], (12, 1))
    assert any("condition" in r for r in payload.calibrate(robot, one, tau, empty).reasons)
    assert any("sign" in r for r in payload.calibrate(robot, q, empty, tau).reasons)
    assert payload.calibrate(robot, np.degrees(q), tau, empty).reasons
    with pytest.raises(CalibrationError, match="shapes"):
        payload.calibrate(robot, q[:, :5], tau, empty)


def test_time_offset_refuses_other_motions_units_and_periods() -> None:
    rng = np.random.default_rng(6)
    t, p, tr, pr = synthetic.motion(rng, 2e-3, 0.043)
    found = time_offset.calibrate(t, p, tr, pr)
    assert found.accepted
    assert abs(found.value[0] - 0.043) < 4 * found.sigma[0]
    again = np.sin(2 * np.pi * tr / 0.2)[:, None] * [0.1, 0.05, 0]
    seen = np.sin(2 * np.pi * (t + 0.043) / 0.2)[:, None] * [0.1, 0.05, 0]
    for case, word in (
        ((t, p, tr, 1000 * pr), "units"),
        ((t, synthetic.motion(rng, 2e-3, 0.0)[1], tr, pr), "not the same motion"),
        ((t, seen + 2e-3 * rng.normal(size=seen.shape), tr, again), "repeats itself"),
        ((t, 0.01 * p, tr, 0.01 * pr), "move faster"),
        ((t + 0.45, p, tr, pr), "end of"),
    ):
        assert any(word in reason for reason in time_offset.calibrate(*case).reasons), word
    with pytest.raises(CalibrationError, match="do not rise"):
        time_offset.calibrate(t[::-1], p, tr, pr)


# --- intrinsics ------------------------------------------------------------------------------------------------------


def photo(seed: int = 1, **optics: float) -> np.ndarray:
    rng, lens = np.random.default_rng(seed), Lens()
    K = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
    T = synthetic.filling(rng, 6, BOARD, K, (lens.width, lens.height))[5]
    return render(lens, lens.rays(), T, BOARD.picture(60), BOARD.square, BOARD.columns, rng, **optics)


def test_the_rendered_board_is_seen_where_it_is() -> None:
    """The renderer has its own optics: both would have to be wrong in the same way."""
    lens, rng = Lens(), np.random.default_rng(1)
    K = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
    T = synthetic.filling(rng, 6, BOARD, K, (lens.width, lens.height))[5]
    found = vision.detect(photo(), BOARD)
    expected = vision.project(BOARD.corners()[found.ids], T, K, np.array(lens.distortion))
    assert len(found) > 20
    assert np.sqrt(np.mean(vision.residual(expected, found.pixels) ** 2)) < 0.1


def test_pictures_of_no_use_are_named() -> None:
    good = photo()
    pictures = intrinsics.look(
        {"good": good, "mirror": np.ascontiguousarray(good[:, ::-1]), "blur": photo(blur=6.0), "none": 0 * good + 90},
        BOARD,
    )
    assert pictures.names == ["good"]
    for words, line in zip(("mirrored", "blurred", "0 corners"), pictures.dropped, strict=True):
        assert words in line
    with pytest.raises(CalibrationError, match="views: 1 of 4"):
        intrinsics.calibrate(pictures, BOARD)
    with pytest.raises(CalibrationError, match="one mode"):
        intrinsics.look({"a": good, "b": good[:100]}, BOARD)


@pytest.mark.parametrize("blur", [0.6, 2.0, 5.0])
@pytest.mark.parametrize("noise", [0.5, 6.0])
def test_blur_is_measured_through_noise(blur: float, noise: float) -> None:
    assert vision.edge_width(photo(blur=blur, noise=noise)) == pytest.approx(blur, abs=0.35 + 0.15 * blur)


def centred(tilt: float, n: int = 20) -> intrinsics.Pictures:
    rng, K = np.random.default_rng(8), np.array([[560.0, 0, 320], [0, 560, 240], [0, 0, 1]])
    T = synthetic.facing(rng, n, tilt, depth=0.9, width=0.02)
    seen = synthetic.detections(rng, T, BOARD, K, np.array([-0.12, 0.05, 0, 0, 0]), (640, 480), 0.15)
    return intrinsics.Pictures((640, 480), seen, [""] * len(seen), [])


def test_a_small_rms_does_not_pass_for_a_good_lens() -> None:
    result = intrinsics.calibrate(centred(0.5), BOARD)
    assert result.quality["rms"] < 0.3
    assert any("coverage" in reason for reason in result.reasons)
    assert any("tilt" in reason for reason in intrinsics.calibrate(centred(0.1), BOARD).reasons)


def test_good_views_are_accepted_and_true() -> None:
    result, truth = montecarlo.photograph(np.random.default_rng(2), 40)
    assert result.accepted, result.reasons
    assert np.all(np.abs(result.value - truth) < 4.5 * result.sigma)


def test_shapes_that_would_broadcast_are_refused() -> None:
    seen = np.zeros((5, 2))
    for shape in ((5, 1, 2), (1, 2), (5,)):
        with pytest.raises(ValueError, match="both must be"):
            vision.residual(np.zeros(shape), seen)
    assert vision.points2(np.zeros((5, 1, 2))).shape == vision.residual(seen, seen).shape == (5, 2)
