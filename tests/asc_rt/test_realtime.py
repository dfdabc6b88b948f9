"""What is set up for the loop, as far as it can be seen without real-time rights."""

import os

import pytest

from asc_rt import realtime


@pytest.mark.parametrize(
    ("there", "cpu", "left"), [({0, 1}, 1, {0}), ({0, 1}, None, {0, 1}), ({0, 1}, 7, {0, 1}), ({1}, 1, None)]
)
def test_the_loops_core_is_left_to_it_where_there_is_another(
    monkeypatch: pytest.MonkeyPatch, there: set[int], cpu: int | None, left: set[int] | None
) -> None:
    kept: list[set[int]] = []
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: there)
    monkeypatch.setattr(os, "sched_setaffinity", lambda pid, cpus: kept.append(cpus))
    realtime.leave(cpu)
    assert kept == ([] if left is None else [left])
