"""The running cell, seen from a process of its own: it looks into the session's ring and never touches the loop."""

from __future__ import annotations

import contextlib
import os
import socket
import time
from pathlib import Path

import numpy as np
import rerun as rr

from asc_rt.core.params import Params
from asc_rt.record import RecordLayout
from asc_rt.ring import RingWatcher
from logs.view_columns import Canvas, Records, in_blocks, new_recording
from logs.view_events import Chronicle, draw_events
from logs.view_layout import layout
from logs.view_process import (
    HOST,
    ViewError,
    address,
    browser_arguments,
    free_port,
    need_display,
    viewer,
    wait_for,
)

FRAME_S = 1.0 / 30.0  # of rest between two looks, so never more than 30 in a second
SCENE_STRIDE = 4  # cycles for one step of the scene: 31 Hz at 125 Hz
NICENESS = 10  # whatever has to be on time comes first


def newest_ring(folder: Path = Path("/dev/shm")) -> tuple[Path, str]:
    """The ring of the session that was started last, and the name of its cell. ViewError: none is running."""
    found = [p for p in folder.glob("asc-*-*") if p.suffix != ".wire" and _runs(p.name.rpartition("-")[2])]
    if not found:
        raise ViewError("no cell is running: start one with `asc run`")
    path = max(found, key=lambda p: p.stat().st_mtime_ns)
    return path, path.name.removeprefix("asc-").rpartition("-")[0]


def _runs(pid: str) -> bool:
    return Path("/proc", pid).is_dir() if pid.isdigit() else False


def live(params: Params, ring: Path, web: bool = False) -> None:
    """Show the session of `ring` until the viewer is closed or Ctrl-C. `params`: of its cell.

    ViewError: no display; the ring is of another robot. RingError: no ring.
    """
    if not web:
        need_display("--web")
    os.nice(NICENESS)
    dtype = RecordLayout(params.n).dtype
    port = free_port()
    with RingWatcher(ring) as watcher:
        if watcher.slot_size != dtype.itemsize:
            raise ViewError(f"{ring}: the session of another robot: name its cell")
        with viewer("--port", str(port), *(browser_arguments(port) if web else [])) as running:
            wait_for(lambda: _listens(port), running)
            recording = new_recording(ring.name)
            recording.connect_grpc(address(port))
            recording.send_blueprint(layout(params, session_s=None))
            painter = Painter(recording, params, dtype)
            with contextlib.suppress(KeyboardInterrupt):
                while running.process.poll() is None:
                    painter.paint(watcher.new())
                    time.sleep(FRAME_S)


class Painter:
    """Draws records as they come in."""

    def __init__(self, recording: rr.RecordingStream, params: Params, dtype: np.dtype[np.void]) -> None:
        self._recording, self._params, self._dtype = recording, params, dtype
        self._last: Records = np.zeros(0, dtype)  # waits for the cycle after it
        self._canvas: Canvas | None = None

    def paint(self, payloads: list[memoryview]) -> None:
        """All of them but the newest, which is drawn together with the next ones."""
        if not payloads:
            return
        records = np.concatenate([self._last, np.frombuffer(b"".join(payloads), self._dtype)])
        if self._canvas is None:
            first = records[0]  # the session may have begun long before we looked
            t0_ns = int(first["inputs.t_ns"]) - int(first["inputs.tick"]) * self._params.period_ns
            self._canvas = Canvas(self._recording, self._params, t0_ns, SCENE_STRIDE)
            self._chronicle = Chronicle(self._canvas)
        for block in in_blocks([records]):
            if len(block) > 1:
                self._canvas.draw(block[:-1], block[1:])
                draw_events(self._canvas, self._chronicle.draw(block[:-1], block[1:]))
        self._last = records[-1:]


def _listens(port: int) -> bool | None:
    with contextlib.suppress(OSError), socket.create_connection((HOST, port), timeout=1.0):
        return True
    return None
