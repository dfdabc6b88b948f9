"""Result files: whoever loads one gets numbers that may be used, or one clear line per fault."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from asc_rt.cell_checks import hash_number
from asc_rt.cli import app
from asc_rt.config import ConfigError, load_cell
from calibration.geometry import difference, exp, inverse, log, perturb, pose
from calibration.result import CalibrationError, Result, load, pose_value, read, revoke, rows

T = pose(exp(np.array([0.3, -2.0, 0.4])), np.array([0.5, -1.0, 1.5]))
C = np.diag([1e-3, 2e-3, 1e-3, 1e-3, 5e-4, 1e-3]) ** 2
GOOD = Result(
    "hand-eye", "T_base_cam", pose_value(T), rows(C), "test", serials={"camera": "1234"}, mode="1280x720",
    valid_from="2026-01-01", valid_until="2100-01-01",
)  # fmt: skip


def saved(folder: Path, result: Result = GOOD) -> Path:
    result.save(folder / "cam.json")
    return folder / "cam.json"


def refusal(path: Path, **device: object) -> str:
    with pytest.raises(CalibrationError) as caught:
        load(path, **device)
    assert len(caught.value.lines) == 1
    assert str(path) in caught.value.lines[0]
    return caught.value.lines[0]


def test_a_file_comes_back_as_it_was(tmp_path: Path) -> None:
    result = load(saved(tmp_path), "hand-eye", {"camera": "1234"}, "1280x720")
    assert result == GOOD
    assert result.digest == GOOD.digest
    np.testing.assert_allclose(result.pose(), T, atol=1e-12)


@pytest.mark.parametrize(
    ("result", "device", "words"),
    [
        (replace(GOOD, valid_until="2026-02-01"), {}, ["valid_until", "expired on 2026-02-01"]),
        (replace(GOOD, valid_from="2099-01-01"), {}, ["valid_from", "clock"]),
        (replace(GOOD, reasons=("too few views",)), {}, ["accepted", "too few views"]),
        (revoke(GOOD, "bumped"), {}, ["revoked: bumped"]),
        (GOOD, {"kind": "intrinsics"}, ["kind", "'hand-eye'", "'intrinsics'"]),
        (GOOD, {"serials": {"camera": "99"}}, ["serials.camera", "1234", "99"]),
        (GOOD, {"serials": {"robot": "99"}}, ["serials.robot", "none", "99"]),
        (GOOD, {"mode": "640x480"}, ["mode", "1280x720", "640x480"]),
    ],
)
def test_what_must_not_be_used_is_refused(tmp_path: Path, result: Result, device: dict, words: list[str]) -> None:
    line = refusal(saved(tmp_path, result), **device)
    assert all(word in line for word in words), line


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"value": [0.501, *GOOD.value[1:]]}, ["hash", "changed"]),
        ({"format": 2}, ["format", "2", "1"]),
        ({"accepted": False}, ["hash"]),
        ({"hash": None}, ["hash"]),
    ],
)
def test_what_was_changed_by_hand_is_refused(tmp_path: Path, change: dict, words: list[str]) -> None:
    path = saved(tmp_path)
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    line = refusal(path)
    assert all(word in line for word in words), line


@pytest.mark.parametrize("content", [b"", b"\xff\xfe", b"[]", b"{}", b'{"format": 1}', b"null", b'{"format": NaN}'])
def test_any_other_file_is_refused_with_a_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "cam.json"
    path.write_bytes(content)
    assert refusal(path)
    assert "cannot be read" in refusal(tmp_path / "absent.json")


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"value": GOOD.value[:3]}, "shapes"),
        ({"covariance": rows(np.zeros((6, 6)))}, "error bars"),
        ({"covariance": rows(-C)}, "error bars"),
        ({"value": (*GOOD.value[:3], 0.0, 0.0, 0.0, 2.0)}, "quaternion"),
        ({"valid_until": "soon"}, "ISO"),
    ],
)
def test_numbers_that_are_none_are_refused_under_a_good_hash(tmp_path: Path, change: dict, word: str) -> None:
    assert word in refusal(saved(tmp_path, replace(GOOD, **change)))


def test_the_position_bound_covers_the_exact_one_and_grows_with_error_and_distance() -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(6, 6)) * 1e-3
    result = replace(GOOD, covariance=rows(root @ root.T))
    direction = rng.normal(size=(200, 3))
    points = 2.0 * direction / np.linalg.norm(direction, axis=1)[:, None]
    xi = rng.normal(size=(4000, 6)) @ root.T
    for p in points[:20]:
        moved = perturb(T, xi) @ [*p, 1] - T @ [*p, 1]
        worst = np.sqrt(np.linalg.eigvalsh(np.cov(moved[:, :3].T))[-1])
        assert result.position_bound(2.0, k=1) >= worst * 0.97
    assert replace(GOOD, covariance=rows(4 * C)).position_bound(1) == pytest.approx(2 * GOOD.position_bound(1))
    assert GOOD.position_bound(3) > GOOD.position_bound(1)


@given(st.lists(st.floats(-3, 3), min_size=6, max_size=6))
def test_poses_and_their_differences_fit_together(numbers: list[float]) -> None:
    xi = np.array(numbers)
    moved = perturb(T, xi)
    np.testing.assert_allclose(perturb(T, difference(moved, T)), moved, atol=1e-9)
    np.testing.assert_allclose(moved @ inverse(moved), np.eye(4), atol=1e-9)
    np.testing.assert_allclose(exp(log(moved[:3, :3])), moved[:3, :3], atol=1e-9)


# --- who asks --------------------------------------------------------------------------------------------------------


def test_a_cell_takes_the_hash_of_an_accepted_file_and_refuses_another(tmp_path: Path) -> None:
    path = saved(tmp_path)
    cell = load_cell("fanuc-sim-truth", [f"human.calibration={path}"])
    assert cell.params.human.sensors[0].calibration_hash == hash_number(GOOD.digest)
    assert read(path).digest == GOOD.digest
    saved(tmp_path, replace(GOOD, reasons=("chi2 9.1",)))
    with pytest.raises(ConfigError, match=r"human.calibration: .*accepted: it was refused: chi2 9.1"):
        load_cell("fanuc-sim-truth", [f"human.calibration={path}"])
    with pytest.raises(ConfigError, match=r"human.calibration: .*serials.camera"):
        load_cell("fanuc-sim-truth", [f"human.calibration={saved(tmp_path)}", "human.camera=A77"])


def test_the_command_checks_a_file(tmp_path: Path) -> None:
    def asc(*words: str) -> tuple[int, str]:
        done = CliRunner().invoke(app, ["calibrate", "check", *words])
        return done.exit_code, done.output

    path = str(saved(tmp_path))
    code, text = asc(path, "--json")
    shown = json.loads(text.splitlines()[-1])
    assert (code, shown["accepted"], shown["hash"]) == (0, True, GOOD.digest.hex())
    code, text = asc(path, "--json", "--camera", "5")
    assert code == 1
    assert "serials.camera" in json.loads(text.splitlines()[-1])["reasons"][0]
    assert asc(str(tmp_path / "absent.json"))[0] == 2


def test_today_can_be_any_day(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="expired"):
        load(saved(tmp_path), today=date(2101, 1, 1))
