"""The verdict: what is certified, what is refused and with which figure."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from asc_rt.core.robot_model import ModelError
from asc_rt.synthesis import synthesis
from asc_rt.synthesis.certificate import Index
from asc_rt.synthesis.certify import certify

pytestmark = pytest.mark.timeout(300)


def test_the_papers_set_is_proven_for_the_synthesised_k(bench: Any) -> None:
    """Torque box alone, person standing: M+ stays away from 0, k follows from its rate, nothing is infeasible."""
    made = bench.result(ranges=bench.PAPER_LIKE, samples=8000).certificate
    assert made.certified
    assert made.proven
    assert made.sampled.M_min > 5.0
    assert made.sampled.ball_min <= made.sampled.M_min
    f = synthesis.Figures(0.05, 0.05, 0.8, 1.0, made.sampled.rho, 0.001, 1.0)
    assert made.k == made.k_layer == synthesis.k_layer(f)
    assert made.k_bound == synthesis.k_bound(f) < made.k
    assert made.boundary.feasible == made.boundary.states > 1000


def test_a_smaller_k_is_not_proven(bench: Any) -> None:
    made = bench.result(ranges=bench.PAPER_LIKE, samples=8000, k=20.0).certificate
    assert made.k == 20.0
    assert not made.proven
    assert any("k = 20 is under" in note for note in made.notes)


def test_with_joint_limits_a_share_of_the_states_is_certified(bench: Any) -> None:
    made = bench.result(required=0.9, period=0.02).certificate
    assert made.k_layer is None
    assert made.k in (1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0, 30.0, 50.0, 80.0, 130.0)
    assert made.certified
    assert not made.proven
    assert 0.9 <= made.boundary.least_share < made.boundary.feasible / made.boundary.states
    assert any("no parameter is enough for the worst case" in note for note in made.notes)


def test_too_few_feasible_states_refuse_with_the_figures(bench: Any) -> None:
    made = bench.result(required=0.99999).certificate
    assert not made.certified
    (reason,) = made.reasons
    assert f"{made.boundary.states - made.boundary.feasible} of {made.boundary.states} states" in reason
    assert "0.99999 is required" in reason


def test_phi_b_is_certified_by_M_alone(bench: Any) -> None:
    made = bench.result(index=Index.PHI_B, ranges=bench.PAPER_LIKE, samples=8000).certificate
    assert made.certified
    assert made.proven
    assert made.k is not None
    assert made.k == pytest.approx(0.8 * made.sampled.M_min, rel=0.3)  # of the covered states
    assert (made.k_paper, made.k_bound, made.boundary.feasible) == (None, None, made.boundary.states)
    greedy = bench.result(index=Index.PHI_B, ranges=bench.PAPER_LIKE, samples=8000, k=300.0).certificate
    assert not greedy.proven
    assert not greedy.certified


def test_nothing_covered_is_refused(bench: Any) -> None:
    made = bench.result(M_floor=1e5).certificate
    assert (made.certified, made.k) == (False, None)
    assert "no approaching state has M above its floor" in made.reasons[0]


def test_a_robot_without_efforts_has_no_torque_level(bench: Any) -> None:
    with pytest.raises(ModelError, match="torque control needs a torque limit"):
        certify(bench.request("lrmate_200id", "drill", "torque"))


def test_the_same_request_gives_the_same_certificate(bench: Any) -> None:
    one, two = (certify(bench.request(samples=1000, k=5.0)).certificate for _ in range(2))
    assert one == two
    assert certify(bench.request(samples=1000, k=5.0, seed=8)).certificate != one


def test_a_moving_person_makes_M_smaller_and_its_fall_faster(bench: Any) -> None:
    standing = replace(bench.RANGES, human_speed=0.0, human_acceleration=0.0)
    calm = bench.result(ranges=standing, k=5.0).certificate.sampled
    lively = bench.result(ranges=replace(standing, human_speed=2.0, human_acceleration=5.0), k=5.0).certificate.sampled
    assert lively.M_min < calm.M_min - 1.0
    assert lively.falling_max > calm.falling_max
