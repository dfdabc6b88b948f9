"""What every depth camera in the registry promises, and what the watch makes of cameras that lie.

A new backend is one entry in `RIGS`: how to build it with a device behind it, and how that device shows a picture.
"""

from __future__ import annotations

import dataclasses
import inspect
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_files import factory_calibration, write_mcap, write_mkv

from drivers import registry
from drivers.base import DriverError, HandshakeError, LinkError, ProtocolError
from drivers.cameras import azure, pcd
from drivers.cameras.base import CameraInfo, DepthCamera, DepthFrame, Intrinsics
from drivers.cameras.clock import ForeignClock
from drivers.cameras.stream import DepthStream
from drivers.cameras.watch import CameraFault, Watch, moved
from logs.camera import RecordedCamera
from sim_hil.depth import Optics
from sim_hil.depth_camera import StreamServer

OPTICS = Optics(width=16, height=12, fx=11.0, fy=11.0)
PERIOD_NS = 33_000_000
PINHOLE = {"fx": 11.0, "fy": 11.0, "cx": 7.5, "cy": 5.5}


def picture(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(500, 4000, (OPTICS.height, OPTICS.width)).astype(np.uint16)


def colours(seed: int) -> np.ndarray:
    return np.random.default_rng(-seed % 97).integers(0, 255, (OPTICS.height, OPTICS.width, 3)).astype(np.uint8)


def infrared(seed: int) -> np.ndarray:
    return np.ascontiguousarray(colours(seed)[..., 0])


def soon(seconds: float = 1.0) -> int:
    return time.monotonic_ns() + round(seconds * 1e9)


@dataclass
class Rig:
    camera: DepthCamera
    show: Callable[[int], None]  # the picture of this number is taken
    image: Callable[[int], np.ndarray] | None = None  # which is this


def stream_rig(tmp_path: Path) -> Iterator[Rig]:
    server = StreamServer("127.0.0.1", 0, OPTICS, "S1", PERIOD_NS)
    camera = DepthStream({"port": server.open()})

    def greet() -> CameraInfo:
        import threading

        greeter = threading.Timer(0.02, server._greet)
        greeter.start()
        info = DepthStream.open(camera)
        greeter.join()
        return info

    camera.open = greet  # type: ignore[method-assign]
    yield Rig(camera, lambda seed: server.send(picture(seed), time.monotonic_ns() - 15_000_000))
    camera.close()
    server.close()


def pcd_rig(tmp_path: Path) -> Iterator[Rig]:
    files = [write_pcd(tmp_path / f"{i}.pcd", picture(i)) for i in range(1, 4)]
    yield Rig(pcd.PcdFiles({"files": files, **PINHOLE}), lambda seed: None)


def coloured_pcd_rig(tmp_path: Path) -> Iterator[Rig]:
    files = [write_pcd(tmp_path / f"{i}.pcd", picture(i), colours(i)) for i in range(1, 4)]
    yield Rig(pcd.PcdFiles({"files": files, **PINHOLE}), lambda seed: None, colours)


def write_pcd(path: Path, counts: np.ndarray, image: np.ndarray | None = None) -> str:
    z = np.where(counts > 0, counts * 0.001, np.nan).astype("<f4").ravel()
    colour = [] if image is None else [("rgba", "<u4")]
    points = np.zeros(z.size, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), *colour])
    points["z"] = z
    if image is not None:
        red, green, blue = image.reshape(-1, 3).astype("<u4").T
        points["rgba"] = (red << 16) | (green << 8) | blue
    more = " rgba", " 4", " U", " 1"
    fields, size, kind, number = more if image is not None else [""] * 4
    head = f"VERSION 0.7\nFIELDS x y z{fields}\nSIZE 4 4 4{size}\nTYPE F F F{kind}\nCOUNT 1 1 1{number}\n"
    head += f"WIDTH {counts.shape[1]}\n"
    path.write_bytes(f"{head}HEIGHT {counts.shape[0]}\nPOINTS {z.size}\nDATA binary\n".encode() + points.tobytes())
    return str(path)


def recording_rig(tmp_path: Path) -> Iterator[Rig]:
    lens = {"width": OPTICS.width, "height": OPTICS.height, "K": [11.0, 0, 7.5, 0, 11.0, 5.5, 0, 0, 1]}
    file = write_mcap(tmp_path / "a.mcap", [(i * PERIOD_NS, picture(i)) for i in range(1, 4)], lens=lens)
    yield Rig(RecordedCamera({"file": file, "camera": "left"}), lambda seed: None)


def azure_rig(tmp_path: Path) -> Iterator[Rig]:
    width, height = OPTICS.width, OPTICS.height
    lens = factory_calibration((8.0 / width, 6.0 / width, 11.0 / width, 11.0 / width))
    file = write_mkv(tmp_path / "a.mkv", [(i * PERIOD_NS, picture(i)) for i in range(1, 4)], lens)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(azure.MODES, "NFOV_UNBINNED", (width, (0, 0), (width, height)))
        yield Rig(azure.AzureRecording({"file": file}), lambda seed: None)


def infrared_rig(tmp_path: Path) -> Iterator[Rig]:
    yield from realsense_rig(tmp_path, with_infrared=True)


def realsense_rig(tmp_path: Path, with_infrared: bool = False) -> Iterator[Rig]:
    try:
        import pyrealsense2 as rs
    except ImportError:
        pytest.skip("pyrealsense2 is not installed (extra `realsense`, Debian libusb-1.0-0)")
    from drivers.cameras.realsense import RealSense

    device = rs.software_device()
    device.register_info(rs.camera_info.name, "software")
    device.register_info(rs.camera_info.serial_number, "S1")
    sensor = device.add_sensor("Depth")
    lens = rs.intrinsics()
    lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy = OPTICS.width, OPTICS.height, 11.0, 11.0, 7.5, 5.5

    def add(kind: Any, form: Any, index: int, size: int) -> Any:
        stream = rs.video_stream()
        stream.type, stream.fmt, stream.index, stream.uid = kind, form, index, size
        stream.width, stream.height, stream.fps, stream.intrinsics = OPTICS.width, OPTICS.height, 30, lens
        stream.bpp = size
        return sensor.add_video_stream(stream)

    profile = add(rs.stream.depth, rs.format.z16, 0, 2)
    add(rs.stream.infrared, rs.format.y8, 2, 1)  # the right one is no use
    left = add(rs.stream.infrared, rs.format.y8, 1, 1)
    sensor.add_read_only_option(rs.option.depth_units, 0.001)
    keep = []

    def send(seed: int, pixels: np.ndarray, profile: Any) -> None:
        frame = rs.software_video_frame()
        keep.append(pixels)
        frame.pixels, frame.bpp, frame.stride = keep[-1], pixels.itemsize, pixels.itemsize * OPTICS.width
        frame.timestamp, frame.domain, frame.frame_number = seed * 33.0, rs.timestamp_domain.hardware_clock, seed
        frame.profile = profile.as_video_stream_profile()
        sensor.on_video_frame(frame)

    def show(seed: int) -> None:
        shots = [(picture(seed), profile)] + [(infrared(seed), left)] * with_infrared
        for pixels, kind in shots if seed % 2 else reversed(shots):  # either may come first
            send(seed, pixels, kind)

    options = {"width": OPTICS.width, "height": OPTICS.height, "rate_hz": 30}
    camera = RealSense(options | {"infrared": True} if with_infrared else options, device)
    camera._keep = (device, sensor, keep)  # type: ignore[attr-defined]
    yield Rig(camera, show, infrared if with_infrared else None)
    camera.close()


RIGS = {
    "azure-mkv": azure_rig,
    "depth-stream": stream_rig,
    "pcd": pcd_rig,
    "pcd with colours": coloured_pcd_rig,
    "realsense": realsense_rig,
    "realsense with infrared": infrared_rig,
    "recording": recording_rig,
}


def test_every_registered_camera_is_tested() -> None:
    assert {name.partition(" ")[0] for name in RIGS} == registry.CAMERAS.keys()


@pytest.fixture(params=sorted(RIGS))
def rig(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Rig]:
    yield from RIGS[request.param](tmp_path)


@pytest.mark.parametrize("name", sorted(registry.CAMERAS))
def test_a_camera_has_the_methods_of_the_contract_and_names_wrong_options(name: str) -> None:
    kind = registry.camera_class(name)
    for method in ("open", "read", "close"):
        wanted, found = (list(inspect.signature(getattr(c, method)).parameters) for c in (DepthCamera, kind))
        assert wanted == found
    with pytest.raises(ValueError, match="nonsense"):
        kind({"nonsense": 1})


def test_frames_are_as_the_contract_says(rig: Rig) -> None:
    camera, info = rig.camera, rig.camera.open()
    assert (info.intrinsics.width, info.intrinsics.height) == (OPTICS.width, OPTICS.height)
    assert info.intrinsics.fx == 11.0 and info.intrinsics.cx == 7.5 and info.unit_m == pytest.approx(0.001)
    assert info.period_ns == pytest.approx(PERIOD_NS, rel=0.02)
    last: DepthFrame | None = None
    for seed in (1, 2, 3):
        rig.show(seed)
        frame = camera.read(soon())
        assert frame is not None
        assert np.array_equal(frame.depth, picture(seed)) and not frame.depth.flags.writeable
        assert frame.t_capture_ns <= frame.t_arrival_ns <= time.monotonic_ns()
        assert frame.invalid_ratio == 0.0
        assert info.has_image == (rig.image is not None) == (frame.image is not None)
        if rig.image is not None and frame.image is not None:
            assert np.array_equal(frame.image, rig.image(seed)) and not frame.image.flags.writeable
            assert frame.image.dtype == np.uint8 and frame.image.shape[:2] == frame.depth.shape
        if last is not None:
            assert frame.seq == last.seq + 1
            assert frame.t_capture_ns > last.t_capture_ns and frame.t_device_ns > last.t_device_ns
        last = frame
    started = time.monotonic()
    assert camera.read(soon(0.05)) is None, "silence is None at the deadline"
    assert time.monotonic() - started < 1.0
    camera.close()
    camera.close()
    with pytest.raises(LinkError, match="not open"):
        camera.read(soon(0.0))


# --- infrared alone --------------------------------------------------------------------------------------------------


def test_the_picture_is_the_left_imagers_and_depth_waits_a_little_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rigs = infrared_rig(tmp_path)
    rig = next(rigs)
    from drivers.cameras import realsense

    class Late:
        """Nothing is there at once."""

        def __init__(self, queue: Any) -> None:
            self.queue = queue

        def poll_for_frame(self) -> None:
            return None

        def try_wait_for_frame(self, wait_ms: int) -> tuple[bool, Any]:
            frame = self.queue.poll_for_frame() if wait_ms > 0 else None
            return bool(frame), frame

    camera: Any = rig.camera
    camera.open()
    streams = {(stream.stream_name(), stream.stream_index()) for stream in camera._sensor.get_active_streams()}
    assert {index for name, index in streams if "Infrared" in name} == {1}
    monkeypatch.setattr(realsense, "TOGETHER_MS", 60_000)  # so that a busy machine is no fault
    camera._queue = Late(camera._queue)
    for seed in (1, 2):
        rig.show(seed)
        frame = camera.read(soon(60.0))
        assert frame is not None and frame.image is not None and np.array_equal(frame.image, infrared(seed))
    rigs.close()


# --- the stream alone ------------------------------------------------------------------------------------------------


def test_an_unplugged_stream_and_a_damaged_frame_are_errors(tmp_path: Path) -> None:
    rigs = stream_rig(tmp_path)
    rig = next(rigs)
    server = inspect.getclosurevars(rig.show).nonlocals["server"]
    rig.camera.open()
    server.faults.damage = True
    rig.show(1)
    with pytest.raises(ProtocolError, match="CRC"):
        rig.camera.read(soon())
    server._drop()
    with pytest.raises(LinkError, match="broke") as error:
        rig.camera.read(soon())
    assert error.value.hint
    rigs.close()


def test_another_service_on_the_port_is_no_camera() -> None:
    import socket
    import threading

    with socket.create_server(("127.0.0.1", 0)) as server:
        threading.Thread(target=lambda: server.accept()[0].sendall(bytes(400)), daemon=True).start()
        with pytest.raises(HandshakeError, match="no depth stream"):
            DepthStream({"port": server.getsockname()[1]}).open()
    with pytest.raises(LinkError, match="no depth stream at"):
        DepthStream({"port": server.getsockname()[1] if server.fileno() > 0 else 1}).open()


def test_a_foreign_clock_is_mapped_by_its_fastest_frame() -> None:
    clock = ForeignClock(10)
    assert clock.capture_ns(1000, 5050) == 5040  # held up by 40
    assert clock.capture_ns(1100, 5110) == 5100
    assert clock.capture_ns(1200, 5999) == 5200  # held up again: its stamp is not younger for it


# --- files -----------------------------------------------------------------------------------------------------------


def test_a_flat_cloud_and_a_cut_off_one_are_refused(tmp_path: Path) -> None:
    path = Path(write_pcd(tmp_path / "a.pcd", picture(1)))
    path.write_bytes(path.read_bytes().replace(b"HEIGHT 12", b"HEIGHT 1").replace(b"WIDTH 16", b"WIDTH 192"))
    with pytest.raises(HandshakeError, match="not organised"):
        pcd.depth_image(path)
    path = Path(write_pcd(tmp_path / "b.pcd", picture(1)))
    path.write_bytes(path.read_bytes()[:-500])
    with pytest.raises(HandshakeError, match="not a point cloud"):
        pcd.depth_image(path)
    with pytest.raises(LinkError, match="cannot be read"):
        pcd.depth_image(tmp_path / "none.pcd")


# --- the watch -------------------------------------------------------------------------------------------------------

INFO = CameraInfo("", "", "", Intrinsics(16, 12, 11, 11, 7.5, 5.5), 0.001, PERIOD_NS, latency_ns=10_000_000)


def frames(count: int = 3) -> list[DepthFrame]:
    start = 10_000_000_000
    return [
        DepthFrame(picture(i), start + i * PERIOD_NS, 0, i * PERIOD_NS, start + i * PERIOD_NS + 15_000_000, i)
        for i in range(1, count + 1)
    ]


def judged(found: list[DepthFrame]) -> CameraFault:
    watch = Watch(INFO)
    return [watch.look(frame) for frame in found][-1]


def test_a_camera_in_order_has_no_fault_and_a_gap_is_counted() -> None:
    assert judged(frames()) == CameraFault(0)
    watch = Watch(INFO)
    for frame in (frames(6)[0], frames(6)[4]):
        assert watch.look(frame) == CameraFault(0)
    assert watch.lost == 3


LIES: dict[str, tuple[CameraFault, dict[str, Any]]] = {
    "the same picture": (CameraFault.FROZEN, {"depth": frames()[1].depth}),
    "number runs backwards": (CameraFault.CLOCK, {"seq": 1}),
    "number repeats": (CameraFault.CLOCK, {"seq": 2}),
    "stamp of the future": (CameraFault.CLOCK, {"t_capture_ns": frames()[2].t_arrival_ns + 1_000_000}),
    "younger than can be": (CameraFault.CLOCK, {"t_capture_ns": frames()[2].t_arrival_ns - 5_000_000}),
    "far too old": (CameraFault.CLOCK, {"t_arrival_ns": frames()[2].t_arrival_ns + 600_000_000}),
    "clock jumps": (CameraFault.CLOCK, {"t_device_ns": frames()[2].t_device_ns + 10_000_000_000}),
    "clock runs backwards": (CameraFault.CLOCK, {"t_device_ns": 0}),
    "covered": (CameraFault.COVERED, {"depth": np.zeros((12, 16), np.uint16)}),
    "half covered": (CameraFault.COVERED, {"depth": picture(3) * (np.arange(16) < 9).astype(np.uint16)}),
}


@pytest.mark.parametrize("name", LIES)
def test_a_camera_that_lies_is_found_out(name: str) -> None:
    fault, change = LIES[name]
    first, second, third = frames()
    assert judged([first, second, dataclasses.replace(third, **change)]) & fault


def test_silence_is_found_and_ends_with_a_frame() -> None:
    watch, found = Watch(INFO), frames()[0]
    assert watch.silent(found.t_arrival_ns) == CameraFault.SILENT
    watch.look(found)
    assert watch.silent(found.t_arrival_ns + 2 * PERIOD_NS) == CameraFault(0)
    assert watch.silent(found.t_arrival_ns + 4 * PERIOD_NS) == CameraFault.SILENT


def test_seeing_through_the_background_is_a_moved_camera_and_a_person_is_not() -> None:
    background = np.full((12, 16), 3000, np.uint16)
    person = background.copy()
    person[:, 4:10] = 1500
    shifted = background.copy()
    shifted[:, :4] = 3600
    assert not moved(person, background)
    assert moved(shifted, background)
    assert not moved(np.zeros_like(background), background)


@pytest.mark.parametrize("name", ["nonsense", "pcd2"])
def test_an_unknown_camera_lists_the_known_ones(name: str) -> None:
    with pytest.raises(ValueError, match=r"known: azure-mkv, depth-stream, pcd, realsense, recording"):
        registry.camera_class(name)
    assert issubclass(LinkError, DriverError)
