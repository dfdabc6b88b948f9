"""`asc audit`: does everything hold that must hold in any recording? The verdict as one JSON-able report.

The report depends on the recording alone (no clock, no machine), so that whoever runs it again gets the same hash.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from logs.audit_evidence import Evidence, gather
from logs.audit_finding import Finding
from logs.audit_rules import RULES
from logs.mcap_scan import CorruptLog
from logs.reader import Progress
from logs.recording import Recording
from logs.replay import replay

CHANGES = 400  # changes of mode whose neighbourhood is run again
SAMPLE = 2000  # cycles that are run again: around every stop, and evenly over the rest


def audit(
    path: Path,
    trusted: Ed25519PublicKey | None = None,
    trusted_name: str = "",
    *,
    sample: int | None = SAMPLE,
    jobs: int = 1,
    reading: Progress = iter,
    progress: Progress = iter,
) -> tuple[dict[str, Any], Evidence | None]:
    """The report, and what it was made of (None: the file is damaged). `sample`: cycles to run again; None: all.
    `reading` goes over the megabytes of the file, `progress` over the cycles that are run again.

    LogError: not a recording at all, or not readable.
    """
    try:
        evidence = gather(path, reading)
    except CorruptLog as error:
        return _damaged(path, error), None
    log = evidence.log
    evidence.trusted, evidence.trusted_name = trusted, trusted_name
    if log.cycles:
        cycles = chosen(evidence, sample)
        evidence.replay = replay(
            log, cycles=cycles, columns=evidence.c, packets=evidence.packets, jobs=jobs, progress=progress
        )
    findings = [rule(evidence) for rule in RULES]
    return _report(log, evidence, findings), evidence


def chosen(e: Evidence, sample: int | None) -> Sequence[int]:
    """Cycles to run again: all that led to a stop or another change of mode, and as many more, evenly spaced."""
    if sample is None or sample >= e.cycles:
        return range(e.cycles)
    changes = np.flatnonzero(e.mode_after != e.mode)
    changes = changes[:: -(-len(changes) // CHANGES) or 1]
    near = (changes[:, None] + np.arange(-2, 3)).ravel()
    even = np.linspace(0, e.cycles - 1, sample).astype(int)
    kept = np.unique(np.concatenate([near[(near >= 0) & (near < e.cycles)], even]))
    return [int(i) for i in kept]


def _report(log: Recording, e: Evidence, findings: list[Finding]) -> dict[str, Any]:
    distance = e.c["outputs.decision.d_measured"]
    named = {finding.name: finding for finding in findings}
    report = {
        "log": log.path.name,
        "sha256": log.sha256,
        "parts": [part.path.name for part in log.parts],
        "holds": all(finding.holds for finding in findings),
        "cycles": log.cycles,
        "duration_s": round(float(e.t_s[-1]), 6) if log.cycles else 0.0,
        "sealed": {
            "ok": named["seals"].holds,
            "bytes": sum(part.seals.sealed_bytes for part in log.parts),
            "final": all(part.seals.final for part in log.parts),
            "count": sum(part.seals.count for part in log.parts),
            "key": log.parts[0].seals.public_key,
        },
        "crc_ok": not e.broken_records,
        "complete": named["completeness"].holds and named["closed"].holds,
        "recovered": log.parts[-1].recovered or None,
        "gaps": e.notes.get("gaps", []),
        "min_distance_m": _least(distance),
        "worst_phi": named["safety rows"].worst,
        "stops": e.notes.get("stops", []),
        "swaps": e.notes.get("swaps", []),
        "certificate": named["certificate"].detail,
        "session": {key: value for key, value in log.session.items() if not key.startswith("sha256 ")},
        "attachments": {name: hashlib.sha256(data).hexdigest() for name, data in log.attachments.items()},
        "rules": [_plain(finding) for finding in findings],
        "not_judged": [f.name for f in findings if f.skipped],
    }
    return with_hash(report)


def _damaged(path: Path, error: CorruptLog) -> dict[str, Any]:
    """The report on a file whose bytes are not those that were written: nothing in it can be believed."""
    told = str(error).removeprefix(f"{path}: ")
    return with_hash(
        {
            "log": path.name,
            "holds": False,
            "cycles": 0,
            "sealed": {"ok": False, "bytes": 0, "final": False},
            "crc_ok": False,
            "complete": False,
            "gaps": [],
            "min_distance_m": None,
            "worst_phi": None,
            "stops": [],
            "certificate": "not judged",
            "rules": [{"name": "integrity", "holds": False, "detail": told}],
        }
    )


def with_hash(report: dict[str, Any]) -> dict[str, Any]:
    """The report with the SHA-256 of all else in it, as canonical JSON."""
    canonical = json.dumps(report, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
    return {**report, "report_sha256": hashlib.sha256(canonical).hexdigest()}


def _plain(finding: Finding) -> dict[str, Any]:
    found = dataclasses.asdict(finding)
    for key in ("worst", "limit"):
        value = found[key]
        found[key] = float(value) if value is not None and math.isfinite(value) else None
    return found


def _least(values: np.ndarray[Any, Any]) -> float | None:
    finite = values[np.isfinite(values)]
    return round(float(finite.min()), 9) if len(finite) else None
