"""A device's clock seen from ours."""

from __future__ import annotations

SIGMA_NS = 5_000_000  # ASSUMED: what the jitter of USB or of a switch leaves of a mapped stamp


class ForeignClock:
    """Maps device stamps by the lower envelope of (arrival - stamp), less the least latency of the device.

    The frame that travelled fastest tells the offset; one that was held up cannot make itself younger. Until a fast one
    has come, frames seem older than they are by its delay, which errs on the safe side.
    """

    def __init__(self, latency_ns: int) -> None:
        self._latency_ns = latency_ns
        self._offset_ns: int | None = None

    def capture_ns(self, t_device_ns: int, t_arrival_ns: int) -> int:
        """When, on our clock, the device's clock said `t_device_ns`."""
        offset_ns = t_arrival_ns - t_device_ns - self._latency_ns
        self._offset_ns = offset_ns if self._offset_ns is None else min(self._offset_ns, offset_ns)
        return t_device_ns + self._offset_ns
