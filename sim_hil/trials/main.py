"""`python -m sim_hil trials SUITE`: run a suite on several processes, print its table. `asc trials` is this.

Exit codes: 0 the filter kept its promise, 1 it did not (or Ctrl-C), 2 bad usage.
"""

from __future__ import annotations

import argparse
import ctypes
import dataclasses
import json
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any, NoReturn

from tqdm import tqdm

from asc_rt import realtime

PLAIN_LINES = 20  # of progress where there is no terminal
PR_SET_PDEATHSIG = 1
BLAS = realtime.BLAS_VARIABLES

Done = list[tuple[Any, Any]]


def main(argv: list[str]) -> int:
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # like Ctrl-C: the table of what is ready
    for variable in BLAS:  # the workers', which have not imported numpy yet
        os.environ[variable] = "1"
    from sim_hil.trials import report
    from sim_hil.trials.suites import POLICIES, SUITES, Job

    asked = _arguments(argv, list(SUITES))
    suite = SUITES[asked.suite]
    jobs = [
        Job(asked.suite, system, policy, trial, asked.seed)
        for trial in range(suite.trials if asked.n is None else asked.n)
        for system in range(len(suite.systems))
        for policy in POLICIES
    ]
    began = time.monotonic()
    done = _run(jobs, asked.jobs)
    table = report.rows(asked.suite, done)
    result = {
        "suite": asked.suite,
        "seed": asked.seed,
        "complete": len(done) == len(jobs),
        "rows": table,
        "seconds": round(time.monotonic() - began, 1),
        "logs": [],
    }
    if asked.out is not None:
        result["logs"] = _write(asked.out, asked.suite, done)
        (asked.out / f"{asked.suite}.json").write_text(json.dumps(result, indent=1))
    print(json.dumps(result, allow_nan=False) if asked.json else report.text(table))
    return 0 if result["complete"] and report.holds(asked.suite, table) else 1


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        """One line, not the usage as well."""
        self.exit(2, f"error: {message}\n")


def _arguments(argv: list[str], suites: list[str]) -> argparse.Namespace:
    parser = _Parser(
        prog="asc trials",
        description="Run a suite of seeded trials in simulation. Example: asc trials table1 -n 20 -j 2 -o runs/table1",
    )
    parser.add_argument("suite", choices=suites, metavar=f"SUITE ({', '.join(suites)})")
    parser.add_argument("-n", type=_at_least_one, metavar="N", help="trials per system and policy")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="of every draw; 0")
    parser.add_argument("-j", "--jobs", type=_at_least_one, default=os.cpu_count() or 1, help="processes; all cores")
    parser.add_argument("-o", dest="out", type=Path, metavar="DIR", help="write every trial and the table there")
    parser.add_argument("--json", action="store_true", help="one JSON object as the last line of stdout")
    asked = parser.parse_args(argv)
    if asked.seed < 0:
        parser.error(f"--seed: {asked.seed} is negative; 0 or more")
    return asked


def _at_least_one(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not possible; a whole number, 1 or more")
    return int(text)


def _run(jobs: list[Any], processes: int) -> Done:
    """What was done, all of it or, after Ctrl-C, what was ready by then."""
    from sim_hil.trials import suites

    done: Done = []
    context = multiprocessing.get_context("spawn")  # numba's threads do not survive a fork
    with ProcessPoolExecutor(min(processes, len(jobs)), context, _as_worker) as pool:
        futures = {pool.submit(suites.run, job): job for job in jobs}
        try:
            for future in _with_progress(as_completed(futures), len(jobs)):
                done.append((futures[future], future.result()))
        except (KeyboardInterrupt, BrokenProcessPool) as why:
            print(f"ended early, {len(done)} of {len(jobs)} trials: {type(why).__name__}", file=sys.stderr)
            pool.shutdown(wait=False, cancel_futures=True)
    return done


def _as_worker() -> None:
    """Ctrl-C is the parent's affair; if the parent dies otherwise, so does its worker."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)


def _with_progress(futures: Iterator[Future[Any]], total: int) -> Iterator[Future[Any]]:
    bar = tqdm(futures, total=total, unit=" trials", disable=None, file=sys.stderr)
    every, began = max(1, total // PLAIN_LINES), time.monotonic()
    for i, future in enumerate(bar, start=1):
        if bar.disable and (i % every == 0 or i == total):
            spent = time.monotonic() - began
            print(
                f"{i} of {total} trials, {i / spent:.2f} per s, {spent / i * (total - i):.0f} s left", file=sys.stderr
            )
        yield future


def _write(folder: Path, suite: str, done: Done) -> list[str]:
    """Every trial, one JSON line each, in the order of the jobs."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{suite}.jsonl"
    with path.open("w") as file:
        for job, outcome in sorted(done, key=lambda pair: (pair[0].system, pair[0].policy, pair[0].trial)):
            file.write(json.dumps({**dataclasses.asdict(job), **_finite(dataclasses.asdict(outcome))}) + "\n")
    return [str(path)]


def _finite(values: dict[str, Any]) -> dict[str, Any]:
    """JSON has no infinity: what was never met is null."""
    return {k: None if isinstance(v, float) and abs(v) == float("inf") else v for k, v in values.items()}
