"""From sampled figures to the parameter of an index, and the proof that it is feasible where the figures hold.

phi* = d_min^2 - d^2 + k v / M with v = -d_dot. With d_ddot = beta M (beta: `safety_index.BRAKE_SHARE`, the part of M
that one pair counts on) and M falling no faster than rho M,

    phi*_dot = 2 d v - k beta + (k v / M) rho     and on phi* = 0     k v / M = d^2 - d_min^2

so that phi*_dot <= 0 takes k beta >= 2 d v + (d^2 - d_min^2) rho (`k_bound`). Decisions come every T: phi* can be up
to delta above 0 when one is due, delta = T sup phi*_dot of the worst control (d_ddot = -M). In this layer k v / M is
larger by delta and phi* has to fall by eta delta:

    k beta >= 2 d v + (d^2 - d_min^2) rho + (rho + eta) delta,   delta = T (2 d v + k + k v / M rho)

which is linear in k (`k_layer`); it has no solution where M falls by a large share within one period.

phi_b = d_min - d + v^2 / (2 a): phi_b_dot = v (1 - d_ddot / a) <= 0 takes beta M >= a and no rate of M at all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from asc_rt.core.safety_index import BRAKE_SHARE
from asc_rt.core.types import Matrix

Mask = npt.NDArray[np.bool_]

K_MARGIN = 1.01  # the synthesised k is this much above the bound: then phi*_dot < 0, and the proof below ends
CELLS = 24  # along each axis of (d, v, M)
HALVINGS = 5  # of a cell that is undecided
MOST_CELLS = 2_000_000  # undecided ones; more: not proven


@dataclass(frozen=True, slots=True)
class Figures:
    """What the bound is computed from."""

    d_min: float  # m
    d_low: float  # m
    d_high: float  # m
    v_max: float  # m/s
    rho: float  # 1/s, sup of -M_dot / M
    period: float  # s
    eta: float  # 1/s


def k_paper(d_high: float, v_max: float, d_min: float, M_min: float, M_dot: float) -> float | None:
    """2 |d d_dot| + |d_min^2 - d^2| M_dot / M_min at the ends of the ranges; None: M_min is no radius."""
    return 2.0 * d_high * v_max + (d_high**2 - d_min**2) * M_dot / M_min if M_min > 0.0 else None


def k_bound(f: Figures) -> float:
    """Least k of continuous time."""
    return (2.0 * f.d_high * f.v_max + (f.d_high**2 - f.d_min**2) * max(0.0, f.rho)) / BRAKE_SHARE


def k_layer(f: Figures) -> float | None:
    """Least k of decisions every period, with margin; None: there is none."""
    rho, T = max(0.0, f.rho), f.period
    if rho * T >= 1.0:
        return None
    w = (rho + f.eta) * T / (1.0 - rho * T)
    if w >= BRAKE_SHARE:
        return None
    needed = 2.0 * f.d_high * f.v_max + (f.d_high**2 - f.d_min**2) * rho
    return K_MARGIN * needed * (1.0 + w) / (BRAKE_SHARE - w)


def a_bound(M_min: float) -> float | None:
    """Greatest deceleration of phi_b; None: no state's M may be taken for it."""
    return BRAKE_SHARE * M_min if M_min > 0.0 else None


def approach_speed(d: float, d_min: float, k: float, M: float) -> float:
    """Speed on phi* = 0 at distance d, m/s: the greatest that it allows."""
    return max(0.0, d * d - d_min * d_min) * M / k


def stopping_speed(d: float, d_min: float, a: float) -> float:
    """The same on phi_b = 0; a: certified deceleration, m/s2."""
    return math.sqrt(2.0 * a * max(0.0, d - d_min))


@dataclass(frozen=True, slots=True)
class Proof:
    """|B*| = 0 on the whole box of (d, v, M), not on grid points only."""

    cells: int  # looked at
    infeasible: int  # that hold a state in the layer without a control, or could not be decided
    worst: tuple[float, float, float] | None  # (d, v, M) of one of them


def verify(f: Figures, k: float, M_low: float, M_high: float) -> Proof:
    """Every cell of the (d, v, M) grid, by interval bounds; an undecided cell is halved along each axis.

    A cell is fine if it does not meet the layer 0 <= phi* <= delta, or if phi*_dot <= - eta phi* at its worst corner:
    phi*_dot rises with d, v and 1 / M.
    """
    axes = [
        np.linspace(*span, CELLS + 1) for span in ((max(f.d_low, f.d_min), f.d_high), (0.0, f.v_max), (M_low, M_high))
    ]
    low = np.stack(np.meshgrid(*(a[:-1] for a in axes), indexing="ij"), -1).reshape(-1, 3)
    high = np.stack(np.meshgrid(*(a[1:] for a in axes), indexing="ij"), -1).reshape(-1, 3)
    seen = 0
    for _ in range(HALVINGS):
        seen += len(low)
        open_ = _undecided(f, k, low, high)
        low, high = low[open_], high[open_]
        if not len(low):
            return Proof(seen, 0, None)
        certain = _undecided(f, k, low, low) | _undecided(f, k, high, high)  # points: no bounds in between
        if certain.any() or 8 * len(low) > MOST_CELLS:
            break
        low, high = _halve(low, high)
    where = low[0]
    return Proof(seen, len(low), (float(where[0]), float(where[1]), float(where[2])))


def _undecided(f: Figures, k: float, low: Matrix, high: Matrix) -> Mask:
    (d0, v0, M0), (d1, v1, M1) = low.T, high.T
    phi_least = f.d_min**2 - d1 * d1 + k * v0 / M1
    phi_most = f.d_min**2 - d0 * d0 + k * v1 / M0
    rho = max(0.0, f.rho)
    # k v / M is phi + d^2 - d_min^2: the smaller of the two upper bounds, since a cell is wider than the layer
    delta = f.period * (2.0 * d1 * v1 + k + (d1 * d1 - f.d_min**2) * rho) / (1.0 - f.period * rho)
    term = np.minimum(k * v1 / M0, d1 * d1 - f.d_min**2 + delta)
    in_layer = (phi_least <= delta) & (phi_most >= 0.0) & (v1 > 0.0)
    worst = 2.0 * d1 * v1 - BRAKE_SHARE * k + term * rho + f.eta * np.minimum(delta, np.maximum(0.0, phi_most))
    return in_layer & (worst > 0.0)


def _halve(low: Matrix, high: Matrix) -> tuple[Matrix, Matrix]:
    size = 0.5 * (high - low)
    corners = np.stack(np.meshgrid((0.0, 1.0), (0.0, 1.0), (0.0, 1.0), indexing="ij"), -1).reshape(-1, 3)
    low = (low[:, None, :] + corners[None] * size[:, None, :]).reshape(-1, 3)
    return low, low + np.repeat(size, 8, axis=0)


# --- coverage --------------------------------------------------------------------------------------------------------


def union_bound(samples: int, share: float, events: int) -> float:
    """Confidence that each of `events` sampled extremes covers `share` of the states: 1 - events share^N.

    The extremes come from the same samples, so their failures are not independent: the union bound, not a product. All
    of them hold together for 1 - events (1 - share) of the states.
    """
    return max(0.0, -math.expm1(math.log(events) + samples * math.log(share))) if samples else 0.0


def paper_confidence(samples: int, share: float) -> float:
    """(1 - share^N)^3, as the paper claims for M_min, M_max and M_dot as if they were independent."""
    return float((1.0 - share**samples) ** 3)


def least_share(good: int, total: int, doubt: float) -> float:
    """Lower end of the exact (Clopper-Pearson) interval of a share: `good` of `total`; wrong by at most `doubt`."""
    if total == 0 or good == 0:
        return 0.0
    if good == total:
        return float(doubt ** (1.0 / total))
    low, high = 0.0, good / total
    for _ in range(60):
        middle = 0.5 * (low + high)
        if _at_least(good, total, middle) < doubt:
            low = middle
        else:
            high = middle
    return low


def _at_least(good: int, total: int, share: float) -> float:
    """P(successes >= good): its few failures summed, 0 .. total - good."""
    bad, log_q = total - good, math.log1p(-share)
    terms = [
        math.lgamma(total + 1) - math.lgamma(i + 1) - math.lgamma(total - i + 1)
        + i * log_q + (total - i) * math.log(share)
        for i in range(bad + 1)
    ]  # fmt: skip
    top = max(terms)
    return math.exp(top + math.log(math.fsum(math.exp(t - top) for t in terms)))
