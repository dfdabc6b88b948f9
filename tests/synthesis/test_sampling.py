"""Reproducible by seed whoever computes, memory that does not grow, extremes that can be looked at again."""

from __future__ import annotations

import subprocess
import sys
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from asc_rt.synthesis import kernel, sampling
from asc_rt.synthesis.cluster import ClusterError, cluster
from asc_rt.synthesis.draw import evaluate_all, realise
from asc_rt.synthesis.sampling import RangeError, Survey, collect, threads, units_of
from asc_rt.synthesis.statistics import EDGES, Statistics, quantile

pytestmark = pytest.mark.timeout(300)


@pytest.fixture
def survey(bench: Any, monkeypatch: pytest.MonkeyPatch) -> Survey:
    monkeypatch.setattr(sampling, "CHUNK", 200)
    model = bench.model()
    return Survey(model.arm, bench.draw(model), 11, 2100, 0.3, 1.0)


def same(a: Statistics, b: Statistics) -> bool:
    extremes = all(
        a_side[name].value == b_side[name].value and np.array_equal(a_side[name].unit, b_side[name].unit)
        for a_side, b_side in ((a.least, b.least), (a.greatest, b.greatest))
        for name in a_side
    )
    histograms = all(np.array_equal(a.histograms[name], b.histograms[name]) for name in a.histograms)
    return a.counts == b.counts and extremes and histograms and a.least.keys() == b.least.keys()


def serially(work: Callable[[int], Any], count: int) -> Iterator[Any]:
    return map(work, range(count))


def test_the_seed_alone_decides(survey: Survey) -> None:
    one = collect(survey, serially)
    assert same(one, collect(survey, partial(threads, workers=1)))
    assert same(one, collect(survey, partial(threads, workers=5)))
    assert not same(one, collect(replace(survey, seed=12), serially))


def test_every_sample_is_taken_once(survey: Survey) -> None:
    units = np.vstack([units_of(survey.arm, survey.seed, i, survey.samples) for i in range(11)])
    assert len(np.unique(units, axis=0)) == 2100
    found = evaluate_all(survey.arm, survey.draw, units, True)
    total = collect(survey)
    assert total.counts["samples"] == 2100
    assert total.least["M"].value == found[:, kernel.RADIUS].min()
    assert total.greatest["falling"].value == -found[:, kernel.RADIUS_LOW].min()
    approach = (found[:, kernel.D_DOT] < 0.0) & (found[:, kernel.D_DOT_ROBOT] < 0.0)
    covered = approach & (found[:, kernel.RADIUS] > 0.3) & (found[:, kernel.D_DOT] >= -1.0)
    ratio = -found[covered, kernel.RADIUS_LOW] / found[covered, kernel.RADIUS]
    assert total.greatest["ratio"].value == ratio.max()
    assert (total.counts["approaching"], total.counts["covered"]) == (approach.sum(), covered.sum())


def test_the_extremes_bracket_and_their_states_give_them_again(survey: Survey) -> None:
    total = collect(survey)
    for extremes, column in ((total.least["M"], kernel.RADIUS), (total.greatest["M"], kernel.RADIUS)):
        s, out = realise(survey.arm, survey.draw, extremes.unit), np.empty(kernel.COLUMNS)
        kernel.evaluate(survey.arm, survey.draw.given, s.people, s.q, s.dq, s.capsule, True, out)
        assert out[column] == extremes.value
    again = evaluate_all(survey.arm, survey.draw, units_of(survey.arm, 11, 3, 2100), True)
    assert np.all(again[:, kernel.RADIUS] >= total.least["M"].value)
    assert np.all(again[:, kernel.BALL] <= total.greatest["ball"].value)


def test_few_chunks_are_waiting_at_any_time() -> None:
    """Workers run ahead of a slow reader by a fixed number of chunks, whatever their total."""
    began: list[int] = []

    def work(index: int) -> int:
        began.append(index)
        return index

    for read, index in enumerate(threads(work, 200, workers=2)):
        assert read == index
        assert len(began) <= read + 2 * sampling.IN_FLIGHT + 1
    assert sorted(began) == list(range(200))


def test_memory_does_not_grow_with_the_number_of_samples(survey: Survey) -> None:
    collect(survey)
    peaks = []
    for samples in (2000, 20_000):
        tracemalloc.start()
        collect(replace(survey, samples=samples), serially)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.3 * peaks[0]


RSS = """
import resource, sys
from asc_rt.config import load_arm
from asc_rt.core import robot_model
from asc_rt.synthesis import sampling
from asc_rt.synthesis.table1 import FLOOR, TRUE_RANGES
robot, tool = load_arm("panda", "ee1")
model = robot_model.load(robot, tool, "torque")
draw = sampling.draw_of(model, len(tool.capsules), TRUE_RANGES)
sampling.collect(sampling.Survey(model.arm, draw, 0, int(sys.argv[1]), FLOOR, TRUE_RANGES.v_max))
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_ten_million_samples_take_no_more_memory_than_a_hundred_thousand() -> None:
    """Of whole processes, as the kernel counts it, kB."""
    few, many = (
        int(subprocess.run([sys.executable, "-c", RSS, n], capture_output=True, text=True, check=True).stdout)
        for n in ("100000", "10000000")
    )
    assert many < 1.1 * few


def test_histograms_hold_everything_and_quantiles_are_near() -> None:
    values = np.random.default_rng(0).normal(50.0, 20.0, 20_000)
    out = Statistics()
    out.see("x", values, np.zeros((len(values), 1)), histogram=True)
    out.see("x", np.array([1e9, -1e9]), np.zeros((2, 1)), histogram=True)
    assert out.histograms["x"].sum() == 20_002
    for share in (0.01, 0.5, 0.99):
        assert quantile(out.histograms["x"], share) == pytest.approx(np.quantile(values, share), rel=0.05, abs=0.05)
    assert (out.least["x"].value, out.greatest["x"].value) == (-1e9, 1e9)
    assert EDGES[0] == -EDGES[-1]


def test_equal_extremes_keep_the_first_state() -> None:
    a, b = Statistics(), Statistics()
    a.see("x", np.array([1.0, 1.0]), np.array([[1.0], [2.0]]))
    b.see("x", np.array([1.0]), np.array([[3.0]]))
    a.merge(b)
    assert a.least["x"].unit == a.greatest["x"].unit == [1.0]


@pytest.mark.parametrize(
    ("change", "samples", "said"),
    [
        ({"d_low": 0.0}, 1, "d from 0 m"),
        ({"d_low": -0.1}, 1, "d from -0.1 m"),
        ({"d_low": float("nan")}, 1, "d from nan m"),
        ({"d_high": 0.04}, 1, "d up to 0.04 m"),
        ({"d_low": 0.2}, 1, "leaves d_min = 0.05 m out"),
        ({"speed_share": 0.0}, 1, "speed share 0"),
        ({"speed_share": 1.5}, 1, "speed share 1.5"),
        ({"v_max": 0.0}, 1, "approach speed up to 0"),
        ({"human_speed": -1.0}, 1, "person's speed"),
        ({}, 0, "--samples: 0"),
    ],
)
def test_ranges_that_cannot_be_certified_are_refused(bench: Any, change: Any, samples: int, said: str) -> None:
    with pytest.raises(RangeError, match=said):
        sampling.check(replace(bench.RANGES, **change), 0.05, samples)


def test_a_dask_cluster_gives_the_same_result(survey: Survey) -> None:
    distributed = pytest.importorskip("distributed")
    local = collect(survey)
    options = {"n_workers": 1, "threads_per_worker": 2, "processes": False, "dashboard_address": None}
    with (
        distributed.LocalCluster(**options, protocol="tcp", host="127.0.0.1") as scheduler,
        cluster(scheduler.scheduler_address) as workers,
    ):
        assert same(local, collect(survey, workers))


def test_no_cluster_at_the_address_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("asc_rt.synthesis.cluster.CONNECT_TIMEOUT_S", 0.2)
    with pytest.raises(ClusterError, match="no Dask scheduler answers"), cluster("tcp://127.0.0.1:1"):
        pass
