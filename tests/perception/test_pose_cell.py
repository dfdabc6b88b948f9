"""[perception.pose] of a cell: off unless it is asked for, and what cannot be is one line that says what to do."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from contextlib import ExitStack, nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from asc_rt import doctor
from asc_rt.config import Cell, ConfigError, load_cell
from asc_rt.core.types import MAX_CAPSULES
from asc_rt.ladder.identity import cell_hash
from asc_rt.perception import process
from asc_rt.perception.grid import Grid, View
from asc_rt.perception.pose.limbs import PoseError
from drivers.cameras.base import Intrinsics
from logs import context

CELL = "fanuc-sim"
GRID = Grid.over(np.zeros(3), np.ones(3), 0.5)


def with_pose(model: Path, backend: str = "mediapipe") -> Cell:
    return load_cell(CELL, (f'perception.pose={{backend = "{backend}", model = "{model}"}}',))


@pytest.fixture
def model(tmp_path: Path) -> Path:
    path = tmp_path / "people.task"
    path.write_bytes(b"a model")
    return path


def test_it_is_off_and_its_library_is_not_loaded() -> None:
    cell = load_cell(CELL)
    assert cell.perception is not None and cell.perception.pose is None
    code = "import sys, asc_rt.perception.process; print(*{m.partition('.')[0] for m in sys.modules})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "mediapipe" not in done.stdout.split() and "cv2" in done.stdout.split()


def test_messages_session_and_cell_name_the_model_by_its_hash(model: Path) -> None:
    without, cell = load_cell(CELL), with_pose(model)
    assert cell.perception is not None and cell.perception.pose is not None and without.perception is not None
    assert cell.perception.pose.digest == hashlib.sha256(b"a model").digest()
    digests = {without.perception.digest, cell.perception.digest}
    said = {without.params.human.sensors[0].calibration_hash, cell.params.human.sensors[0].calibration_hash}
    hashes = {cell_hash(without), cell_hash(cell)}
    assert context.session(cell)["pose_model"] == f"people.task {hashlib.sha256(b'a model').hexdigest()}"
    assert "pose_model" not in context.session(without)
    model.write_bytes(b"another model")
    other = with_pose(model)
    assert other.perception is not None
    digests.add(other.perception.digest)
    said.add(other.params.human.sensors[0].calibration_hash)
    hashes.add(cell_hash(other))
    assert len(digests) == len(said) == len(hashes) == 3, "control stops for messages of another model"


def test_the_model_does_not_travel_with_the_recording(model: Path) -> None:
    cell = load_cell(CELL, ('perception.pose.backend="mediapipe"', f'perception.pose.model="{model}"'))
    assert cell.perception is not None and cell.perception.pose is not None
    assert b"a model" not in context.attachments(cell).values()


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ('{backend = "mediapipe", model = "none.task"}', ("perception.pose.model", "cannot be read", "none.task")),
        ('{backend = "openpose", model = "people.task"}', ("perception.pose.backend", "known: mediapipe")),
        ('{backend = "mediapipe"}', ("perception.pose.model", "missing")),
        ('{backend = "mediapipe", model = "people.task", speed = 1}', ("perception.pose.speed", "unknown key")),
    ],
)
def test_what_is_wrong_with_it_is_one_line(model: Path, override: str, said: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError) as error:
        load_cell(CELL, (f"perception.pose={override.replace('people.task', str(model))}",))
    (line,) = error.value.lines
    assert all(word in line for word in said), line


def test_cameras_without_a_picture_are_refused_at_the_start(model: Path) -> None:
    cell = with_pose(model)
    assert cell.perception is not None and cell.perception.pose is not None
    eyes = [SimpleNamespace(info=SimpleNamespace(has_image=False))] * 2
    sensor: Any = SimpleNamespace(eyes=eyes, observer=SimpleNamespace(pose_bounds=(0.0, 0.0)))
    opened: Any = [SimpleNamespace(options=SimpleNamespace(name=name)) for name in ("left", "right")]
    with ExitStack() as stack, pytest.raises(PoseError, match="no camera of left, right gives a picture") as error:
        process._posed(stack, cell.perception.pose, opened, sensor)
    assert "infrared = true" in error.value.lines[0]


@pytest.mark.parametrize("there", [True, False])
def test_the_doctor_says_whether_it_is_installed(model: Path, monkeypatch: pytest.MonkeyPatch, there: bool) -> None:
    monkeypatch.setattr(doctor, "find_spec", lambda name: object() if there else None)
    (found,) = doctor._pose(with_pose(model))
    assert found.ok == there and "people.task" in found.detail and "--extra pose" in found.fix
    assert list(doctor._pose(load_cell(CELL))) == []


def test_perception_that_may_not_run_it_ends_with_a_line(
    model: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refused(*_: Any) -> None:
        raise PoseError(["people.task: no model; name another one"])

    monkeypatch.setattr(process, "open_client", lambda endpoint: nullcontext())
    monkeypatch.setattr(process, "run", refused)
    monkeypatch.setattr(process.launch, "told_to_end", list)
    assert process.main([CELL]) == 2
    assert capsys.readouterr().err == "perception: people.task: no model; name another one\n"


def test_frames_go_to_the_estimator_and_its_limbs_to_the_sensor(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And nothing of it where it is not asked for."""
    made: list[Any] = []
    wired: dict[str, Any] = {}
    view = View(Intrinsics(8, 6, 6.0, 6.0, 3.5, 2.5), 0.001, np.eye(4), np.full((6, 8), 3000, np.uint16), GRID)
    eyes = [SimpleNamespace(view=view, info=SimpleNamespace(has_image=has)) for has in (False, True)]
    opened: Any = [SimpleNamespace(camera=SimpleNamespace(close=lambda: None))] * 2

    def link(options: Any, scenes: Any, tell: Any) -> Any:
        made.append(
            SimpleNamespace(offer=object(), newest=object(), scenes=scenes, close=lambda: wired.update(closed=1))
        )
        return made[-1]

    def sensor(cell: Any, opened: Any, clock: Any, limbs: Any = tuple) -> Any:
        wired["limbs"] = limbs
        return SimpleNamespace(eyes=eyes, observer=SimpleNamespace(pose_bounds=(0.01, 0.02)))

    def loop(cell: Any, bus: Any, sensor: Any, frames: Any, offers: Any) -> Any:
        wired["offers"] = offers
        return SimpleNamespace(run=lambda stop: None)

    for name, stub in {"open_all": lambda *_: opened, "Link": link, "sensor_of": sensor, "_Loop": loop}.items():
        monkeypatch.setattr(process, name, stub)
    monkeypatch.setattr(process, "Reader", lambda *_: SimpleNamespace(close=lambda: None))
    monkeypatch.setattr(process, "warm_up", lambda *_: None)
    monkeypatch.setattr(process.realtime, "set_up", lambda *_: None)
    bus: Any = None
    process.run(load_cell(CELL), bus, None, [])
    assert not made and wired == {"limbs": tuple, "offers": []}
    process.run(with_pose(model), bus, None, [])
    assert wired == {"limbs": made[0].newest, "offers": [made[0].offer], "closed": 1}
    assert made[0].scenes.keys() == {1} and made[0].scenes[1].bound == 0.02


def test_several_sensors_share_the_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """Control takes no message of too many capsules."""
    eyes = [SimpleNamespace(info=SimpleNamespace(period_ns=66_000_000))]
    monkeypatch.setattr(process, "observer_of", lambda *_: (None, eyes))
    more = ('human.sensors=["person", "other"]', 'human.calibrations={other = "ground-truth"}')
    for overrides, capsules in ((), MAX_CAPSULES), (more, MAX_CAPSULES // 2):
        assert process.sensor_of(load_cell(CELL, overrides), [])._identity.capsules == capsules
