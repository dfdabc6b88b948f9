"""`python -m sim_hil trials SUITE`: run a suite, print its table. `asc trials` is this.

Exit codes: 0 the filter kept its promise, 1 it did not (or Ctrl-C), 2 bad usage.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

from tqdm import tqdm

from asc_rt import launch, realtime
from asc_rt.config import ConfigError

PLAIN_LINES = 20  # of progress where there is no terminal


def main(argv: list[str]) -> int:
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # like Ctrl-C: the table of what is ready
    for variable in realtime.BLAS_VARIABLES:  # the workers', which have not imported numpy yet
        os.environ[variable] = "1"
    from asc_rt.synthesis.cluster import ClusterError
    from sim_hil.trials import profiles, report
    from sim_hil.trials.results import OtherCampaign, Results
    from sim_hil.trials.suites import find

    asked = _arguments(argv)
    jobs = _jobs(asked)
    began = time.monotonic()
    try:
        results = Results(asked.out, asked.suite, asked.seed)
        _run(jobs, asked, results)
    except (OtherCampaign, ClusterError) as error:
        return _refuse(str(error))
    except OSError as error:
        return _refuse(f"{asked.out}: {error.strerror or error}")
    wanted = set(jobs)
    done = [(job, outcome) for job, outcome in results.done if job in wanted]
    table = report.rows(asked.suite, done)
    result = {
        "suite": asked.suite,
        "seed": asked.seed,
        "complete": len(done) == len(jobs),
        "rows": table,
        "seconds": round(time.monotonic() - began, 1),
        "logs": results.close(),
    }
    if asked.out is not None and find(asked.suite).file is not None and done:
        picture = profiles.draw(asked.suite, done, asked.out / f"{Path(asked.suite).stem}.png")
        result["logs"].append(str(picture))
    for line in [*report.broken_promises(done), *report.shortfalls(asked.suite, table)]:
        print(line, file=sys.stderr)
    print(json.dumps(result, allow_nan=False) if asked.json else report.text(table))
    return 0 if result["complete"] and report.holds(asked.suite, table) else 1


def _jobs(asked: argparse.Namespace) -> list[Any]:
    """Every trial asked for; `--trial` and its kin narrow them down to one that is to be looked at."""
    from sim_hil.trials.suites import Job, find

    suite = find(asked.suite)
    trials = range(suite.trials if asked.n is None else asked.n) if asked.trial is None else [asked.trial]
    return [
        Job(asked.suite, i, policy, trial, asked.seed)
        for trial in trials
        for i, system in enumerate(suite.systems)
        if asked.system in (None, system.name)
        for policy in suite.policies
        if asked.policy in (None, policy)
    ]


def _arguments(argv: list[str]) -> argparse.Namespace:
    from sim_hil.trials import suites

    parser = launch.OneLineParser(
        prog="asc trials",
        description="Run a suite of seeded trials in simulation. Example: asc trials table1 -n 20 -j 2 -o runs/table1",
    )
    parser.add_argument("suite", metavar=f"SUITE ({', '.join(suites.names())}, or FILE.toml)")
    parser.add_argument("-n", type=_at_least_one, metavar="N", help="trials per system and policy")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="of every draw; 0")
    parser.add_argument("-j", "--jobs", type=_at_least_one, default=os.cpu_count() or 1, help="processes; all cores")
    parser.add_argument("--cluster", metavar="ADDRESS", help="Dask scheduler, tcp://HOST:PORT; default: this machine")
    parser.add_argument("-o", dest="out", type=Path, metavar="DIR", help="write every trial there; goes on if it can")
    parser.add_argument("--system", metavar="NAME", help="only this arm and tool")
    parser.add_argument("--policy", metavar="NAME", help="only this policy")
    parser.add_argument("--trial", type=_not_negative, metavar="K", help="only this one, as numbered in the results")
    parser.add_argument("--record", action="store_true", help="with -o: each trial as MCAP, for asc view")
    parser.add_argument("--json", action="store_true", help="one JSON object as the last line of stdout")
    asked = parser.parse_args(argv)
    if asked.seed < 0:
        parser.error(f"--seed: {asked.seed} is negative; 0 or more")
    if asked.record and asked.out is None:
        parser.error("--record: where to? add -o DIR")
    try:
        suite = suites.find(asked.suite)
    except KeyError:
        parser.error(f"SUITE: {asked.suite!r} is unknown; one of {', '.join(suites.names())}, or a file .toml")
    except ConfigError as error:
        parser.error("\nerror: ".join(error.lines))
    for name, known in (("system", [system.name for system in suite.systems]), ("policy", list(suite.policies))):
        if getattr(asked, name) not in (None, *known):
            parser.error(f"--{name}: {getattr(asked, name)!r} is not in {asked.suite}; one of {', '.join(known)}")
    return asked


def _not_negative(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is not possible; a whole number, 0 or more")
    return int(text)


def _at_least_one(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not possible; a whole number, 1 or more")
    return int(text)


def _run(jobs: list[Any], asked: argparse.Namespace, results: Any) -> None:
    """All that is not done yet; after Ctrl-C, what was ready by then. ClusterError, OSError: the journal."""
    from sim_hil.trials import suites, workers

    done = {job for job, _ in results.done}
    left = [job for job in jobs if job not in done]
    if len(left) < len(jobs):
        print(f"{len(jobs) - len(left)} of {len(jobs)} trials were done before", file=sys.stderr)
    if not left:
        return
    folder = asked.out if asked.record else None
    where = workers.dask(asked.cluster) if asked.cluster else workers.processes(min(asked.jobs, len(left)))
    with where as pool:
        futures = {pool.submit(suites.run, job, folder): job for job in left}
        try:
            for future in _with_progress(as_completed(futures), len(left)):
                results.add(futures[future], future.result())
        except (KeyboardInterrupt, BrokenProcessPool) as why:
            print(f"ended early, {len(results.done)} of {len(jobs)} trials: {type(why).__name__}", file=sys.stderr)
            for future in futures:
                future.cancel()
            pool.shutdown(wait=False)


def _with_progress(futures: Iterable[Future[Any]], total: int) -> Iterator[Future[Any]]:
    bar = tqdm(futures, total=total, unit=" trials", disable=None, file=sys.stderr)
    every, began = max(1, total // PLAIN_LINES), time.monotonic()
    for i, future in enumerate(bar, start=1):
        if bar.disable and (i % every == 0 or i == total):
            spent = time.monotonic() - began
            left = spent / i * (total - i)
            print(f"{i} of {total} trials, {60 * i / spent:.1f} per min, {left:.0f} s left", file=sys.stderr)
        yield future


def _refuse(line: str) -> int:
    print(f"error: {line}", file=sys.stderr)
    return 2
