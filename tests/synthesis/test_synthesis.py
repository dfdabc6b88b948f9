"""k by formula and on the grid, coverage by the union bound."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import beta

from asc_rt.core.safety_index import BRAKE_SHARE
from asc_rt.synthesis import synthesis
from asc_rt.synthesis.synthesis import (
    Figures,
    approach_speed,
    k_bound,
    k_layer,
    k_paper,
    least_share,
    paper_confidence,
    union_bound,
    verify,
)

FIGURES = Figures(d_min=0.05, d_low=0.05, d_high=0.8, v_max=1.0, rho=60.0, period=0.001, eta=1.0)


def test_the_papers_formula_gives_the_erratas_figures() -> None:
    """132.41 for the paper's own row, not its 133.31 (errata 12)."""
    table = ((4.13, 847.42, 132.41), (4.53, 710.97, 101.65), (3.82, 856.18, 144.48), (3.26, 891.80, 175.99))
    for M_min, M_dot, k in table:
        assert k_paper(0.8, 1.0, 0.05, M_min, M_dot) == pytest.approx(k, abs=0.01)
    assert k_paper(0.8, 1.0, 0.05, -1.0, 800.0) is None
    assert k_paper(0.8, 1.0, 0.05, 0.0, 800.0) is None


def phi_dot(f: Figures, k: float, d: float, v: float, M: float) -> float:
    """Greatest rate of phi* with d_ddot = beta M and M falling as fast as it may."""
    return 2.0 * d * v - k * BRAKE_SHARE + k * v / M * f.rho


@settings(max_examples=200, deadline=None)
@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0), st.floats(0.0, 300.0), st.floats(0.05, 0.5))
def test_the_bound_is_feasible_on_phi_and_is_the_least_that_is(x: float, y: float, rho: float, d_min: float) -> None:
    f = replace(FIGURES, d_min=d_min, d_low=d_min, rho=rho)
    k = k_bound(f)
    d, v = d_min + x * (f.d_high - d_min), max(1e-6, y * f.v_max)
    M = k * v / max(1e-12, d * d - d_min * d_min)  # on phi* = 0
    assert phi_dot(f, k, d, v, M) <= 1e-9
    M = 0.99 * k * f.v_max / (f.d_high**2 - d_min**2)
    assert phi_dot(f, 0.99 * k, f.d_high, f.v_max, M) > 0.0


def test_the_layer_costs_little_at_1_kHz_and_everything_when_M_falls_faster_than_decisions_come() -> None:
    k = k_layer(FIGURES)
    assert k is not None
    assert k_bound(FIGURES) < k < 1.3 * k_bound(FIGURES)
    assert k_layer(replace(FIGURES, period=1e-9)) == pytest.approx(1.01 * k_bound(FIGURES), rel=1e-4)
    assert k_layer(replace(FIGURES, period=0.008)) is None
    assert k_layer(replace(FIGURES, rho=1500.0)) is None


@pytest.mark.parametrize("rho", [0.0, 5.0, 60.0, 200.0])
@pytest.mark.parametrize("period", [0.001, 0.002])
def test_no_cell_is_infeasible_at_the_synthesised_k_and_some_are_below(rho: float, period: float) -> None:
    f = replace(FIGURES, rho=rho, period=period)
    k = k_layer(f)
    if k is None:
        return
    proof = verify(f, k, 4.0, 130.0)
    assert (proof.infeasible, proof.worst) == (0, None)
    assert proof.cells >= 24**3
    if rho > 0.0:
        wrong = verify(f, 0.8 * k_bound(f), 4.0, 130.0)
        assert wrong.infeasible > 0
        assert wrong.worst is not None


@pytest.mark.parametrize(("cells", "halvings"), [(24, 5), (2, 1), (3, 2)])
def test_the_proof_holds_against_points_drawn_at_random(
    cells: int, halvings: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where verify() finds nothing no point of the box is infeasible, however coarse its cells."""
    monkeypatch.setattr(synthesis, "CELLS", cells)
    monkeypatch.setattr(synthesis, "HALVINGS", halvings)
    rng = np.random.default_rng(0)
    refuted = 0
    for i in range(120):
        d_min = float(rng.uniform(0.05, 0.3))
        rho = float(rng.uniform(0.0, 2.0 if i % 2 else 80.0))
        f = replace(FIGURES, rho=rho, d_min=d_min, d_low=d_min)
        k = float(rng.uniform(0.5, 1.6)) * k_bound(f)
        M_low = float(rng.uniform(0.3, 1.2)) * k * f.v_max / (f.d_high**2 - d_min**2)  # phi* = 0 near the far corner
        M_high = M_low * float(rng.uniform(1.05, 4.0))
        d = rng.uniform(f.d_min, f.d_high, 20_000)
        v = rng.uniform(0.0, f.v_max, 20_000)
        M = np.clip(k * v / (d * d - f.d_min**2 + rng.uniform(0.0, 0.01, 20_000)), M_low, M_high)  # near the layer
        phi = f.d_min**2 - d * d + k * v / M
        delta = f.period * (2.0 * d * v + k + k * v / M * f.rho)
        bad = (phi >= 0.0) & (phi <= delta) & (2.0 * d * v - BRAKE_SHARE * k + k * v / M * f.rho + f.eta * phi > 0.0)
        refuted += bad.any()
        assert not (bad.any() and verify(f, k, M_low, M_high).infeasible == 0)
    assert 20 < refuted < 120


def test_the_discrete_loop_stays_out_of_d_min_with_the_layers_k() -> None:
    """An abstract system at the worst of its figures, decided every period: phi* never passes its layer."""
    f = replace(FIGURES, rho=20.0)
    k = k_layer(f)
    assert k is not None
    rng = np.random.default_rng(1)
    for _ in range(50):
        d, v, M, worst = 0.7, 0.0, float(rng.uniform(5.0, 100.0)), 0.0
        for _ in range(4000):
            phi = f.d_min**2 - d * d + k * v / M
            worst = max(worst, phi)
            a = -BRAKE_SHARE * M if phi >= 0.0 else min(M, (f.v_max - v) / f.period)
            M_dot = -f.rho * M * rng.random() if M > 4.5 else f.rho * M
            d, v, M = d - f.period * v, max(0.0, v + f.period * a), M + f.period * M_dot
            assert d >= f.d_min - 1e-9
        assert worst <= f.period * (2.0 * f.d_high * f.v_max + k + f.d_high**2 * f.rho) * 2.0


def test_coverage() -> None:
    assert union_bound(100_000, 0.9999, 2) == pytest.approx(1.0 - 2.0 * 0.9999**100_000)
    assert union_bound(100_000, 0.9999, 3) == pytest.approx(0.99986, abs=1e-5)  # errata 14
    assert union_bound(149_134, 0.9999, 3) >= 1.0 - 1e-6
    assert union_bound(10, 0.9999, 2) == 0.0
    assert paper_confidence(100_000, 0.9999) == pytest.approx((1.0 - 0.9999**100_000) ** 3)


@pytest.mark.parametrize(("good", "total"), [(10, 10), (990, 1000), (50_000, 50_010), (1, 5), (999, 1000)])
def test_the_share_is_clopper_and_pearsons(good: int, total: int) -> None:
    for doubt in (1e-6, 1e-3, 0.05):
        assert least_share(good, total, doubt) == pytest.approx(beta.ppf(doubt, good, total - good + 1), rel=1e-7)


def test_nothing_seen_is_nothing_known() -> None:
    assert least_share(0, 0, 1e-6) == 0.0
    assert least_share(0, 9, 1e-6) == 0.0


def test_the_papers_k_creeps() -> None:
    assert approach_speed(0.3, 0.05, 133.31, 67.0) == pytest.approx(0.044, abs=5e-4)
