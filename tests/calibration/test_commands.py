"""The commands on the files of a simulated cell: right within their error bars; bad input is refused."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import chain
import numpy as np
import pinocchio as pin
import pytest
from typer.testing import CliRunner

from asc_rt.cell_checks import hash_number
from asc_rt.cli import app
from asc_rt.config import ConfigError, load_cell
from calibration import files, guide, intrinsics, synthetic, vision
from calibration.geometry import inverse, pose
from calibration.result import Result, file_hash, load, rows
from logs.mcap_scan import LogError
from logs.reader import open_log
from sim_hil import calibration_cell

GOLDEN = Path(__file__).parents[1] / "golden" / "approach.mcap"

pytestmark = pytest.mark.timeout(900)  # the first test takes pictures, with whatever the machine has left


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, chain.Judged]:
    folder = tmp_path_factory.mktemp("calibration") / "cell"
    truth = calibration_cell.write(folder, 1)
    return folder, chain.calibrate(folder, truth)


def asc(*words: object) -> tuple[int, str]:
    """Exit code and output; what `main` would print of an error that other modules raise."""
    done = CliRunner().invoke(app, ["calibrate", *map(str, words)])
    if isinstance(done.exception, ConfigError | LogError):
        return 2, f"error: {done.exception}"
    return done.exit_code, done.output


def test_one_cell_is_calibrated_within_its_error_bars(cell: tuple[Path, chain.Judged]) -> None:
    folder, judged = cell
    assert not judged.refused, judged.refused
    assert max(judged.sigmas.values()) < 3, judged.sigmas
    assert judged.end_point_mm < 5
    eye = load(folder / "hand-eye.json", "hand-eye", mode="640x480", serials={"camera": "S1", "robot": "R1"})
    assert eye.inputs["intrinsics"] == load(folder / "intrinsics.json", "intrinsics").digest.hex()
    assert eye.inputs["poses.csv"] == file_hash(folder / "poses.csv")
    loaded = load_cell("fanuc-sim-truth", [f"human.calibration={folder}/hand-eye.json"])
    assert loaded.params.human.sensors[0].calibration_hash == hash_number(eye.digest)
    for kind in chain.KINDS:
        report = vision.read(folder / f"{kind}.png")
        assert report is not None
        assert report.std() > 10


# --- bad input -------------------------------------------------------------------------------------------------------


def test_an_existing_result_is_never_overwritten(cell: tuple[Path, chain.Judged]) -> None:
    folder, _ = cell
    before = (folder / "tool.json").read_bytes()
    code, text = asc("tool", folder / "touches.csv", "-o", folder / "tool.json")
    assert code == 2
    assert "never overwritten" in text
    assert (folder / "tool.json").read_bytes() == before


Spoil = Callable[[Path], list[object]]


def edited(source: Path, change: Callable[[np.ndarray], np.ndarray]) -> Path:
    """A copy of a pose table with every pose changed."""
    table = files.Table(source)
    out = source.with_name(f"edited-{source.name}")
    calibration_cell.write_poses(out, change(table.poses()), table.words("picture") if table.has("picture") else None)
    return out


def stretched(T: np.ndarray, factor: float) -> np.ndarray:
    return pose(T[:, :3, :3], factor * T[:, :3, 3])


def eye(folder: Path, poses: Path | None = None, square: float = 0.03, lens: str = "intrinsics.json") -> list[object]:
    shorten(folder, poses or folder / "poses.csv")
    return [
        "hand-eye", folder / "arm", "--poses", poses or folder / "poses.csv", "--intrinsics", folder / lens,
        "--square-m", square,
    ]  # fmt: skip


def shorten(folder: Path, poses: Path, left: int = 16) -> None:
    """Fewer pictures and poses: as good for a refusal, and quicker."""
    emptied(folder / "arm", left)
    lines = poses.read_text().splitlines()
    poses.write_text("\n".join(lines[: left + 1]) + "\n")


def blurred(folder: Path) -> list[object]:
    for path in emptied(folder / "lens", 14).iterdir():
        image = vision.read(path)
        assert image is not None
        vision.write(path, vision.blur(image, 6.0))
    return ["intrinsics", folder / "lens", "--square-m", 0.03]


def mirrored(folder: Path) -> list[object]:
    for path in emptied(folder / "lens", 8).iterdir():
        image = vision.read(path)
        assert image is not None
        vision.write(path, np.ascontiguousarray(image[:, ::-1]))
    return ["intrinsics", folder / "lens", "--square-m", 0.03]


def emptied(folder: Path, left: int = 0) -> Path:
    for path in sorted(folder.iterdir())[left:]:
        path.unlink()
    return folder


def few(folder: Path) -> list[object]:
    emptied(folder / "lens", 8)
    return ["intrinsics", folder / "lens", "--square-m", 0.03]


def one_axis(folder: Path) -> list[object]:
    def still(T: np.ndarray) -> np.ndarray:
        return pose(np.tile(T[0, :3, :3], (len(T), 1, 1)), T[:, :3, 3])

    return ["tool", edited(folder / "touches.csv", still)]


def relabelled(folder: Path, name: str, old: str, new: str) -> Path:
    path = folder / name
    path.write_text(path.read_text().replace(old, new))
    return path


def degrees_for_radians(folder: Path) -> list[object]:
    path = folder / "loaded.csv"
    table = files.Table(path)
    files.write(path, ",".join(table.header), np.hstack([np.degrees(table.joints(6)), table.torques(6)]))
    return ["payload", path]


BAD: dict[str, tuple[Spoil, int, str]] = {  # what is done, exit code, what must be said
    "blurred": (blurred, 2, "blurred; hold still"),
    "mirrored": (mirrored, 2, "the board is mirrored"),
    "too few": (few, 2, "views: 8 of 8 can be used; at least 12"),
    "no folder": (lambda f: ["intrinsics", f / "nothing", "--square-m", 0.03], 2, "no folder of pictures"),
    "no pictures": (lambda f: ["intrinsics", emptied(f / "lens"), "--square-m", 0.03], 2, "no pictures"),
    "square in mm": (lambda f: ["intrinsics", f / "lens", "--square-m", 30], 2, "not millimetres"),
    "no board": (lambda f: ["intrinsics", f / "lens", "--square-m", 0.03, "--board", "9"], 2, "no board"),
    "other": (lambda f: ["intrinsics", emptied(f / "lens", 5), "--square-m", 0.03, "--board", "8x7"], 2, "views: "),
    "square size": (lambda f: eye(f, square=0.0303), 1, "wrong square size"),
    "swapped": (lambda f: eye(f, edited(f / "poses.csv", inverse)), 1, "swapped frames"),
    "mm for m": (lambda f: eye(f, edited(f / "poses.csv", lambda T: stretched(T, 1000))), 2, "are these millimetres?"),
    "m for mm": (lambda f: eye(f, relabelled(f, "poses.csv", "x_m,y_m,z_m", "x_mm,y_mm,z_mm")), 2, "are these metres?"),
    "no unit": (lambda f: eye(f, relabelled(f, "poses.csv", "x_m", "x")), 2, "column x_m or x_mm is missing"),
    "mixed up": (lambda f: eye(f, edited(f / "poses.csv", lambda T: np.roll(T, 1, axis=0))), 1, "out of order"),
    "stranger": (lambda f: eye(f, relabelled(f, "poses.csv", "00.png", "99.png")), 2, "'99.png' is not in the folder"),
    "tool for a lens": (lambda f: eye(f, lens="tool.json"), 2, "kind: 'tool'; must be 'intrinsics'"),
    "touches turned about nothing": (one_axis, 1, "condition"),
    "touches swapped": (lambda f: ["tool", edited(f / "touches.csv", inverse)], 1, "swapped frames"),
    "touches in mm": (lambda f: ["tool", edited(f / "touches.csv", lambda T: stretched(T, 1000))], 2, "millimetres"),
    "degrees": (degrees_for_radians, 2, "are these degrees?"),
    "another robot": (lambda f: ["payload", f / "loaded.csv", "--robot", "panda"], 2, "q7_rad or q7_deg is missing"),
    "no robot": (lambda f: ["payload", f / "loaded.csv", "--robot", "x"], 2, "robot"),
    "not a trace": (lambda f: ["time-offset", f / "touches.csv", f / "camera.csv"], 2, "t_s or t_ms is missing"),
    "another motion": (lambda f: ["time-offset", f / "camera.csv", f / "poses.csv"], 2, "t_s or t_ms"),
    "not a recording": (lambda f: ["time-offset", f / "camera.mcap", f / "camera.csv"], 2, "mcap: cannot be read"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_refused_with_the_reason(name: str, cell: tuple[Path, chain.Judged], tmp_path: Path) -> None:
    spoil, expected, words = BAD[name]
    folder = tmp_path / "cell"
    shutil.copytree(cell[0], folder)
    out = folder / "out.json"
    code, text = asc(*spoil(folder), "-o", out, "--json")
    assert code == expected, text
    if code == 2:
        assert not out.exists()
        assert all(line.startswith("error: ") for line in text.splitlines() if line), text
        assert words in text
    else:
        shown = json.loads(text.splitlines()[-1])
        assert not shown["accepted"]
        assert any(words in reason for reason in shown["reasons"]), shown["reasons"]
        assert asc("check", out)[0] == 1


# --- guidance --------------------------------------------------------------------------------------------------------


def test_the_guide_asks_for_what_is_missing_until_nothing_is() -> None:
    rng, size, board = np.random.default_rng(4), (640, 480), calibration_cell.BOARD
    K = np.array([[560.0, 0, 320], [0, 560, 240], [0, 0, 1]])
    T = synthetic.filling(rng, 60, board, K, size)
    seen = synthetic.detections(rng, T, board, K, np.zeros(5), size, 0.1)
    assert guide.advice(intrinsics.Pictures(size, seen, [], []), board) == []
    left = [d for d in seen if d.pixels[:, 0].max() < 400][:10]
    lines = guide.advice(intrinsics.Pictures(size, left, [], []), board)
    assert "right of the picture" in lines[0]
    assert f"more views: {len(left)} of {guide.ENOUGH}" in lines[-1]
    assert any("tilt" in line for line in guide.advice(intrinsics.Pictures(size, seen[:1], [], []), board))


def test_the_guide_of_the_arm_asks_for_rotation_travel_and_views() -> None:
    rng, size, board = np.random.default_rng(4), (640, 480), calibration_cell.BOARD
    K = np.array([[560.0, 0, 320], [0, 560, 240], [0, 0, 1]])
    value = (560.0, 560.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    lens = Result("intrinsics", "cam", value, rows(np.eye(9)), "test")
    for tilt, width, n, words in ((0.6, 0.3, 60, []), (0.05, 0.02, 8, ["turn", "left and", "up and", "near", "more"])):
        T = synthetic.facing(rng, n, tilt, depth=0.8, width=width)
        T[:, 2, 3] = 0.7 + width * rng.uniform(-0.5, 0.5, n)
        seen = synthetic.detections(rng, T, board, K, np.zeros(5), size, 0.1)
        lines = guide.advice_on_arm(intrinsics.Pictures(size, seen, [], []), board, lens)
        assert len(lines) == len(words), lines
        assert all(word in line for word, line in zip(words, lines, strict=True)), lines


def test_watching_ends_when_there_is_enough(
    cell: tuple[Path, chain.Judged], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    board = calibration_cell.BOARD
    for path in (cell[0] / "lens").iterdir():
        shutil.copy(path, tmp_path)
    (tmp_path / "half.png").write_bytes((tmp_path / "00.png").read_bytes()[:100])
    guide.watch(tmp_path, board, lambda seen: guide.advice(seen, board))
    said = capsys.readouterr().err.splitlines()
    assert "00.png: good" in said
    assert said[-1] == "enough"


def test_the_camera_is_timed_against_the_recording_of_a_session(tmp_path: Path) -> None:
    """The flange by pinocchio alone, on a URDF read anew, as a camera that is 37 ms late and turned would see it."""
    log = open_log(GOLDEN)
    columns = log.columns("inputs.joint.t_rx_ns", "inputs.joint.q")
    t, q = 1e-9 * columns["inputs.joint.t_rx_ns"], columns["inputs.joint.q"]
    model = pin.buildModelFromXML(log.params.robot.urdf)
    data, flange = model.createData(), model.getFrameId(log.params.robot.flange)
    places = []
    for angles in q:
        pin.framesForwardKinematics(model, data, angles)
        places.append(data.oMf[flange].translation.copy())
    seen_at = np.arange(t[0] + 0.1, t[-1] - 0.1, 1 / 60)
    seen = np.stack([np.interp(seen_at, t, along) for along in np.transpose(places)], axis=1)
    seen = seen @ pin.exp3(np.array([0.3, 1.0, -0.4])) + np.random.default_rng(3).normal(0.0, 0.002, seen.shape)
    table = tmp_path / "camera.csv"
    np.savetxt(table, np.c_[seen_at + 0.037, seen], delimiter=",", header="t_s,x_m,y_m,z_m", comments="")
    code, said = asc("time-offset", GOLDEN, table, "-o", tmp_path / "found.json")
    assert code == 0, said
    found = load(tmp_path / "found.json", "time-offset")
    sigma = float(np.sqrt(found.covariance[0][0]))
    assert sigma < 2e-3 and abs(found.value[0] + 0.037) < 3 * sigma
