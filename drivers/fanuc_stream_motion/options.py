"""The [driver] table of a cell with such a robot."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, ClassVar, TypeVar

from drivers.fanuc_stream_motion import codec
from drivers.fanuc_stream_motion.arms import ARMS
from drivers.fanuc_stream_motion.packets import PORT, Window

Check = tuple[Callable[[Any], bool], str]
AnyOptions = TypeVar("AnyOptions", bound="Options")


@dataclass(frozen=True, slots=True)
class Options:
    """What both wires need."""

    NAME: ClassVar[str] = ""
    CHECKS: ClassVar[dict[str, Check]] = {}

    host: str
    port: int = PORT
    ready_timeout: float = 10.0  # s, for the program on the robot to wait for set-points
    arm: str = ""  # one of ARMS: the tables go by the speed of its flange; its pose is compared with the robot's
    limits: bool = False  # read the controller's limit tables, tell them, and refuse set-points beyond them
    payload_share: float = 1.0  # payload set at the controller; 1 = full, which it takes if none is set
    flange_speed: float = 0.0  # m/s up to which the limits that are told hold; 0: the last stage of the tables
    tool_input: str = ""  # signals that number the tool in the changer, such as "RI[3:6]"; "": it stays 0
    lock_dir: str | None = None  # of the owner lock; default: the system's directory for temporary files

    @property
    def address(self) -> str:
        return f"{self.host}:{self.port}"

    @property
    def window(self) -> Window | None:
        return Window.parse(self.tool_input) if self.tool_input else None

    @classmethod
    def parse(cls: type[AnyOptions], table: dict[str, Any]) -> AnyOptions:
        """ValueError naming every wrong option at once."""
        known = [field.name for field in fields(cls)]
        wrong = [f"unknown option {key!r} (known: {', '.join(known)})" for key in table if key not in known]
        if "host" not in table:
            wrong.append('host is missing: the robot\'s address, for example "192.168.1.10"')
        for key, (good, meaning) in {**_COMMON, **cls.CHECKS}.items():
            if key in table and not good(table[key]):
                wrong.append(f"{key} must be {meaning}, not {table[key]!r}")
        if table.get("limits") is True and "arm" not in table:
            wrong.append(f"arm is missing: limits go by the speed of its flange; one of {tuple(ARMS)}")
        if wrong:
            raise ValueError(f"{cls.NAME}: " + "; ".join(wrong))
        return cls(**table)


@dataclass(frozen=True, slots=True)
class ClassicOptions(Options):
    NAME: ClassVar[str] = "fanuc-j519"
    CHECKS: ClassVar[dict[str, Check]] = {
        "version": (lambda v: _is_int(v) and v in codec.VERSIONS, f"one of {codec.VERSIONS}"),
    }

    version: int = codec.VERSIONS[-1]  # 1: float32 set-points; 2, 3: float64


def _is_int(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def is_port(value: object) -> bool:
    return isinstance(value, int) and _is_int(value) and 1 <= value <= 65535


def is_number(value: object, low: float, high: float) -> bool:
    number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return number and low <= value <= high  # type: ignore[operator]


def _is_row(value: object) -> bool:
    try:
        return isinstance(value, str) and (not value or Window.parse(value) is not None)
    except ValueError:
        return False


_COMMON: dict[str, Check] = {
    "host": (lambda v: isinstance(v, str) and bool(v), "a host name or address"),
    "port": (is_port, "a UDP port, 1 to 65535"),
    "ready_timeout": (lambda v: is_number(v, 1e-3, 3600), "seconds, above 0"),
    "arm": (lambda v: isinstance(v, str) and v in ARMS, f"one of {tuple(ARMS)}"),
    "limits": (lambda v: isinstance(v, bool), "true or false"),
    "payload_share": (lambda v: is_number(v, 0, 1), "a share, 0 to 1"),
    "flange_speed": (lambda v: is_number(v, 0, 20), "m/s, 0 to 20"),
    "tool_input": (_is_row, "a row of signals like 'RI[3:6]'"),
    "lock_dir": (lambda v: isinstance(v, str), "a directory"),
}
