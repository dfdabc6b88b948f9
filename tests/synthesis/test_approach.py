"""The table of allowed approach speeds lies on phi = 0, and says what the paper's k costs."""

from __future__ import annotations

import pytest

from asc_rt.synthesis.approach import DISTANCES, table
from asc_rt.synthesis.synthesis import approach_speed, stopping_speed

pytestmark = pytest.mark.timeout(300)


@pytest.mark.parametrize(("d", "d_min", "k", "M"), [(0.3, 0.05, 133.31, 67.0), (0.1, 0.05, 5.0, 12.0)])
def test_the_speeds_lie_on_phi_0(d: float, d_min: float, k: float, M: float) -> None:
    v = approach_speed(d, d_min, k, M)
    assert d_min**2 - d**2 + k * v / M == pytest.approx(0.0, abs=1e-12)
    v = stopping_speed(d, d_min, M)
    assert d_min - d + v * v / (2.0 * M) == pytest.approx(0.0, abs=1e-12)


def test_nobody_may_approach_inside_d_min() -> None:
    assert approach_speed(0.04, 0.05, 1.0, 9.0) == stopping_speed(0.04, 0.05, 9.0) == 0.0


def test_a_smaller_k_and_phi_b_let_the_robot_work() -> None:
    rows = {row["index"]: row for row in table(2000)}
    assert all(len(row["v"]) == len(DISTANCES) and row["v"] == sorted(row["v"]) for row in rows.values())
    at_03 = {name: row["v"][2] for name, row in rows.items()}
    assert at_03["phi*, k of the trials, M median"] > 20 * at_03["phi*, k printed in the paper, M median"]
    assert at_03["phi_b, a = 1 % of M"] > at_03["phi*, k printed in the paper, M 1 %"]
