"""Tables say their units; what they say is taken, and what cannot be is refused line by line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calibration import files
from calibration.geometry import exp
from calibration.result import CalibrationError


def table(folder: Path, text: str) -> files.Table:
    path = folder / "t.csv"
    path.write_text(text)
    return files.Table(path)


def test_units_and_angles_are_those_of_the_header(tmp_path: Path) -> None:
    """A pendant shows mm and w p r in degrees about the fixed axes x, y, z."""
    T = table(tmp_path, "x_mm,y_mm,z_mm,w_deg,p_deg,r_deg\n500,-20,300,0,0,90\n500,-20,300,90,0,90\n").poses()
    np.testing.assert_allclose(T[:, :3, 3], [[0.5, -0.02, 0.3]] * 2)
    about_z = exp(np.array([0, 0, np.pi / 2]))
    np.testing.assert_allclose(T[0, :3, :3], about_z, atol=1e-12)
    np.testing.assert_allclose(T[1, :3, :3], about_z @ exp(np.array([np.pi / 2, 0, 0])), atol=1e-12)
    again = table(tmp_path, "x_m,y_m,z_m,qx,qy,qz,qw\n0.5,-0.02,0.3,0,0,0.70710678,0.70710678\n").poses()
    np.testing.assert_allclose(again[0], T[0], atol=1e-8)
    assert table(tmp_path, "t_ms\n20\n40\n").times().tolist() == [0.02, 0.04]
    q = table(tmp_path, "q1_deg,q2_deg\n90,-45\n").joints(2)
    np.testing.assert_allclose(q, [[np.pi / 2, -np.pi / 4]])


HEAD = "x_m,y_m,z_m,qx,qy,qz,qw\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (HEAD + "0,0,a,0,0,0,1\n0,,0,0,0,0,1\n", ["line 3: y_m: '' is no number", "line 2: z_m: 'a' is no number"]),
        (HEAD + "0,0,1,0,0,0,1,5\n", ["line 2: not the 7 cells"]),
        (HEAD + "0,0,1,0,0,0,2\n", ["line 2: the quaternion has length 2"]),
        (HEAD + "0,0,nan,0,0,0,1\n", ["'nan' is no number"]),
        (HEAD + "0,0,500,0,0,0,1\n", ["are these millimetres? the header says m"]),
        (HEAD.replace("_m", "_mm") + "0.1,0,0.5,0,0,0,1\n", ["are these metres? the header says mm"]),
        ("x,y,z\n1,2,3\n", ["column x_m or x_mm is missing", "y_m", "z_m"]),
        (HEAD, ["no table"]),
        ("", ["no table"]),
    ],
)
def test_each_fault_of_a_table_has_its_line(tmp_path: Path, text: str, words: list[str]) -> None:
    with pytest.raises(CalibrationError) as caught:
        table(tmp_path, text).poses()
    lines = caught.value.lines
    assert len(lines) == len(words)
    for line, word in zip(lines, words, strict=True):
        assert word in line
        assert str(tmp_path) in line


def test_what_is_no_text_or_absent_is_refused(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_bytes(b"\xff\xfe\x00")
    for name in ("t.csv", "absent.csv"):
        with pytest.raises(CalibrationError, match="cannot be read"):
            files.Table(tmp_path / name)


def test_joints_in_degrees_under_a_header_of_radians_are_found(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="are these degrees"):
        table(tmp_path, "q1_rad,q2_rad\n90,-45\n").joints(2)
