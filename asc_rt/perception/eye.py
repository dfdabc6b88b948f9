"""One camera of the cell: what its frames are worth now, and when they were last used."""

from __future__ import annotations

from asc_rt.perception.grid import View
from asc_rt.perception.stance import LIMIT, Stance
from drivers.cameras.base import CameraInfo, Depth, DepthFrame
from drivers.cameras.watch import CameraFault, Watch, moved

__all__ = ["CameraFault", "CameraInfo", "DepthFrame", "Eye"]

GOOD_AGAIN = 15  # frames in order, one after another, until a camera that was wrong is believed


class Eye:
    """Pure: frames and times come from outside. It is not believed before it has shown GOOD_AGAIN good frames."""

    def __init__(
        self, name: str, info: CameraInfo, view: View, offset_ns: int = 0, stance: Stance | None = None
    ) -> None:
        """`offset_ns`: the arm's clock ahead of the camera's stamps; `stance`: None: only large moves are found."""
        self.name, self.info, self.view, self.offset_ns = name, info, view, offset_ns
        self.fault = CameraFault.SILENT
        self._watch, self._good, self._stance = Watch(info), 0, stance
        self._used_ns: int | None = None

    @property
    def is_believed(self) -> bool:
        return not self.fault

    def look(self, frame: DepthFrame) -> Depth | None:
        """Its picture; None: it is not to be believed."""
        found = self._watch.look(frame)
        if not found & CameraFault.COVERED and self._has_moved(frame.depth):
            found |= CameraFault.MOVED
        self._judge(found)
        if self.is_believed and self._used_ns is None:
            self._used_ns = frame.t_arrival_ns
        return frame.depth if self.is_believed else None

    def _has_moved(self, depth: Depth) -> bool:
        shift = None if self._stance is None else self._stance.shift(depth)
        return (shift is not None and shift > LIMIT) or moved(depth, self.view.background)

    def used(self, t_arrival_ns: int) -> None:
        """A picture of it went into what is told of people."""
        self._used_ns = t_arrival_ns

    def wait(self, now_ns: int) -> None:
        """Time passes. A camera whose pictures are not used, for whatever reason, is as good as none."""
        if self._used_ns is not None and now_ns - self._used_ns > self._watch.longest_silence_ns:
            self._judge(CameraFault.SILENT)

    def _judge(self, found: CameraFault) -> None:
        self._good = 0 if found else self._good + 1
        if found:
            self.fault, self._used_ns = self.fault | found, None
        elif self._good >= GOOD_AGAIN:
            self.fault = CameraFault(0)
