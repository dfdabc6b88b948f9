"""The [driver] table of a cell with this robot."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

from drivers.fanuc_stream_motion import codec


@dataclass(frozen=True, slots=True)
class Options:
    host: str
    port: int = codec.PORT
    version: int = codec.VERSIONS[-1]  # 1: float32 set-points; 2, 3: float64
    ready_timeout: float = 10.0  # s, for the program on the robot to wait for set-points
    lock_dir: str | None = None  # of the owner lock; default: the system's directory for temporary files

    @property
    def address(self) -> str:
        return f"{self.host}:{self.port}"

    @classmethod
    def parse(cls, table: dict[str, Any]) -> Options:
        """ValueError naming every wrong option at once."""
        known = [field.name for field in fields(cls)]
        wrong = [f"unknown option {key!r} (known: {', '.join(known)})" for key in table if key not in known]
        if "host" not in table:
            wrong.append("host is missing: the robot's address, for example \"192.168.1.10\"")
        checks: dict[str, tuple[Callable[[Any], bool], str]] = {
            "host": (lambda v: isinstance(v, str) and bool(v), "a host name or address"),
            "port": (lambda v: _is_int(v) and 1 <= v <= 65535, "a UDP port, 1 to 65535"),
            "version": (lambda v: _is_int(v) and v in codec.VERSIONS, f"one of {codec.VERSIONS}"),
            "ready_timeout": (lambda v: _is_number(v) and 0 < v < 3600, "seconds, above 0"),
            "lock_dir": (lambda v: isinstance(v, str), "a directory"),
        }
        for key, (good, meaning) in checks.items():
            if key in table and not good(table[key]):
                wrong.append(f"{key} must be {meaning}, not {table[key]!r}")
        if wrong:
            raise ValueError("fanuc-j519: " + "; ".join(wrong))
        return cls(**table)


def _is_int(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
