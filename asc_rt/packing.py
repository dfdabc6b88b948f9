"""One function that packs a whole record, written out as source and compiled.

`fixed_protobuf` says which pieces a record has: what is the same in every one, what is not, and what may be absent.
"""

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, NoReturn


class RecordError(ValueError):
    """A value that does not fit into the record, or bytes that are not a record."""


@dataclass(frozen=True, slots=True)
class Value:
    """What differs from record to record: its code of `struct` and the source of the expression that gives it."""

    code: str
    source: str


@dataclass(frozen=True, slots=True)
class Choice:
    """What has more than one form, all of one size: the expression that finds it, its `name` from there on, and
    conditions on that with the pieces for each; the last, "", holds where no other does."""

    it: str
    name: str
    cases: list[tuple[str, list[Piece]]]


Piece = bytes | Value | Choice  # bytes: tags, and values that are always the same
Names = dict[str, Any]  # the objects that sources speak of
MOST = 28  # arguments of one call: of more than 30 the interpreter makes a list first


def compiled(pieces: Iterable[Piece], arguments: str, names: Names) -> Callable[..., None]:
    """The function of `into`, `at` and `arguments` that packs the pieces, one after the other, into memory.

    The record is written in every cycle, in caches that the decision has left cold: what counts is how many steps and
    objects it takes. Therefore everything is written out, without a tuple of the values and without a call for each
    message (MEASURED, cold: 20 us; with shared code for the arrays of a message 40 us); neighbours that never differ
    are one; a single byte is a number, of which the interpreter has only one, and not a string of its own.
    """
    names = {**names, "misfit": misfit}
    lines = [f"def pack(into, at, {arguments}):", *_lines(pieces, 0, names)[0]]
    exec("\n    ".join(lines), names)
    made: Callable[..., None] = names["pack"]
    return made


def _lines(pieces: Iterable[Piece], offset: int, names: Names) -> tuple[list[str], int]:
    """Statements that pack the pieces at `offset`, and where they end. `names` receives the functions called."""
    lines: list[str] = []
    for is_choice, group in itertools.groupby(pieces, lambda piece: isinstance(piece, Choice)):
        if not is_choice:
            values = list(_joined(group))
            for first in range(0, len(values), MOST):
                line, offset = _call(values[first : first + MOST], offset, names)
                lines.append(line)
            continue
        for choice in (piece for piece in group if isinstance(piece, Choice)):
            lines.append(f"{choice.name} = {choice.it}")
            word, end = "if", offset
            for condition, form in choice.cases:
                inner, end = _lines(form, offset, names)
                lines += [f"{word} {condition}:" if condition else "else:", *(f"    {line}" for line in inner)]
                word = "elif"
            offset = end
    return lines, offset


def _joined(pieces: Iterable[Piece]) -> Iterator[Value]:
    for constant, group in itertools.groupby(pieces, lambda piece: isinstance(piece, bytes)):
        if constant:
            joined = b"".join(piece for piece in group if isinstance(piece, bytes))
            yield Value("B", f"{joined[0]}") if len(joined) == 1 else Value(f"{len(joined)}s", repr(joined))
        else:
            yield from (piece for piece in group if isinstance(piece, Value))


def _call(values: list[Value], offset: int, names: Names) -> tuple[str, int]:
    layout, name = struct.Struct("<" + "".join(value.code for value in values)), f"pack_{len(names)}"
    names[name] = layout.pack_into
    place = f"at + {offset}" if offset else "at"
    return f"{name}(into, {place}, {', '.join(value.source for value in values)})", offset + layout.size


def misfit(path: str, what: str) -> NoReturn:
    raise RecordError(f"{path}: {what}")
