"""Mutation testing of the code that decides about safety: each mutant has to fail a test or have a reason not to.

    NUMBA_DISABLE_JIT=1 python tests/mutation/campaign.py [--sample N] [--seed S] [--only FILE] [-j JOBS]

The tests are collected once. Each mutant is a fork of that process with the code object of one function exchanged, so
nothing is written and a mutant costs no more than the tests that it takes to kill it. The kernels run as plain Python,
since compiling them anew would take half a minute a mutant; tests that are too slow for that are marked `compiled`.
Last line: JSON with the survivors. Exit 1: a survivor without a reason, or (whole campaign) a reason without survivor.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import resource
import sys
import time
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import Phase, settings
from mutants import Mutant, mutants

HERE = Path(__file__).parent
CORE, TESTS = HERE.parents[1] / "asc_rt" / "core", HERE.parents[1] / "tests" / "core"
# What is mutated, and the tests that speak of it, the most telling first.
TARGETS = {
    "abstraction.py": ("test_segments.py", "test_abstraction.py", "test_safety_index.py", "test_gradient.py"),
    "radius.py": ("test_radius.py", "test_abstraction.py", "test_gradient.py"),
    "polytope.py": ("test_polytope.py", "test_abstraction.py", "test_safe_control.py"),
    "people.py": ("test_people.py",),
    "safety_index.py": ("test_row_floors.py", "test_psi.py", "test_stopping_distance_index.py", "test_safety_index.py"),
    "stopping.py": ("test_limits.py", "test_safety_index.py"),
    "limits.py": ("test_limits.py", "test_abstraction.py"),
    "safe_control.py": ("test_safe_control.py",),
    "gate.py": ("test_gate.py", "test_smoothing.py"),
    "separation_monitor.py": ("test_separation_monitor.py",),
    "mode.py": ("test_mode.py", "test_changer.py"),
    "human_ladder.py": ("test_human_ladder.py", "test_mode.py"),
    "brake.py": ("test_smoothing.py", "test_step.py"),
    "smoothing.py": ("test_smoothing.py",),
    "fusion.py": ("test_human_ladder.py",),
    "levels.py": ("test_torque_law.py",),
    "torque.py": ("test_torque_law.py",),
    "changer.py": ("test_changer.py", "test_mode.py"),
    "reference.py": ("test_smoothing.py",),
    "rows.py": ("test_rows.py", "test_safety_index.py"),
}
ITEM_SECONDS = 20  # CPU; a test that is not marked `compiled` takes a tenth: a mutant that loops for ever is killed

Result = tuple[Mutant, str]  # and the test that killed it, or ""


class Campaign:
    """A pytest plugin: instead of running the tests once it runs them on every mutant."""

    def __init__(self, chosen: list[Mutant], jobs: int) -> None:
        self.chosen, self.jobs = chosen, jobs
        self.results: list[Result] = []

    def pytest_collection(self) -> None:
        quick = settings(deadline=None, database=None, derandomize=True, phases=(Phase.explicit, Phase.generate))
        settings.register_profile("mutation", quick)
        settings.load_profile("mutation")

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        if session.testsfailed:
            raise session.Failed("the tests cannot be collected")
        waiting: dict[int, tuple[Mutant, int]] = {}
        for mutant in [*self.chosen, None]:
            while waiting and (mutant is None or len(waiting) >= self.jobs):
                self._collect(*os.wait()[:2], waiting)
            if mutant is not None:
                process, answer = _fork(mutant, _ordered(session.items, mutant))
                waiting[process] = mutant, answer
        return True

    def _collect(self, process: int, status: int, waiting: dict[int, tuple[Mutant, int]]) -> None:
        mutant, answer = waiting.pop(process)
        with os.fdopen(answer) as pipe:
            killer = pipe.read().strip()
        if status and not killer:
            killer = f"ended with {status}"
        self.results.append((mutant, killer))
        where, verdict = f"{mutant.node.lineno:4d}  {mutant.name}", killer or "SURVIVED"
        print(f"{len(self.results)} of {len(self.chosen)} {where}  [{verdict}]")


def _ordered(items: list[pytest.Item], mutant: Mutant) -> list[pytest.Item]:
    files = TARGETS[mutant.path.name]
    return sorted((i for i in items if i.path.name in files), key=lambda item: files.index(item.path.name))


def _fork(mutant: Mutant, items: list[pytest.Item]) -> tuple[int, int]:
    """The child's process id and where it writes the name of the test that failed."""
    answer, write = os.pipe()
    sys.stdout.flush()
    if child := os.fork():
        os.close(write)
        return child, answer
    try:
        with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere), contextlib.redirect_stderr(nowhere):
            failed = _first_failure(mutant, items)
        os.write(write, failed.encode())
    finally:
        os._exit(0)


def _first_failure(mutant: Mutant, items: list[pytest.Item]) -> str:
    from _pytest.runner import runtestprotocol

    _function(mutant).__code__ = mutant.code()  # type: ignore[attr-defined]
    for item, following in zip(items, [*items[1:], None], strict=True):
        spent = time.process_time()
        resource.setrlimit(resource.RLIMIT_CPU, (int(spent) + ITEM_SECONDS, resource.RLIM_INFINITY))
        if any(report.failed for report in runtestprotocol(item, log=False, nextitem=following)):
            return item.nodeid
    return ""


def _function(mutant: Mutant) -> Callable[..., Any]:
    found: Any = sys.modules[f"asc_rt.core.{mutant.path.stem}"]
    for name in mutant.function.split("."):
        found = vars(found)[name]
    return found.fget if isinstance(found, property) else found


def reasons() -> dict[str, str]:
    """Why a mutant is no defect, by its name."""
    table: dict[str, str] = {}
    for entry in tomllib.loads((HERE / "survivors.toml").read_text())["survivors"]:
        table.update(dict.fromkeys(entry["mutants"], entry["reason"]))
    return table


def _chosen(asked: argparse.Namespace) -> list[Mutant]:
    files = [asked.only] if asked.only else list(TARGETS)
    every = [mutant for name in files for mutant in mutants(CORE / name)]
    if asked.sample is None:
        return every
    known = reasons()
    return sorted((m for m in every if m.name not in known), key=lambda m: _lot(m, asked.seed))[: asked.sample]


def _lot(mutant: Mutant, seed: int) -> bytes:
    """A mutant's place in the draw hangs on its own name only: other edits hardly change a sample."""
    return hashlib.sha256(f"{seed} {mutant.name}".encode()).digest()


def _files(chosen: list[Mutant]) -> Iterator[str]:
    yield from {str(TESTS / name) for mutant in chosen for name in TARGETS[mutant.path.name]}


def main() -> int:
    parser = argparse.ArgumentParser(description="Mutation testing of the safety code")
    parser.add_argument("--sample", type=int, help="so many mutants, drawn at random from those without a reason")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=list(TARGETS), help="of this file")
    parser.add_argument("-j", dest="jobs", type=int, default=1)
    asked = parser.parse_args()
    if os.environ.get("NUMBA_DISABLE_JIT") != "1":
        parser.error("NUMBA_DISABLE_JIT=1 is needed: compiled code cannot be exchanged")
    campaign = Campaign(_chosen(asked), asked.jobs)
    options = ["-q", "-n", "0", "-p", "no:cacheprovider", "-m", "not slow and not compiled"]
    code = pytest.main([*options, *sorted(_files(campaign.chosen))], plugins=[campaign])
    survivors = {mutant.name for mutant, killer in campaign.results if not killer}
    unexplained = sorted(survivors - set(reasons()))
    stale = sorted(set(reasons()) - survivors) if asked.sample is None and not asked.only else []
    ran = len(campaign.results)
    print(json.dumps({"mutants": ran, "killed": ran - len(survivors), "unexplained": unexplained, "stale": stale}))
    return 1 if code or unexplained or stale or ran < len(campaign.chosen) or not ran else 0


if __name__ == "__main__":
    sys.exit(main())
