"""Scripts of faults, of whatever device: tables in its cell or in a TOML file of their own."""

from __future__ import annotations

import json
import sys
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, Protocol, TypeVar


class Kind(Protocol):
    """A dataclass of the faults of one device."""

    @classmethod
    def parse(cls, entry: object) -> Any:
        """ValueError, TypeError: not a fault."""


Fault = TypeVar("Fault", bound=Kind)


def keys(kind: type) -> Sequence[str]:
    return tuple(field.name for field in fields(kind))


def parse(entries: object, where: str, kind: type[Fault]) -> list[Fault]:
    """ValueError: one line for each entry that is no fault."""
    script, wrong = [], []
    for number, entry in enumerate(entries if isinstance(entries, list) else [entries], 1):
        try:
            script.append(kind.parse(entry))
        except (TypeError, ValueError) as error:
            wrong.append(f"{where}: fault {number}: {error}")
    if wrong:
        raise ValueError("\n".join(wrong))
    return script


def read(path: Path, kind: type[Fault]) -> list[Fault]:
    """The [[faults]] of a TOML file. ValueError: it cannot be read, or one of them is none; one line each."""
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise ValueError(f"{path}: malformed TOML: {error}") from error
    if set(table) != {"faults"}:
        raise ValueError(f"{path}: [[faults]] and nothing else is wanted, each with {', '.join(keys(kind))}")
    return parse(table["faults"], str(path), kind)


def heard(take: Callable[[], bytes | None], kind: type[Fault], key: str = "sim/fault") -> Iterator[Fault]:
    """What came over the bus since it was asked last, to happen now; what is no fault is told on stderr."""
    while (data := take()) is not None:
        try:
            yield from parse(json.loads(data), key, kind)
        except ValueError as error:
            print(error, file=sys.stderr, flush=True)
