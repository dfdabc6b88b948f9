"""What is drawn is what the ranges say, uniformly."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from asc_rt.core.abstraction import separation
from asc_rt.core.stopping import stopping_distance
from asc_rt.synthesis.draw import realise, width
from asc_rt.synthesis.kernel import foot, situation

pytestmark = pytest.mark.timeout(300)


def states(bench: Any, robot: str, tool: str, control: str, count: int, **changes: Any) -> Any:
    model = bench.model(robot, tool, control)
    draw = bench.draw(model, replace(bench.RANGES, **changes), tool_capsules=2 if tool == "drill" else 1)
    n = len(model.arm.bounds.q_min)
    return model, draw, [realise(model.arm, draw, unit) for unit in np.random.default_rng(0).random((count, width(n)))]


def test_the_distance_is_the_drawn_one(bench: Any) -> None:
    model, _, drawn = states(bench, "lrmate_200id", "drill", "acceleration", 300, d_low=0.1, d_high=0.6)
    seen = []
    for s in drawn:
        found = separation(model.chain, model.capsules, s.people, s.q, s.dq, np.inf, 0.0)
        seen.append(found.d[list(found.robot).index(s.capsule)])
    assert np.min(seen) >= 0.1 - 1e-9
    assert np.max(seen) <= 0.6 + 1e-9
    assert np.mean(seen) == pytest.approx(0.35, abs=0.03)


def test_speeds_leave_room_to_stop_and_scale_with_their_share(bench: Any) -> None:
    model, _, drawn = states(bench, "lrmate_200id", "drill", "acceleration", 500, speed_share=1.0)
    b = model.arm.bounds
    for s in drawn:
        assert np.all((b.q_min <= s.q) & (s.q <= b.q_max))
        assert np.all(np.abs(s.dq) <= b.dq_max)
        for q, dq, low, high, A in zip(s.q, s.dq, b.q_min, b.q_max, b.ddq_max, strict=True):
            room = high - q if dq > 0.0 else q - low
            assert stopping_distance(abs(dq), 0.0, A, 1e9) <= room + 1e-6
    _, _, slow = states(bench, "lrmate_200id", "drill", "acceleration", 500, speed_share=0.25)
    np.testing.assert_allclose([s.dq for s in slow], 0.25 * np.array([s.dq for s in drawn]))


def test_the_persons_speed_is_bounded_and_points_everywhere(bench: Any) -> None:
    _, _, drawn = states(bench, "panda", "ee2", "torque", 800, human_speed=1.6)
    velocity = np.array([s.people.v0[0] for s in drawn])
    assert np.linalg.norm(velocity, axis=1).max() <= 1.6
    assert np.linalg.norm(velocity, axis=1).mean() == pytest.approx(0.8, abs=0.05)
    assert np.abs(velocity.mean(axis=0)).max() < 0.1


def test_the_point_is_uniform_on_the_offset_surface(bench: Any) -> None:
    """Share of the points beside the cylinder: its part L / (L + 2 R) of the length of the surface."""
    model, draw, drawn = states(bench, "panda", "ee2", "torque", 4000, d_low=0.1, d_high=0.1000001)
    beside = 0
    for s in drawn:
        t = foot(situation(model.arm, True, s.people, s.q, s.dq, s.capsule), s.people.p0[0])
        beside += 0.0 < t < 1.0
    c = draw.capsules[0]
    length = np.linalg.norm(model.capsules.p1[c] - model.capsules.p0[c])
    reach = 0.1 + model.capsules.radius[c]
    assert beside / 4000 == pytest.approx(length / (length + 2.0 * reach), abs=0.03)


@pytest.mark.parametrize(("tool", "links", "expected"), [
    ("drill", "tool", {"drill.0", "drill.1"}),
    ("bare", "tool", {"j6.6"}),
    ("bare", "all", {"j1.1", "j2.2", "j3.3", "j4.4", "j5.5", "j6.6"}),
])  # fmt: skip
def test_the_links_that_are_sampled(bench: Any, tool: str, links: str, expected: set[str]) -> None:
    model = bench.model("lrmate_200id", tool, "acceleration")
    draw = bench.draw(model, replace(bench.RANGES, links=links), tool_capsules=2 if tool == "drill" else 0)
    assert {model.capsule_names[i] for i in draw.capsules} == expected
    units = np.random.default_rng(0).random((200, width(6)))
    assert {model.capsule_names[realise(model.arm, draw, unit).capsule] for unit in units} == expected


def test_a_fixed_point_stays_where_it_is(bench: Any) -> None:
    _, _, drawn = states(bench, "panda", "ee2", "torque", 5, obstacle=(0.45, 0.1, 0.55))
    for s in drawn:
        np.testing.assert_array_equal(s.people.p0, [[0.45, 0.1, 0.55]])
