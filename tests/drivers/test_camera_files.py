"""Cameras that play recordings: what they tell of the file, and what they make of a bad one."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_files import factory_calibration, write_mcap, write_mkv

from drivers.base import DriverError, HandshakeError, LinkError, ProtocolError
from drivers.cameras.azure import AzureRecording
from drivers.cameras.base import Depth, DepthFrame
from drivers.cameras.replay import Replay, Shot
from drivers.cameras.watch import CameraFault, Watch
from logs.camera import RecordedCamera

KINECT = Path(__file__).parents[3] / "shared" / "data" / "pyk4a_replay"  # beside the checkout, not in it
MS = 1_000_000
LENS = {"width": 16, "height": 12, "K": [11.0, 0, 7.5, 0, 12.0, 5.5, 0, 0, 1]}
GIVEN = {"fx": 1.0, "fy": 2.0, "cx": 3.0, "cy": 4.0}
SQUARE = (0.5, 0.5, 0.5, 0.5)  # cx cy fx fy


def picture(seed: int, height: int = 12, width: int = 16) -> Depth:
    return np.random.default_rng(seed).integers(500, 4000, (height, width)).astype(np.uint16)


def shots(*times_ms: int) -> list[tuple[int, np.ndarray]]:
    return [(t * MS, picture(i)) for i, t in enumerate(times_ms)]


def soon(seconds: float = 1.0) -> int:
    return time.monotonic_ns() + round(seconds * 1e9)


def played(camera: Any) -> list[DepthFrame]:
    found = []
    while (frame := camera.read(soon(0.3))) is not None:
        found.append(frame)
    return found


def recorded(tmp_path: Path, frames: Any = None, lens: Any = LENS, **options: Any) -> RecordedCamera:
    file = write_mcap(tmp_path / "a.mcap", shots(10, 43, 76) if frames is None else frames, lens=lens)
    return RecordedCamera({"file": file, "camera": "left", **options})


# --- playing ---------------------------------------------------------------------------------------------------------


def test_frames_keep_their_distances_and_a_lost_one_is_a_gap() -> None:
    times = [1000, 1030, 1061, 1150, 1180]
    replay = Replay((Shot(t, d) for t, d in shots(*times)), 30 * MS)
    time.sleep(0.05)  # who asks late for the first one gets it fresh
    asked_ns = time.monotonic_ns()
    frames = played(replay)
    assert [frame.seq for frame in frames] == [1, 2, 3, 6, 7]
    assert [frame.t_device_ns for frame in frames] == [t * MS for t in times]
    assert [frame.t_capture_ns - frames[0].t_capture_ns for frame in frames] == [(t - 1000) * MS for t in times]
    assert 0 <= frames[0].t_capture_ns - asked_ns < 200 * MS
    assert all(frame.t_capture_ns <= frame.t_arrival_ns for frame in frames)


def test_who_reads_late_gets_every_frame_with_its_age() -> None:
    replay = Replay((Shot(t, d) for t, d in shots(0, 10, 20)), 10 * MS)
    replay.read(soon())
    time.sleep(0.1)
    late = played(replay)
    assert [frame.seq for frame in late] == [2, 3]
    assert all(frame.t_arrival_ns - frame.t_capture_ns >= 70 * MS for frame in late)


def test_a_frame_that_is_not_due_waits_for_the_next_call() -> None:
    replay = Replay((Shot(t, d) for t, d in shots(0, 150)), 30 * MS)
    assert replay.read(soon()) is not None
    assert replay.read(soon(0.02)) is None
    frame = replay.read(soon())
    assert frame is not None and frame.t_device_ns == 150 * MS


# --- our own recordings ----------------------------------------------------------------------------------------------


def test_a_recording_tells_lens_period_and_pictures(tmp_path: Path) -> None:
    camera = recorded(tmp_path, shots(10, 76, 109, 140, 173), unit_m=0.00025, serial="123")
    info = camera.open()
    lens = info.intrinsics
    assert (lens.mode, lens.fx, lens.fy, lens.cx, lens.cy, lens.distortion) == ("16x12", 11.0, 12.0, 7.5, 5.5, ())
    assert (info.unit_m, info.period_ns, info.serial) == (0.00025, 33 * MS, "123")
    frames, watch = played(camera), Watch(info)
    assert all(np.array_equal(frame.depth, picture(i)) for i, frame in enumerate(frames))
    assert [frame.seq for frame in frames] == [1, 3, 4, 5, 6]
    assert [watch.look(frame) for frame in frames] == [CameraFault(0)] * 5
    assert watch.lost == 1


def test_the_lens_of_the_cell_counts_and_its_camera_is_the_serial(tmp_path: Path) -> None:
    info = recorded(tmp_path, **GIVEN).open()
    assert (info.intrinsics.fx, info.intrinsics.fy, info.intrinsics.cx, info.intrinsics.cy) == (1.0, 2.0, 3.0, 4.0)
    assert info.serial == "left"


@pytest.mark.parametrize(("model", "count"), [("plumb_bob", 5), ("rational_polynomial", 8)])
def test_a_lens_with_distortion_is_told(tmp_path: Path, model: str, count: int) -> None:
    D = [0.1 * i for i in range(1, count + 1)]
    info = recorded(tmp_path, lens=LENS | {"distortion_model": model, "D": D}).open()
    assert info.intrinsics.distortion == tuple(D)


def test_colour_and_damaged_pictures_are_lost_ones(tmp_path: Path) -> None:
    frames = shots(0, 33, 66, 99, 132)
    frames[1] = (frames[1][0], np.zeros((12, 16, 3), np.uint8))
    frames[3] = (frames[3][0], np.zeros(0, np.uint8))
    camera = recorded(tmp_path, [*frames, (165 * MS, picture(5)), (198 * MS, picture(6)), (231 * MS, picture(7))])
    camera.open()
    assert [frame.seq for frame in played(camera)] == [1, 3, 5, 6, 7, 8]


LENSES = {
    "its lens is not recorded": None,
    "its lens is for 640x480": LENS | {"width": 640, "height": 480},
    r"its lens \(fisheye\) is not understood": LENS | {"distortion_model": "fisheye", "D": [0.0] * 4},
    r"its lens \(plumb_bob\) is not understood": LENS | {"distortion_model": "plumb_bob", "D": [0.0] * 4},
    r"its lens \(no model\) is not understood": LENS | {"K": [0.0] * 9},
}


@pytest.mark.parametrize("what", LENSES)
def test_a_lens_that_does_not_fit_is_refused(tmp_path: Path, what: str) -> None:
    with pytest.raises(HandshakeError, match=what) as error:
        recorded(tmp_path, lens=LENSES[what]).open()
    assert error.value.hint


def test_one_picture_or_stamps_that_stand_still_are_no_camera(tmp_path: Path) -> None:
    with pytest.raises(HandshakeError, match="fewer than two depth images of camera 'left'"):
        recorded(tmp_path, shots(10)).open()
    (tmp_path / "a.mcap").unlink()
    with pytest.raises(HandshakeError, match="stand still"):
        recorded(tmp_path, shots(10, 10, 10)).open()


def test_a_recorded_camera_that_changes_its_size_is_an_error(tmp_path: Path) -> None:
    camera = recorded(tmp_path, [*shots(0, 33), (66 * MS, picture(3, 24, 32))])
    camera.open()
    camera.read(soon())
    camera.read(soon())
    with pytest.raises(ProtocolError, match="changes its size"):
        camera.read(soon())
    assert camera.read(soon(0.01)) is None


@pytest.mark.parametrize("kind", [RecordedCamera, AzureRecording])
@pytest.mark.parametrize("what", ["none", "a folder", "empty", "text", "altered"])
def test_a_file_that_is_no_recording_gives_one_clear_error(tmp_path: Path, kind: Any, what: str) -> None:
    path = tmp_path / "a.x"
    if what == "a folder":
        path.mkdir()
    elif what == "altered" and kind is RecordedCamera:
        data = bytearray(Path(write_mcap(path, shots(0, 33, 66), lens=LENS)).read_bytes())
        data[len(data) // 2] ^= 1
        path.write_bytes(data)
    elif what != "none":
        path.write_bytes({"empty": b"", "text": b"no recording\n" * 99, "altered": b"\x1aE\xdf\xa3" + bytes(999)}[what])
    options = {"file": str(path)} | ({"camera": "left"} if kind is RecordedCamera else {})
    camera = kind(options)
    with pytest.raises(LinkError if what in ("none", "a folder") else HandshakeError, match=r"a\.x") as error:
        camera.open()
    assert error.value.hint and "\n" not in str(error.value)
    with pytest.raises(LinkError, match="not open"):
        camera.read(soon(0.0))


@pytest.mark.parametrize("options", [{}, {"file": "a", "camera": "b", "fx": 1.0}])
def test_half_a_lens_and_no_file_are_wrong_options(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="missing"):
        RecordedCamera(options)


# --- Azure Kinect ----------------------------------------------------------------------------------------------------


def kinect(tmp_path: Path, calibration: bytes = factory_calibration(SQUARE), mode: str = "NFOV_2X2BINNED") -> str:
    frames = [(1000 * MS + t * MS, picture(t, 288, 320)) for t in (0, 33, 100)]
    return write_mkv(tmp_path / "a.mkv", frames, calibration, mode, start_ns=1000 * MS)


def test_a_kinect_recording_tells_its_stamps_and_a_gap(tmp_path: Path) -> None:
    camera = AzureRecording({"file": kinect(tmp_path)})
    lens = camera.open().intrinsics
    assert (lens.width, lens.height, lens.fx, lens.fy) == (320, 288, 256.0, 256.0)
    assert (lens.cx, lens.cy) == (256 - 96 - 0.5, 256 - 90 - 0.5)
    frames = played(camera)
    assert [frame.t_device_ns for frame in frames] == [1000 * MS, 1033 * MS, 1100 * MS]
    assert [frame.seq for frame in frames] == [1, 2, 4]
    assert all(np.array_equal(frame.depth, picture(t, 288, 320)) for t, frame in zip((0, 33, 100), frames, strict=True))


@pytest.mark.parametrize(
    ("what", "calibration", "mode"),
    [
        ("no calibration", b"{}", "NFOV_2X2BINNED"),
        ("no calibration", b"\xff", "NFOV_2X2BINNED"),
        ("no calibration", b"[1]", "NFOV_2X2BINNED"),
        ("no calibration", factory_calibration(SQUARE, model="Theta"), "NFOV_2X2BINNED"),
        ("no calibration", factory_calibration((0.5, 0.5, 0.0, 0.5)), "NFOV_2X2BINNED"),
        ("no calibration", factory_calibration((float("nan"), 0.5, 0.5, 0.5)), "NFOV_2X2BINNED"),
        ("of camera 'S2'; 'S1' recorded", factory_calibration(SQUARE, serial="S2"), "NFOV_2X2BINNED"),
        ("holds no depth", factory_calibration(SQUARE), "PASSIVE_IR"),
    ],
)
def test_a_kinect_without_its_lens_or_depth_is_refused(
    tmp_path: Path, what: str, calibration: bytes, mode: str
) -> None:
    with pytest.raises(HandshakeError, match=what) as error:
        AzureRecording({"file": kinect(tmp_path, calibration, mode)}).open()
    assert error.value.hint


def test_a_calibration_beside_the_recording_counts_before_the_attached(tmp_path: Path) -> None:
    file, beside = kinect(tmp_path, b"{}"), tmp_path / "calibration.json"
    with pytest.raises(LinkError, match="cannot be read"):
        AzureRecording({"file": file, "calibration": str(beside)}).open()
    beside.write_bytes(factory_calibration((0.5, 0.5, 0.25, 0.5)))
    assert AzureRecording({"file": file, "calibration": str(beside)}).open().intrinsics.fx == 128.0


def test_pictures_of_another_size_than_their_mode_are_an_error(tmp_path: Path) -> None:
    camera = AzureRecording({"file": kinect(tmp_path, mode="NFOV_UNBINNED")})
    camera.open()
    with pytest.raises(ProtocolError, match="184320 bytes in 640x576"):
        camera.read(soon())


def test_a_kinect_recording_cut_off_anywhere_gives_frames_or_an_error_of_ours(tmp_path: Path) -> None:
    file = Path(kinect(tmp_path))
    data = file.read_bytes()
    for size in [*range(0, 2000, 97), *range(2000, len(data), len(data) // 11)]:
        file.write_bytes(data[:size])
        camera = AzureRecording({"file": str(file)})
        try:
            camera.open()
            assert len(played(camera)) < 3
        except DriverError as error:
            assert error.hint
        camera.close()


def test_the_real_kinect_recording_shows_its_desk() -> None:
    if not KINECT.is_dir():
        pytest.skip(f"the sample recording is not there ({KINECT})")
    camera = AzureRecording({"file": str(KINECT / "recording.mkv")})
    info = camera.open()
    lens = info.intrinsics
    assert (info.serial, info.firmware, lens.mode, info.period_ns) == ("001514394512", "1.6.79", "640x576", 200 * MS)
    # As the k4a SDK tells them: 0.4927808940410614 * 1024 and 0.51296979188919067 * 1024 - 192 - 1/2.
    assert (lens.fx, lens.cx) == (pytest.approx(504.60764), pytest.approx(332.78107))
    assert lens.distortion[:4] == pytest.approx((0.547939777, -0.020971371, 2.0557534e-05, -7.2104158e-05))
    beside = AzureRecording({"file": str(KINECT / "recording.mkv"), "calibration": str(KINECT / "calibration.json")})
    assert beside.open() == info
    (frame,) = played(camera)
    assert frame.t_device_ns == 336_277_000 + 463_945_000
    # A desk within reach: read as little-endian it would be all over the range.
    assert 1000 < np.median(frame.depth[frame.depth > 0]) < 2000 and frame.depth.max() < 5000
    assert frame.invalid_ratio == pytest.approx(0.235, abs=0.001)
    assert Watch(info).look(frame) == CameraFault(0)
