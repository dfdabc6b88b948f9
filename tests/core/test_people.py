"""Where people may be by the time that counts."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from asc_rt.core.people import COLUMNS, is_finite, predict
from asc_rt.core.types import vector


def test_nobody_without_a_message() -> None:
    assert all(len(values) == 0 for values in predict(None, 0.1))


@pytest.mark.parametrize("horizon", [0.25, -0.25])
def test_people_go_on_at_their_speed_and_grow_by_what_is_not_known(bench: Any, horizon: float) -> None:
    """A message from the future is as inexact as one from the past."""
    human = replace(
        bench.human([[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]], [[1.0, 2.0, 4.0], [0.0, 0.5, 0.0]], radius=[0.1, 0.2]),
        v0=vector([[0.4, 0.0, 0.0], [0.0, 0.0, 0.8]]),
        v1=vector([[0.0, 0.4, 0.0], [0.0, 0.0, -0.8]]),
        position_bound=vector([0.01, 0.02]),
        velocity_bound=vector([0.4, 0.2]),
    )
    people = predict(human, horizon)
    way = 0.4 * horizon
    np.testing.assert_allclose(people.p0, [[1.0 + way, 2.0, 3.0], [0.0, 0.0, 2 * way]])
    np.testing.assert_allclose(people.p1, [[1.0, 2.0 + way, 4.0], [0.0, 0.5, -2 * way]])
    np.testing.assert_allclose(people.radius, [0.1 + 0.01 + 0.1, 0.2 + 0.02 + 0.05])
    for same in ("v0", "v1", "velocity_bound"):
        np.testing.assert_array_equal(getattr(people, same), getattr(human, same))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_one_figure_that_is_no_number_is_one_too_many(bad: float) -> None:
    people = np.ones((2, COLUMNS))
    assert is_finite(people)
    assert is_finite(people[:0])
    for k in range(people.size):
        broken = people.copy()
        broken.flat[k] = bad
        assert not is_finite(broken)
