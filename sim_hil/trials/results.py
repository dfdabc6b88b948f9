"""The results of a campaign in one folder: each trial is in the journal as soon as it has ended, and all of them are in
one Parquet table at the end, for pandas, Polars, DuckDB or any other reader.

A killed campaign is gone on with by the same command: what is in the journal is not run again. Trials of other code or
of another seed are never mixed in.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet

from sim_hil.trials.judge import Outcome
from sim_hil.trials.suites import Job

PACKAGES = ("asc_rt", "drivers", "sim_hil")
DECIDING = (".py", ".urdf", ".toml", ".json")  # files that an outcome can depend on
ROOT = Path(__file__).parents[2]

Done = list[tuple[Job, Outcome]]


class OtherCampaign(Exception):
    """The folder holds trials that must not be mixed with these."""


def code_sha256(suite: str = "") -> str:
    """Over every source file, robot, tool, cell and certificate that an outcome can depend on, and a suite's file."""
    sha = hashlib.sha256(Path(suite).read_bytes() if suite.endswith(".toml") else b"")
    for package in PACKAGES:
        for path in sorted(p for p in (ROOT / package).rglob("*") if p.suffix in DECIDING):
            sha.update(str(path.relative_to(ROOT)).encode() + b"\0" + path.read_bytes())
    return sha.hexdigest()


class Results:
    """What is done of a suite; without a folder it is kept in memory only."""

    def __init__(self, folder: Path | None, suite: str, seed: int) -> None:
        """Reads what an earlier run left. OtherCampaign: it was of other code or another seed; OSError: the disk."""
        self.done: Done = []
        self._head = {"suite": suite, "seed": seed, "code_sha256": code_sha256(suite)}
        self._folder, self._suite = folder, Path(suite).stem
        if folder is None:
            return
        folder.mkdir(parents=True, exist_ok=True)
        self._journal = folder / f"{self._suite}.jsonl"
        if self._journal.exists():
            self._resume()
        else:
            self._append(self._head)

    def add(self, job: Job, outcome: Outcome) -> None:
        self.done.append((job, outcome))
        if self._folder is not None:
            self._append(_plain(job, outcome))

    def close(self) -> list[str]:
        """Write the table; the files there are."""
        if self._folder is None:
            return []
        table = self._folder / f"{self._suite}.parquet"
        in_order = sorted(self.done, key=lambda pair: dataclasses.astuple(pair[0]))
        schema = pa.schema([*_columns(Job), *_columns(Outcome)], {k: str(v) for k, v in self._head.items()})
        rows = pa.Table.from_pylist([_plain(*pair) for pair in in_order], schema)
        pyarrow.parquet.write_table(rows, table)
        return [str(self._journal), str(table)]

    def _append(self, values: dict[str, Any]) -> None:
        with self._journal.open("a") as file:
            file.write(json.dumps(values) + "\n")

    def _resume(self) -> None:
        """A last line without its end is of a run that was killed while it wrote: that trial is run again."""
        text = self._journal.read_text()
        whole = text[: text.rfind("\n") + 1]
        lines = [json.loads(line) for line in whole.splitlines()]
        if lines and lines[0] != self._head:
            told = ("suite", "seed", "code_sha256")
            differs = ", ".join(key for key in told if lines[0].get(key) != self._head[key])
            raise OtherCampaign(f"{self._journal}: trials of another campaign ({differs} differ); name another folder")
        if not lines:
            whole = json.dumps(self._head) + "\n"
        if whole != text:
            self._journal.write_text(whole)
        self.done = [_parsed(line) for line in lines[1:]]


def _plain(job: Job, outcome: Outcome) -> dict[str, Any]:
    """JSON has no infinity: what was never met is null."""
    values = {**dataclasses.asdict(job), **dataclasses.asdict(outcome)}
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in values.items()}


# Which infinity the null of a field stands for.
_NEVER_MET = {"min_distance": math.inf, "tool_distance": math.inf, "M_min": math.inf, "M_max": -math.inf}


def _parsed(values: dict[str, Any]) -> tuple[Job, Outcome]:
    job = Job(**{f.name: values[f.name] for f in dataclasses.fields(Job)})
    found = {f.name: values[f.name] for f in dataclasses.fields(Outcome)}
    found = {k: _NEVER_MET.get(k) if v is None else tuple(v) if isinstance(v, list) else v for k, v in found.items()}
    return job, Outcome(**found)


_TYPES = {"int": pa.int64(), "float": pa.float64(), "bool": pa.bool_(), "str": pa.string()}
_TYPES |= {"tuple[str, ...]": pa.list_(pa.string()), "tuple[float, ...]": pa.list_(pa.float64())}


def _columns(record: type) -> list[pa.Field]:
    return [pa.field(f.name, _TYPES[str(f.type)]) for f in dataclasses.fields(record)]
