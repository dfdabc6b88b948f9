"""What a number of trials without an event does, and does not, say about the next one."""

from __future__ import annotations

import math

BISECTIONS = 60


def upper_bound(events: int, trials: int, confidence: float = 0.95) -> float:
    """Exact one-sided (Clopper-Pearson) upper bound of a probability: the p at which no more than `events` in `trials`
    would be seen with probability 1 - confidence. ValueError: counts that cannot be.
    """
    if not 0 <= events <= trials or trials < 1:
        raise ValueError(f"{events} events in {trials} trials")
    if events == trials:
        return 1.0
    low, high = events / trials, 1.0
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        if _at_most(events, trials, middle) > 1.0 - confidence:
            low = middle
        else:
            high = middle
    return high


def _at_most(events: int, trials: int, p: float) -> float:
    """P(X <= events) of a binomial X, 0 < p < 1."""
    total = 0.0
    for k in range(events + 1):
        ways = math.lgamma(trials + 1) - math.lgamma(k + 1) - math.lgamma(trials - k + 1)
        total += math.exp(ways + k * math.log(p) + (trials - k) * math.log1p(-p))
    return total
