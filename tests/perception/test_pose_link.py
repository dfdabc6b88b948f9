"""The estimator in its own process: what it says comes in order, and whatever else it does is a line in the log.

The real model is asked where a variable names its file:  ASC_POSE_MODEL=x.task uv run --extra pose pytest -n0 -k real
"""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asc_rt.cell_cameras import PoseOptions
from asc_rt.config import load_cell
from asc_rt.core.system import System
from asc_rt.perception.pose import BACKENDS, link, process
from asc_rt.perception.pose.limbs import LIMBS, PEOPLE, Found, PoseError, Scene
from asc_rt.perception.pose.link import Link
from asc_rt.perception.volume import REACH_SPEED
from drivers.cameras import pcd
from drivers.cameras.base import DepthFrame, frozen_image
from tests.perception import test_five_people as five
from tests.perception.test_pose_added import Two, is_told_as_without, with_board
from tests.perception.test_pose_limbs import BOARD, IMAGE, a_scene, five_scene, needs_frame, with_boards
from tests.perception.test_sensor import PERIOD_NS

ROOT = Path(__file__).parents[2]
MODEL = os.environ.get("ASC_POSE_MODEL", "")
PATIENCE_S = 60.0
OFFLINE = (
    "import ctypes; libc = ctypes.CDLL(None); raise SystemExit(libc.unshare(0x40000000) and libc.unshare(0x50000000))"
)


@pytest.fixture(scope="module", autouse=True)
def _network_can_be_left() -> None:
    if subprocess.run([sys.executable, "-c", OFFLINE]).returncode:
        pytest.skip("the kernel gives this user no network namespace: no estimator may run here")


class Rig:
    def __init__(self, backend: str, scenes: dict[int, Scene], model: Path) -> None:
        self.lines: list[str] = []
        self.link = Link(PoseOptions(backend, model, bytes(32)), scenes, self.lines.append)

    def wait(self, done: Callable[[], object]) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not done():
            assert time.monotonic() < deadline, self.lines
            time.sleep(0.005)

    def ask(self, t_ns: int, camera: int = 0, frame: DepthFrame | None = None) -> Found:
        """Its answer to a frame of `t_ns`."""
        self.link.offer(camera, frame or shot(t_ns))
        self.wait(lambda: any((one.camera, one.t_ns) == (camera, t_ns) for one in self.link.newest()))
        return next(one for one in self.link.newest() if one.camera == camera)


def shot(t_ns: int, image: np.ndarray | None = IMAGE) -> DepthFrame:
    return DepthFrame(with_boards(BOARD), t_ns, 0, t_ns, t_ns, t_ns, image)


@pytest.fixture
def start(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Rig]]:
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    rigs = []

    def make(name: str, scenes: dict[int, Scene] | None = None, model: str = "model") -> Rig:
        monkeypatch.setitem(BACKENDS, "scripted", f"tests.perception.scripted_pose:{name}")
        rigs.append(Rig("scripted", scenes or {0: a_scene(), 1: a_scene()}, Path(model)))
        return rigs[-1]

    yield make
    for rig in rigs:
        rig.link.close()
        assert rig.link._child.returncode is not None, "nothing is left of it"


def test_limbs_come_with_the_stamp_of_their_own_capture_and_the_model_is_named(start: Callable[..., Rig]) -> None:
    rig = start("Good")
    assert rig.lines == [f"pose: scripted 1, model model (SHA-256 {'00' * 32})"]
    told = rig.ask(7)
    assert sorted(told.names) == sorted(limb.name for limb in LIMBS)
    assert told.p0.shape == told.p1.shape == (len(LIMBS), 3) and (told.bound > 0.08).all()
    assert rig.ask(9).t_ns == 9
    assert len(rig.lines) == 1


def test_each_camera_has_its_turn_and_one_without_a_picture_is_not_asked(
    start: Callable[..., Rig], monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = start("Good")
    rig.link.offer(1, shot(1, image=None))
    for k in range(2, 5):
        rig.ask(k)
    assert [one.camera for one in rig.link.newest()] == [0] and len(rig.lines) == 1
    answered, take = [], rig.link._take
    monkeypatch.setattr(rig.link, "_take", lambda number, *rest: (answered.append(number), take(number, *rest)))
    with rig.link._turn:
        for camera in (0, 1):
            rig.link.offer(camera, shot(5))
    deadline = time.monotonic() + PATIENCE_S
    while 1 not in answered:  # there is always one of the first
        rig.link.offer(0, shot(6))
        assert time.monotonic() < deadline
    assert answered.index(1) <= 1


def test_an_estimator_that_raises_is_a_line_and_is_asked_again(start: Callable[..., Rig]) -> None:
    rig = start("RaisesOnce")
    rig.link.offer(0, shot(1))
    rig.wait(lambda: len(rig.lines) == 2)
    assert "the graph has errors" in rig.lines[1] and rig.link.newest() == []
    assert len(rig.ask(2).names) == len(LIMBS)


def test_an_estimator_that_hangs_holds_nobody_up_and_is_ended(
    start: Callable[..., Rig], monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = start("Hangs")
    rig.link.offer(0, shot(1))
    rig.wait(lambda: rig.link._asked_ns)
    for k in range(2, 2000):  # were one of them to wait, this would take an hour
        rig.link.offer(0, shot(k))
    assert rig.link.newest() == [] and rig.link._child.poll() is None
    monkeypatch.setattr(link, "ANSWER_NS", 1)
    rig.link.offer(0, shot(3000))
    rig.wait(lambda: len(rig.lines) == 2)
    assert "no answer within" in rig.lines[1] and "until perception starts again" in rig.lines[1]
    rig.link.offer(0, shot(3001))
    rig.wait(lambda: rig.link._child.poll() is not None)


def test_an_estimator_that_crashes_is_a_line_and_the_rest_goes_on(start: Callable[..., Rig]) -> None:
    rig = start("Dies")
    rig.link.offer(0, shot(1))
    rig.wait(lambda: len(rig.lines) == 2)
    assert "its process ended" in rig.lines[1]
    rig.link.offer(0, shot(2))
    assert rig.link.newest() == []


def test_what_a_library_prints_is_no_answer(start: Callable[..., Rig]) -> None:
    rig = start("Chatters")
    assert len(rig.ask(1).names) == len(rig.ask(2).names) == len(LIMBS)


@pytest.mark.parametrize(("name", "said"), [("Refuses", "no model of ours; name another"), ("DiesAtOnce", "code 3")])
def test_what_cannot_run_is_refused_at_the_start(start: Callable[..., Rig], name: str, said: str) -> None:
    with pytest.raises(PoseError, match=said) as error:
        start(name)
    assert len(error.value.lines) == 1


def test_it_has_no_network(start: Callable[..., Rig]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        rig = start("AsksTheNetwork", model=str(server.getsockname()[1]))
    assert "refused: Network is unreachable" in rig.lines[0]


def test_who_cannot_be_kept_from_the_network_does_not_run(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def libc(name: None, use_errno: bool) -> Any:
        return type("Libc", (), {"prctl": lambda *_: 0, "unshare": lambda *_: -1})()

    monkeypatch.setattr(process.ctypes, "CDLL", libc)
    monkeypatch.setattr(process.os, "dup2", lambda *_: None)
    monkeypatch.setattr(process.os, "nice", lambda _: None)
    monkeypatch.setattr(process, "_serve", lambda *_: pytest.fail("it ran"))
    process.main()
    (line,) = json.loads(capfd.readouterr().out)["refused"]
    assert "network" in line and "allow user namespaces" in line


ROW = ["head", [1, 0, 0], [1, 0, 0], 0.1, 0.1]


@pytest.mark.parametrize(
    "line",
    [
        b"", b"{", b"[]", b"null", b"{}", b'{"limbs": null}', b'{"limbs": 3}', b'{"limbs": "head"}', b'{"limbs": [3]}',
        b'{"limbs": [["head"]]}', b"[" * 60000, b"\xff\xfe", json.dumps({"limbs": [ROW] * 1000}).encode(),
        *(
            json.dumps({"limbs": [[*ROW[:i], value, *ROW[i + 1 :]]]}).encode()
            for i, value in [
                (0, "tail"), (0, None), (1, [1, 2]), (1, [1, 2, 3, 4]), (1, [float("nan"), 0, 0]), (1, ["a", 0, 0]),
                (2, [float("inf"), 0, 0]), (2, [99, 0, 0]), (2, [10**400, 0, 0]), (3, 0), (3, -0.1), (3, 9),
                (3, float("nan")), (4, -0.1), (4, 9), (4, [1]),
            ]
        ),
    ],
)  # fmt: skip
def test_an_answer_that_is_not_entirely_in_order_is_none(line: bytes) -> None:
    with pytest.raises((ValueError, KeyError, TypeError, OverflowError)):
        link.found(0, 1, link._read(line))


def test_an_answer_in_order_is_one() -> None:
    assert link.found(0, 1, link._read(b'{"limbs": []}')).p0.shape == (0, 3)
    most = json.dumps({"limbs": [ROW] * (PEOPLE * len(LIMBS))}).encode()
    assert len(link.found(0, 1, link._read(most)).names) == PEOPLE * len(LIMBS) and len(most) < link.LONGEST_LINE


# --- from the picture to the message ---------------------------------------------------------------------------------


def test_what_is_seen_in_a_picture_is_told_beside_what_the_depth_layer_tells(start: Callable[..., Rig]) -> None:
    two = Two(System(load_cell("fanuc-sim-truth").params)).warm()
    rig = start("Good", scenes={1: link.scene(two.rig.eyes[1].view, 0.01)})
    two.rig.sensor._limbs = rig.link.newest
    frame = with_board(two.rig)
    frame = dataclasses.replace(frame, image=frozen_image(np.zeros((*frame.depth.shape, 3))))
    rig.ask(frame.t_capture_ns, camera=1, frame=frame)
    extra = is_told_as_without(*two.shoot())
    assert extra and {capsule.label for capsule in extra} <= {limb.name for limb in LIMBS}
    grown = REACH_SPEED * PERIOD_NS * 1e-9
    assert all(capsule.position_bound > 0.08 + grown for capsule in extra), "it is a period old"
    assert is_told_as_without(*[two.shoot() for _ in range(4)][-1]) == [], "and then forgotten"


# --- mediapipe -------------------------------------------------------------------------------------------------------

has_mediapipe = pytest.mark.skipif(
    importlib.util.find_spec("mediapipe") is None, reason="mediapipe is not installed (extra `pose`)"
)


@has_mediapipe
@pytest.mark.parametrize("content", [None, b"", b"no model", b"PK\x05\x06" + bytes(18)])
def test_a_file_that_is_no_model_is_refused_by_name(tmp_path: Path, content: bytes | None) -> None:
    model = tmp_path / "x.task"
    if content is not None:
        model.write_bytes(content)
    with pytest.raises(PoseError, match="x.task: no model that mediapipe takes") as error:
        Rig("mediapipe", {0: a_scene()}, model)
    assert len(error.value.lines) == 1 and "\n" not in error.value.lines[0] and "name a .task file" in str(error.value)


@needs_frame
@has_mediapipe
@pytest.mark.skipif(not MODEL, reason="ASC_POSE_MODEL names no model of mediapipe's pose landmarker (.task)")
def test_the_real_model_finds_the_limbs_of_all_five() -> None:
    cloud, rig = pcd.read_cloud(five.FRAME), Rig("mediapipe", {0: five_scene()}, Path(MODEL))
    told = rig.ask(1, frame=DepthFrame(cloud.depth, 1, 0, 1, 1, 1, cloud.image))
    rig.link.close()
    for name in ("head", "torso", "left upper arm", "right upper arm", "left forearm", "right forearm"):
        assert told.names.count(name) == 5, name
    heads = told.p0[[name == "head" for name in told.names]] @ five.LEVEL
    columns = sorted(five.LENS.fx * heads[:, 0] / heads[:, 2] + five.LENS.cx)
    assert all(left <= u <= right for u, (left, right) in zip(columns, five.COLUMNS, strict=True))
    arms = [np.linalg.norm(p1 - p0) for name, p0, p1 in zip(told.names, told.p0, told.p1, strict=True) if "arm" in name]
    assert len(arms) == 20 and min(arms) > 0.03 and max(arms) < 0.6
