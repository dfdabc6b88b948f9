from __future__ import annotations

import numpy as np

from asc_rt.config import load_cell
from asc_rt.core.params import Params
from asc_rt.core.types import vector
from asc_rt.robot_limits import within
from drivers.base import JointLimits


def test_the_smaller_limit_counts_joint_by_joint() -> None:
    params = load_cell("fanuc-sim-truth").params
    r = params.robot
    told = JointLimits(*(vector(np.array(own) * [0.5, 2, 1, 1, 1, 0.9]) for own in (r.dq_max, r.ddq_max, r.dddq_max)))
    got = within(params, told)
    for name in ("dq_max", "ddq_max", "dddq_max"):
        np.testing.assert_allclose(getattr(got.robot, name), np.array(getattr(r, name)) * [0.5, 1, 1, 1, 1, 0.9])
    assert Params.from_canonical(got.canonical()) == got
    assert within(params, None) is params
