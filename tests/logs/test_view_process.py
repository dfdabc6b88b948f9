"""The viewer's processes: they keep to this machine, need no display for a picture, and disturb no running cell."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from asc_rt import ring
from logs.view import view
from logs.view_live import newest_ring
from logs.view_process import ViewError, free_port, viewer, wait_for


def listeners(port: int) -> list[str]:
    """Addresses on which this machine listens at `port`, as in /proc/net/tcp."""
    lines = [line.split() for name in ("tcp", "tcp6") for line in Path("/proc/net", name).read_text().splitlines()[1:]]
    return [
        line[1].partition(":")[0] for line in lines if line[3] == "0A" and int(line[1].partition(":")[2], 16) == port
    ]


@pytest.mark.real_time
def test_the_viewer_keeps_to_this_machine_and_reports_nothing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    ports = [free_port(), free_port()]
    arguments = ("--serve-web", "--port", str(ports[0]), "--web-viewer-port", str(ports[1]))
    with viewer(*arguments) as running:
        wait_for(lambda: all(listeners(port) for port in ports) or None, running)
        time.sleep(0.5)  # reports are written a moment later
        assert [listeners(port) for port in ports] == [["0100007F"]] * 2
        private = running.output.parent / "rerun"
        assert [path.name for path in private.rglob("*")] == ["analytics.json"]
    assert running.process.poll() is not None
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def vulkan_driver() -> bool:
    named = os.environ.get("VK_DRIVER_FILES") or os.environ.get("VK_ICD_FILENAMES")
    folders = (Path("/usr/share/vulkan/icd.d"), Path("/etc/vulkan/icd.d"))
    return bool(named) or any(list(folder.glob("*.json")) for folder in folders)


@pytest.mark.skipif(not vulkan_driver(), reason="no Vulkan driver: apt-get install mesa-vulkan-drivers libvulkan1")
def test_a_picture_needs_no_display(recording: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    view(recording.write(recording.packed(recording.cycles(30))), shot=tmp_path / "x.png", at=0.16)
    picture = cv2.imread(str(tmp_path / "x.png"))
    assert picture is not None and picture.shape == (1000, 1600, 3)
    scene = picture[60:540, 20:880].astype(int)
    blue, green, red = np.moveaxis(scene, -1, 0)
    assert (red - blue > 60).mean() > 0.002  # people, in warm colours
    assert (blue - red > 60).mean() > 0.002  # the judged arm


def test_without_a_graphics_driver_the_remedy_is_told(
    recording: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("VK_ICD_FILENAMES", "VK_DRIVER_FILES"):
        monkeypatch.setenv(name, "/nowhere.json")
    path = recording.write(recording.packed(recording.cycles(10)))
    with pytest.raises(ViewError, match="apt-get install mesa-vulkan-drivers libvulkan1") as told:
        view(path, shot=tmp_path / "x.png")
    assert "\n" not in str(told.value)
    assert not (tmp_path / "x.png").exists()


def test_a_watcher_sees_everything_and_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "ring"
    ring.create(path, 64, 8)
    with ring.RingWriter(path) as writer, ring.RingReader(path) as reader, ring.RingWatcher(path) as watcher:
        for i in range(3):
            writer.put(bytes([i]))
        assert watcher.memory.readonly  # whatever it does
        before = path.read_bytes()
        assert watcher.new() == [b"\0", b"\1", b"\2"]
        assert watcher.new() == []
        assert path.read_bytes() == before
        for i in range(3, 20):  # laps the watcher
            writer.put(bytes([i]))
        assert watcher.new() == [bytes([i]) for i in range(12, 20)]
        assert reader.lost == 0
        assert reader.take() == bytes([12])  # the consumer has its own place, and its own losses
        assert reader.lost == 12


def test_the_newest_living_session_is_found(tmp_path: Path) -> None:
    with pytest.raises(ViewError, match="asc run"):
        newest_ring(tmp_path)
    dead, mine = tmp_path / "asc-gone-4194399", tmp_path / f"asc-my-cell-{os.getpid()}"
    for path in (mine, Path(f"{mine}.wire"), dead):
        path.touch()
    assert newest_ring(tmp_path) == (mine, "my-cell")
