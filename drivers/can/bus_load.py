"""How much of the bus a cycle takes in the worst case, stuff bits and inter-frame space included.

Lengths in bits, ISO 11898-1. Classic, n data bytes: 47 + 8n with 11-bit identifiers (67 + 8n with 29), and one stuff
bit for every four bits between start of frame and CRC. FD: 34 bits at the nominal rate; at the data rate 5 + 8n bits
with their stuff bits, then stuff count, CRC and the fixed stuff bits of both.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

LIMIT = 0.8  # ASSUMED: above it errors and repeats leave no room for a cycle to be on time
FD_LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)
FD_NOMINAL_BITS = 34


@dataclass(frozen=True, slots=True)
class FrameSize:
    """One frame of the cycle as the wire sees it. ValueError: no frame has this length."""

    length: int  # data bytes
    is_fd: bool = False
    switches_rate: bool = False  # BRS: the data phase runs at the data rate
    is_extended: bool = False  # 29-bit identifier

    def __post_init__(self) -> None:
        if self.length not in (FD_LENGTHS if self.is_fd else range(9)):
            raise ValueError(f"no CAN{' FD' if self.is_fd else ''} frame has {self.length} data bytes")
        if self.switches_rate and not self.is_fd:
            raise ValueError("only a CAN FD frame switches the bit rate")
        if self.is_fd and self.is_extended:
            raise ValueError("CAN FD frames with 29-bit identifiers are not in the formulas")

    def seconds(self, bitrate: float, data_bitrate: float) -> float:
        """Longest time on the wire."""
        if not self.is_fd:
            header, stuffed = (67, 53) if self.is_extended else (47, 33)
            return (header + 8 * self.length + (stuffed + 8 * self.length) // 4) / bitrate
        before_crc = 5 + 8 * self.length
        crc = 4 + (17 if self.length <= 16 else 21)  # with the stuff count
        data_bits = before_crc + before_crc // 4 + crc + 1 + crc // 4
        return FD_NOMINAL_BITS / bitrate + data_bits / (data_bitrate if self.switches_rate else bitrate)


class BusOverload(ValueError):
    """The cycle does not fit the bus."""

    def __init__(self, load: float, period_s: float) -> None:
        super().__init__(
            f"the cycle of {period_s * 1e3:g} ms takes {load:.0%} of the bus in the worst case, at most {LIMIT:.0%}; "
            "a longer period, fewer axes on this bus, or CAN FD"
        )
        self.load = load


def load(frames: Iterable[FrameSize], period_s: float, bitrate: float, data_bitrate: float = 0.0) -> float:
    """Share of the period that `frames` take in the worst case; above 1: they do not fit."""
    return sum(frame.seconds(bitrate, data_bitrate) for frame in frames) / period_s


def check(frames: Iterable[FrameSize], period_s: float, bitrate: float, data_bitrate: float = 0.0) -> float:
    """The load. BusOverload: more than LIMIT."""
    share = load(frames, period_s, bitrate, data_bitrate)
    if share > LIMIT:
        raise BusOverload(share, period_s)
    return share
