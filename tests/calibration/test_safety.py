"""From the error bars of a calibration to the distance that the robot keeps: in lockstep, judged on the truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from asc_rt import human_state_pb2 as pb
from asc_rt.core.system import System
from asc_rt.core.types import HumanState
from calibration.geometry import inverse, perturb, pose
from calibration.result import Result, pose_value, rows
from sim_hil.calibration_cell import LOOKING
from sim_hil.human import HumanOptions, HumanSource
from sim_hil.person import Person
from sim_hil.trials import episode
from sim_hil.trials.judge import Outcome
from sim_hil.trials.sensing import Ball, message
from sim_hil.trials.suites import LRMATE_GOALS
from sim_hil.trials.systems import TrialSystem
from sim_hil.trials.tasks import Rounds

SYSTEM = TrialSystem("lrmate_200id", "drill", 3.0, control="acceleration")
T_BASE_CAM = pose(LOOKING, np.array([2.0, 0.0, 0.6]))
BALL = Ball(np.array([0.62, 0.0, 0.45]), 0.1)


def calibrated(millimetres: float, milliradians: float) -> Result:
    C = np.diag([(1e-3 * millimetres) ** 2] * 3 + [(1e-3 * milliradians) ** 2] * 3)
    return Result("hand-eye", "T_base_cam", pose_value(T_BASE_CAM), rows(C), "test")


@dataclass(frozen=True, slots=True)
class Seen:
    """The ball through a camera that stands `sigmas` beside where its calibration says it does."""

    calibration: Result
    sigmas: np.ndarray  # (6,)
    states_bound: bool = True

    def at(self, t: float) -> tuple[HumanState, float]:
        truth = perturb(self.calibration.pose(), self.sigmas * self.calibration.sigma)
        ball = BALL.at(t)
        moved = self.calibration.pose() @ inverse(truth) @ [*ball.p0[0], 1]
        seen = ball._replace(p0=moved[None, :3], p1=moved[None, :3])
        said = message(1 + round(t * 1000), t, seen, 0.0, 0.0)
        if self.states_bound:
            bounds = self.calibration.capsule_bounds(seen.p0, seen.p1, seen.radius)
            said = replace(said, position_bound=bounds)
        return said, 0.0


def kept(sensor: Seen) -> Outcome:
    system = System(SYSTEM.params())
    start = LRMATE_GOALS[1] + [-0.5, 0, 0, 0, 0, 0]
    setup = episode.Setup(system, start, BALL, sensor, Rounds(LRMATE_GOALS), 5.0, False, False)
    return episode.run(setup)


@pytest.mark.timeout(300)
def test_a_worse_calibration_keeps_more_distance_and_no_bound_is_too_little() -> None:
    away = np.array([0, -2.9, 0, 0, 0, 2.9])  # the ball seems farther from the coming arm than it is
    good, bad = calibrated(1.0, 0.5), calibrated(8.0, 4.0)
    found = {
        name: kept(sensor)
        for name, sensor in {
            "good": Seen(good, 0 * away), "bad": Seen(bad, 0 * away),
            "bad, and off": Seen(bad, away), "off, not said": Seen(bad, away, states_bound=False),
        }.items()
    }  # fmt: skip
    d_min = SYSTEM.d_min
    assert found["good"].min_distance >= d_min
    wider = bad.position_bound(1.4) - good.position_bound(1.4)
    assert found["bad"].min_distance > found["good"].min_distance + 0.5 * wider
    assert found["bad, and off"].min_distance >= d_min
    assert found["off, not said"].min_distance < d_min


def test_a_person_seen_by_a_calibrated_camera_carries_its_hash_and_its_bound(tmp_path: Path) -> None:
    good, bad = calibrated(1.0, 0.5), calibrated(8.0, 4.0)
    widths = []
    for result in (good, bad):
        result.save(tmp_path / "eye.json")
        source = HumanSource(HumanOptions(seed=4, position_bound_m=0.03, calibration=str(tmp_path / "eye.json")), 0)
        said = pb.HumanState.FromString(source.sensed(6_030_000_000))
        assert said.calibration_hash == result.digest
        bounds = np.array([c.position_bound for c in said.bodies[0].capsules])
        truth = Person(4).at(6.0)
        moved = np.linalg.norm(np.array([c.p0 for c in said.bodies[0].capsules]) - truth.p0, axis=1)
        assert (moved > 0).all()
        assert (moved <= bounds - 0.03).all()
        widths.append(bounds - 0.03)
    np.testing.assert_allclose(widths[1], 8 * widths[0], rtol=0.05)
    with pytest.raises(ValueError, match="calibration: 3 is no text"):
        HumanOptions.of({"calibration": 3})
    assert HumanOptions.of({"calibration": "eye.json"}).calibration == "eye.json"
