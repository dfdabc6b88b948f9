"""Frames out of a file, played as a camera sends them: in their order, at their recorded distances, then silence.

The first one is taken when it is first asked for; the others follow by their stamps. Who asks late gets old frames, and
their age says so. What is missing between two of them is missing in their numbers, too.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import NamedTuple

from drivers.cameras.base import Depth, DepthFrame


class Shot(NamedTuple):
    t_device_ns: int  # as it was recorded
    depth: Depth


class Replay:
    def __init__(self, shots: Iterator[Shot], period_ns: int) -> None:
        """`shots` may raise what DepthCamera.read() may; then it is over."""
        self._shots, self._period_ns = shots, period_ns
        self._next: Shot | None = None
        self._offset_ns: int | None = None  # from the recorded clock to ours
        self._last_ns, self._seq = 0, 0

    def read(self, deadline_ns: int) -> DepthFrame | None:
        """As DepthCamera.read()."""
        if self._next is None:
            self._next = next(self._shots, None)
        shot = self._next
        if shot is None or self._due_ns(shot) > deadline_ns:
            _sleep_until(deadline_ns)
            return None
        due_ns = self._due_ns(shot)
        _sleep_until(due_ns)
        self._next = None
        self._count(shot.t_device_ns)
        return DepthFrame(shot.depth, due_ns, 0, shot.t_device_ns, time.monotonic_ns(), self._seq)

    def _due_ns(self, shot: Shot) -> int:
        if self._offset_ns is None:
            self._offset_ns = time.monotonic_ns() - shot.t_device_ns
        return shot.t_device_ns + self._offset_ns

    def _count(self, t_device_ns: int) -> None:
        """Files hold no numbers of the device: the stamps tell how many periods have passed."""
        passed = round((t_device_ns - self._last_ns) / self._period_ns) if self._seq else 1
        self._seq, self._last_ns = self._seq + max(passed, 1), t_device_ns


def _sleep_until(t_ns: int) -> None:
    time.sleep(max(t_ns - time.monotonic_ns(), 0) * 1e-9)
