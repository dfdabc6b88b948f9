"""What a rule of the audit says."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from logs.audit_evidence import Evidence


@dataclass(frozen=True, slots=True)
class Finding:
    name: str
    holds: bool
    detail: str
    skipped: bool = False  # it could not be judged; `detail` says why
    worst: float | None = None  # the value nearest to, or farthest beyond, the limit
    limit: float | None = None
    unit: str = ""
    moment: str = ""  # of the worst


Rule = Callable[[Evidence], Finding]


def skip(name: str, why: str) -> Finding:
    return Finding(name, True, f"not judged: {why}", skipped=True)
