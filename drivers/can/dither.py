"""Rounding that is right on the mean.

Rounding a held torque the same way each cycle leaves a steady error of up to half a step, which a light joint turns
into milliradians. Here the golden ratio's multiples of the sequence number say which neighbour is sent: the mean over
a few cycles is the torque that was meant, and the bytes follow from (torque, sequence) alone: a recording replays.
"""

from __future__ import annotations

import math

GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0


def dithered(value: float, step: float, origin: float, seq: int) -> float:
    """One of the two points origin + k step beside `value`. ValueError: not finite."""
    if not math.isfinite(value):
        raise ValueError(f"torque {value} is not a finite number")
    return origin + step * math.floor((value - origin) / step + seq * GOLDEN % 1.0)
