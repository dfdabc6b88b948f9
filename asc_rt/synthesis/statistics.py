"""What is kept of millions of samples: counts, histograms with fixed bins, extremes with their states. Mergeable.

Memory does not grow with the number of samples, and merging in the order of the chunks gives the same result whoever
computed them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from asc_rt.core.types import IntVector, Matrix, Vector

BINS_PER_SIDE = 600
# Bin edges grow with the value, 2.4 % per bin, and reach 1e6 on both sides: M and M_dot of any arm fit.
EDGES = np.sinh(np.linspace(-1.0, 1.0, 2 * BINS_PER_SIDE + 1) * np.arcsinh(1e6))


@dataclass(frozen=True, slots=True)
class Extreme:
    value: float
    unit: Vector  # the unit numbers of the state, see draw.realise


@dataclass(slots=True)
class Statistics:
    counts: dict[str, int] = field(default_factory=dict)
    histograms: dict[str, IntVector] = field(default_factory=dict)
    least: dict[str, Extreme] = field(default_factory=dict)
    greatest: dict[str, Extreme] = field(default_factory=dict)

    def count(self, **masks: npt.NDArray[np.bool_]) -> None:
        for name, mask in masks.items():
            self.counts[name] = self.counts.get(name, 0) + int(np.count_nonzero(mask))

    def see(self, name: str, values: Vector, units: Matrix, histogram: bool = False) -> None:
        """`values` of the states in `units`: their extremes and, if asked for, their distribution."""
        if not len(values):
            return
        low, high = int(np.argmin(values)), int(np.argmax(values))
        self._keep(
            name, Extreme(float(values[low]), units[low].copy()), Extreme(float(values[high]), units[high].copy())
        )
        if histogram:
            inside = np.clip(values, EDGES[0], EDGES[-1])
            found = np.histogram(inside, EDGES)[0]
            self.histograms[name] = self.histograms[name] + found if name in self.histograms else found

    def merge(self, other: Statistics) -> None:
        for name, number in other.counts.items():
            self.counts[name] = self.counts.get(name, 0) + number
        for name, found in other.histograms.items():
            self.histograms[name] = self.histograms[name] + found if name in self.histograms else found
        for name in other.least:
            self._keep(name, other.least[name], other.greatest[name])

    def _keep(self, name: str, low: Extreme, high: Extreme) -> None:
        """The first of equals stays."""
        if name not in self.least or low.value < self.least[name].value:
            self.least[name] = low
        if name not in self.greatest or high.value > self.greatest[name].value:
            self.greatest[name] = high


def quantile(histogram: IntVector, share: float) -> float:
    """Upper edge of the bin that the quantile is in."""
    cumulative = np.cumsum(histogram)
    return float(EDGES[1 + int(np.searchsorted(cumulative, share * cumulative[-1]))])


def quantiles(histograms: Mapping[str, IntVector], shares: tuple[float, ...]) -> dict[str, list[float]]:
    return {name: [quantile(found, share) for share in shares] for name, found in histograms.items()}
