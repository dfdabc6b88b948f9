"""`asc trials ladder`: the command line. Exit codes: 0 every step that was run passed, 1 one failed, 2 refused or bad
input; then nothing was started."""

from __future__ import annotations

import argparse
import json
import re
import sys
import time
from pathlib import Path
from typing import Any

from asc_rt import launch

DEFAULT_CELL = "fanuc-sim-truth"


def main(argv: list[str]) -> int:
    from asc_rt.config import ConfigError
    from asc_rt.ladder.climb import Refused
    from asc_rt.ladder.journal import JournalError
    from asc_rt.ladder.steps import StepError
    from logs.seal import KeyFileError

    asked = _arguments(argv)
    try:
        return _climb(asked)
    except ConfigError as error:
        lines = list(error.lines)
    except (Refused, JournalError, StepError, KeyFileError) as error:
        lines = [str(error)]
    except OSError as error:
        lines = [f"{error.filename or asked.out}: {error.strerror or error}"]
    for line in lines:
        print(f"error: {line}", file=sys.stderr)
    return 2


def _climb(asked: argparse.Namespace) -> int:
    from asc_rt.config import load_cell
    from asc_rt.ladder.climb import Ladder, Person
    from asc_rt.ladder.journal import HARDWARE, PASS, SIM, Journal
    from asc_rt.ladder.report import write_report
    from logs.seal import load_key

    began = time.monotonic()
    cell = load_cell(asked.cell, asked.set)
    folder = asked.out or cell.log_dir / "ladder" / cell.name
    journal = Journal(folder, load_key(cell.log.key))
    if asked.report is not None:
        told = write_report(journal, asked.report)
        print(json.dumps(told, allow_nan=False) if asked.json else f"{asked.report}: {told['compared']} steps compared")
        return 0
    ladder = Ladder.of(asked.cell, asked.set, SIM if asked.sim else HARDWARE, journal)
    first, last = asked.step or (ladder.passed_to + 1, len(ladder.steps))
    entries = []
    for step in ladder.steps[first - 1 : last]:
        print(
            f"step {step.number} of {len(ladder.steps)}, {ladder.mode}: {step.title} (in the cell: {step.people})",
            file=sys.stderr,
        )
        entries.append(ladder.climb(step, Person(simulated=asked.sim)))
        print(f"step {step.number}: {entries[-1]['verdict']}", file=sys.stderr)
        if entries[-1]["verdict"] != PASS:
            break
    passed = all(entry["verdict"] == PASS for entry in entries)
    result = {
        "suite": "ladder",
        "cell": ladder.cell.name,
        "cell_hash": ladder.cell_hash,
        "mode": ladder.mode,
        "rows": [_row(entry) for entry in entries],
        "passed_to": ladder.passed_to,
        "steps": len(ladder.steps),
        "seconds": round(time.monotonic() - began, 1),
        "logs": str(folder),
    }
    print(json.dumps(result, allow_nan=False) if asked.json else _text(result))
    return 0 if passed else 1


def _row(entry: dict[str, Any]) -> dict[str, Any]:
    return {key: entry[key] for key in ("step", "name", "verdict", "failed", "measures", "log", "seconds")}


def _text(result: dict[str, Any]) -> str:
    lines = [f"{row['step']:3} {row['name']:8} {row['verdict']}  {'; '.join(row['failed'])}" for row in result["rows"]]
    done, of = result["passed_to"], result["steps"]
    return "\n".join([*lines, f"{result['cell']}, {result['mode']}: passed to step {done} of {of}; {result['logs']}"])


def _arguments(argv: list[str]) -> argparse.Namespace:
    parser = launch.OneLineParser(
        prog="asc trials ladder",
        description="Numbered steps from 'link, nothing moves' to 'person in the cell', first in simulation, then on "
        "the hardware. Example: asc trials ladder mycell --sim, then asc trials ladder mycell",
    )
    parser.add_argument("cell", nargs="?", default=DEFAULT_CELL, metavar="CELL", help=f"default: {DEFAULT_CELL}")
    parser.add_argument("--sim", action="store_true", help="against the cell's simulated devices")
    parser.add_argument("--step", type=_range, metavar="N[-M]", help="these steps; default: all that have not passed")
    launch.add_overrides(parser)
    parser.add_argument("-o", dest="out", type=Path, metavar="DIR", help="journal and recordings; log.dir/ladder/CELL")
    parser.add_argument(
        "--report", type=Path, metavar="FILE", help="run nothing; write FILE.html, .json, .png: simulation and hardware"
    )
    parser.add_argument("--json", action="store_true", help="one JSON object as the last line of stdout")
    return parser.parse_args(argv)


def _range(text: str) -> tuple[int, int]:
    from asc_rt.ladder.steps import load_steps

    found, count = re.fullmatch(r"(\d+)(?:-(\d+))?", text), len(load_steps())
    first, last = (int(found[1]), int(found[2] or found[1])) if found else (0, 0)
    if not 1 <= first <= last <= count:
        raise argparse.ArgumentTypeError(f"{text!r} is not possible; a step from 1 to {count}, or a range such as 2-5")
    return first, last
