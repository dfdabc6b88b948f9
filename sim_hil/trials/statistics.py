"""What a number of trials says, and does not say, about the next one; and two policies on the same draws.

scipy.stats is imported where it is used: it takes longer than all else that a command needs before its first word.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

CONFIDENCE = 0.95


def upper_bound(events: int, trials: int) -> float:
    """Exact one-sided (Clopper-Pearson) upper bound of a probability: the p at which no more than `events` in `trials`
    would be seen with probability 1 - CONFIDENCE. ValueError: counts that cannot be.
    """
    from scipy import stats

    if not 0 <= events <= trials or trials < 1:
        raise ValueError(f"{events} events in {trials} trials")
    return float(stats.binomtest(events, trials, alternative="less").proportion_ci(CONFIDENCE, "exact").high)


def paired_events(ours: Sequence[bool], other: Sequence[bool]) -> dict[str, Any]:
    """Did something happen in more draws with one policy than with the other? Exact McNemar test: under "no difference"
    each draw that differs falls either way with probability one half.
    """
    from scipy import stats

    only_ours = sum(a and not b for a, b in zip(ours, other, strict=True))
    only_other = sum(b and not a for a, b in zip(ours, other, strict=True))
    differing = only_ours + only_other
    p = float(stats.binomtest(only_ours, differing).pvalue) if differing else 1.0
    return {"only_asc": only_ours, "only_other": only_other, "p": p}


def paired_median(ours: Sequence[float], other: Sequence[float]) -> dict[str, Any] | None:
    """Median over the draws of (other - ours), with the p of "no difference" by Wilcoxon's signed ranks; None: there is
    no draw with both figures.
    """
    from scipy import stats

    difference = np.subtract(other, ours)
    if not len(difference):
        return None
    p = float(stats.wilcoxon(difference).pvalue) if np.any(difference) else 1.0
    return {"draws": len(difference), "median": float(np.median(difference)), "p": p}
