"""The pictures that perception gives to the recording are the ones that the backend `recording` plays."""

from __future__ import annotations

import queue
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from asc_rt import topics
from asc_rt.config import load_cell
from asc_rt.perception import process
from asc_rt.perception.cameras import Frames
from asc_rt.perception.pictures import Pictures, image_message, lens_message
from drivers.cameras.base import CameraInfo, Depth, DepthFrame, Intrinsics, frozen
from logs import schema
from logs.camera import RecordedCamera
from tests.drivers.camera_files import write_log

MS = 1_000_000
T0_NS = 50_000 * MS


def info(unit_m: float = 0.001, distortion: tuple[float, ...] = (), name: str = "x") -> CameraInfo:
    return CameraInfo(name, "S1", "", Intrinsics(16, 12, 11.0, 12.0, 7.5, 5.5, distortion), unit_m, 33 * MS, 0)


def picture(seed: int) -> Depth:
    return frozen(np.random.default_rng(seed).integers(0, 4000, (12, 16)))


def frame(number: int, t_ns: int) -> DepthFrame:
    return DepthFrame(picture(number), t_ns, 0, 7, t_ns + 15 * MS, number)


def test_what_was_seen_is_played_as_it_was_seen(tmp_path: Path) -> None:
    lens = info(distortion=(0.1, 0.2, 0.3, 0.4, 0.5))
    told: list[tuple[schema.Channel | None, bytes]] = []
    shown = Pictures(
        [("left", info()), ("right", lens)],
        lambda data: told.append((schema.camera(data), data)),
        lambda data: told.append((schema.camera_calibration(data), data)),
    )
    times = [T0_NS + i * 33 * MS for i in (0, 1, 2, 4)]
    for i, t_ns in enumerate(times):
        shown.offer(1, frame(i, t_ns))
        time.sleep(0.02)
    shown.close()
    camera = RecordedCamera({"file": write_log(tmp_path / "a.mcap", told), "camera": "right"})
    found = camera.open()
    assert (found.intrinsics, found.unit_m, found.period_ns) == (lens.intrinsics, 0.001, 33 * MS)
    frames = [camera.read(time.monotonic_ns() + 300 * MS) for _ in times]
    assert all(f is not None and np.array_equal(f.depth, picture(i)) for i, f in enumerate(frames))
    assert [f.seq for f in frames if f] == [1, 2, 3, 5]
    assert [f.t_device_ns - frames[0].t_device_ns for f in frames if f and frames[0]] == [t - T0_NS for t in times]
    assert frames[0] and abs(frames[0].t_device_ns - T0_NS - time.time_ns() + time.monotonic_ns()) < 1000 * MS


def test_the_lens_is_told_once_a_second() -> None:
    lenses: list[bytes] = []
    shown = Pictures([("left", info())], lambda data: None, lenses.append)
    for i in range(25):
        shown.offer(0, frame(i, T0_NS + i * 100 * MS))
        time.sleep(0.005)
    shown.close()
    assert len(lenses) == 3


def test_what_it_cannot_keep_up_with_is_left_out_and_nobody_waits() -> None:
    busy, go, images = threading.Event(), threading.Event(), list[bytes]()

    def put_lens(data: bytes) -> None:
        busy.set()
        go.wait(10.0)

    shown = Pictures([("left", info())], images.append, put_lens)
    shown.offer(0, frame(0, T0_NS))
    assert busy.wait(10.0)
    started = time.monotonic()
    for i in range(1, 100):
        shown.offer(0, frame(i, T0_NS + i * MS))
    assert time.monotonic() - started < 1.0
    go.set()
    shown.close()
    times = [schema.CompressedImage.FromString(data).timestamp.ToNanoseconds() for data in images]
    assert [(t - times[0]) // MS for t in times] == [0, 98, 99], "the newest are there"


def test_perception_offers_every_frame_that_came_and_says_them_where_the_logger_listens() -> None:
    said: dict[str, list[bytes]] = {}

    class Line:
        def publisher(self, key: str) -> SimpleNamespace:
            return SimpleNamespace(put=said.setdefault(key, []).append)

        def queue(self, key: str) -> None:
            pass

    opened: Any = [SimpleNamespace(options=SimpleNamespace(name="left"), info=info())]
    sensor: Any = SimpleNamespace(eyes=[SimpleNamespace(info=info())], fault=0)
    bus: Any = Line()
    frames: Frames = queue.SimpleQueue()
    waiting: dict[int, DepthFrame] = {}
    with ExitStack() as stack:
        loop = process._Loop(load_cell("fanuc-sim"), bus, sensor, frames, [process._recorded(stack, opened, bus)])
        for i in range(2):
            frames.put((0, frame(i, T0_NS + i * MS)))
        loop._collect(waiting)
    assert waiting[0].seq == 1, "the newest"
    images, lenses = said[topics.CAMERA.key], said[topics.CAMERA_CALIBRATION.key]
    assert [channel.topic for data in images if (channel := schema.camera(data))] == ["/cell/camera/left"] * 2
    assert [c.topic for data in lenses if (c := schema.camera_calibration(data))] == ["/cell/camera/left/calibration"]


@pytest.mark.parametrize(("unit_m", "count", "mm"), [(0.001, 1234, 1234), (0.0001, 12346, 1235), (0.002, 40_000, 0)])
def test_depth_is_recorded_in_millimetres(unit_m: float, count: int, mm: int, tmp_path: Path) -> None:
    depth = frozen(np.full((12, 16), count))
    told = [
        (schema.camera(data), data) for i in (1, 2) if (data := image_message("left", depth, unit_m, T0_NS + i * MS))
    ]
    lens = lens_message("left", info().intrinsics, T0_NS)
    file = write_log(tmp_path / "a.mcap", [(schema.camera_calibration(lens), lens), *told])
    camera = RecordedCamera({"file": file, "camera": "left"})
    camera.open()
    found = camera.read(time.monotonic_ns() + 1000 * MS)
    assert found is not None and np.all(found.depth == mm)


@pytest.mark.parametrize(
    ("distortion", "model", "D"),
    [
        ((), "", []),
        ((1.0, 2.0, 3.0, 4.0), "plumb_bob", [1.0, 2.0, 3.0, 4.0, 0.0]),
        (tuple(map(float, range(8))), "rational_polynomial", list(range(8))),
        (tuple(map(float, range(14))), "opencv", list(range(14))),
    ],
)
def test_lenses_have_the_names_of_foxglove(distortion: tuple[float, ...], model: str, D: list[float]) -> None:
    told = schema.CameraCalibration.FromString(lens_message("left", info(distortion=distortion).intrinsics, T0_NS))
    assert (told.distortion_model, list(told.D), told.frame_id) == (model, D, "left")
    assert list(told.P) == [11.0, 0, 7.5, 0, 0, 12.0, 5.5, 0, 0, 0, 1, 0]
