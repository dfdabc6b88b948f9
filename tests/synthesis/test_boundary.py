"""States pulled onto phi = 0: they are there, and the verdict is that of a brute-force linear program."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import linprog

from asc_rt.core.safety_index import phi_star
from asc_rt.synthesis import boundary as b
from asc_rt.synthesis import kernel
from asc_rt.synthesis.draw import realise, width

pytestmark = pytest.mark.timeout(300)
K, D_MIN, FLOOR = 3.0, 0.1, 0.3


def pulled(bench: Any, count: int, k: float = K, stopping: bool = False, **changes: Any) -> Any:
    model = bench.model("lrmate_200id", "drill", "acceleration")
    ranges = replace(bench.RANGES, d_low=D_MIN, d_high=1.0, **changes)
    draw = bench.draw(model, ranges, tool_capsules=2)
    units = np.random.default_rng(1).random((count, width(6)))
    return model, draw, units, b.pull_all(model.arm, draw, units, k, D_MIN, FLOOR, stopping)


def test_every_kind_of_state_occurs(bench: Any) -> None:
    found = np.vstack([pulled(bench, 2000, k=12.0)[-1], pulled(bench, 2000, k=4.0, stopping=True)[-1]])
    assert {b.ON_BOUNDARY, b.RETREATING, b.UNREACHED, b.UNDER_FLOOR} == set(found[:, b.STATUS])


def test_pulled_states_are_on_phi_star(bench: Any) -> None:
    found = pulled(bench, 1000)[-1]
    on = found[found[:, b.STATUS] == b.ON_BOUNDARY]
    assert len(on) > 200
    for row in on:
        phi = phi_star(row[b.DISTANCE], row[b.SPEED], row[b.M], D_MIN, K)
        assert phi == pytest.approx(0.0, abs=1e-6)
        assert D_MIN < row[b.DISTANCE] <= 1.0
        assert row[b.M] > FLOOR


def test_pulled_states_are_on_phi_b_and_feasible_where_M_reaches_a(bench: Any) -> None:
    a = 4.0
    found = pulled(bench, 2000, k=a, stopping=True)[-1]
    on = found[found[:, b.STATUS] == b.ON_BOUNDARY]
    np.testing.assert_allclose(D_MIN - on[:, b.DISTANCE] + on[:, b.SPEED] ** 2 / (2.0 * a), 0.0, atol=1e-9)
    np.testing.assert_allclose(on[:, b.MARGIN], on[:, b.M] - a)
    assert 0.0 < (on[:, b.MARGIN] >= 0.0).mean() < 1.0


def test_the_margin_is_the_best_decrease_of_phi_over_all_controls(bench: Any) -> None:
    """phi* along the motion by differences of the kernel's own M at the pulled state, for the vertices of U."""
    model, draw, units, found = pulled(bench, 4000)
    given, arm = draw.given, model.arm
    checked = infeasible = 0
    worst_first = np.argsort(np.where(found[:, b.STATUS] == b.ON_BOUNDARY, found[:, b.MARGIN], np.inf))
    for i in np.concatenate((worst_first[:30], worst_first[500:530])):
        row, s = found[i], realise(arm, draw, units[i])
        d, v, M = row[b.DISTANCE], row[b.SPEED], row[b.M]
        here = kernel.situation(arm, True, s.people, s.q, s.dq, s.capsule)
        people = b.moved_to(here, s.people, arm.capsules.radius[s.capsule], d)
        there = kernel.situation(arm, True, people, s.q, s.dq, s.capsule)
        later = kernel.shifted(arm, True, people, s.q, s.dq, s.capsule, kernel.STEP)
        r = kernel.radius(arm, given, people, s.q, s.dq, s.capsule, there, later, 1.0, kernel.best(there.C, there))
        assert r.value == pytest.approx(M, abs=1e-6)

        def phi_dot(u: Any, d: Any = d, v: Any = v, M: Any = M, there: Any = there, r: Any = r) -> float:
            d_ddot = there.C @ u + there.drift - given.human_acceleration
            return float(2.0 * d * v - K * d_ddot / M - K * v * (r.rate - r.spread + r.g @ u) / M**2)

        cost = -K * there.C / M - K * v * r.g / M**2
        best = linprog(cost, bounds=list(zip(there.U.lower, there.U.upper, strict=True)))
        assert row[b.MARGIN] == pytest.approx(-phi_dot(best.x), rel=1e-4, abs=1e-3)
        checked += 1
        infeasible += row[b.MARGIN] < 0.0
    assert checked == 60
    assert 0 < infeasible < 60


def test_states_in_which_the_robot_does_not_approach_are_left_out(bench: Any) -> None:
    model, draw, units, found = pulled(bench, 1000, human_speed=2.0)
    for row, unit in zip(found, units, strict=True):
        s = realise(model.arm, draw, unit)
        here = kernel.situation(model.arm, True, s.people, s.q, s.dq, s.capsule)
        assert (row[b.STATUS] == b.RETREATING) == (here.d_dot >= 0.0 or here.d_dot_robot >= 0.0)
