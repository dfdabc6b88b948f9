"""Name what differs between two records, field by field, and find a byte that was changed after it was written."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from asc_rt.fixed_protobuf import Buffer, Leaf
from asc_rt.record import CHECK_SIZE, RecordLayout

_POLYNOMIAL = 0xEDB88320  # of CRC-32, bits reversed


class Difference(NamedTuple):
    field: str  # "outputs.decision.u_safe[0]"
    logged: Any  # number, or name of an enum's value; floats that JSON cannot hold are text
    replayed: Any
    distance: float  # |logged - replayed| of numbers; inf between things that have none


def differences(layout: RecordLayout, logged: Buffer, replayed: Buffer, parts: tuple[str, ...]) -> Iterator[Difference]:
    """All fields of these parts (`state`, `outputs`, ...) in which two records differ, in the record's order.

    Bytes decide: -0.0 differs from 0.0, and equal NaNs do not differ.
    """
    for leaf in itertools.chain.from_iterable(_unequal(layout, name, logged, replayed) for name in parts):
        span = slice(leaf.offset, leaf.offset + leaf.size)
        if logged[span] == replayed[span]:
            continue
        a, b = _values(leaf, logged), _values(leaf, replayed)
        for index in np.argwhere(a.view("V8") != b.view("V8")) if leaf.shape else [()]:
            yield _difference(leaf, tuple(index), a[tuple(index)], b[tuple(index)])


def _unequal(layout: RecordLayout, name: str, logged: Buffer, replayed: Buffer) -> Iterable[Leaf]:
    """The fields of a part; none if all its bytes are equal, as they mostly are."""
    part = layout.parts.get(name)
    if part is None:
        return layout.leaves[-1:]  # the check
    return () if part.bytes_of(logged) == part.bytes_of(replayed) else part.leaves


def altered(layout: RecordLayout, record: Buffer) -> Difference | None:
    """What was changed in a record since it was packed; None: nothing.

    A CRC tells more than that something is wrong: its error value (the syndrome) belongs to one position and one
    value of a single changed byte (with a chance of 4e-4 that it also fits a second place). So one changed byte is
    named with the value that it had; of a larger change only the fact is known.
    """
    syndrome = layout.syndrome(record)
    if syndrome == 0:
        return None
    place = _locate(syndrome, layout.size - CHECK_SIZE - 1)
    if place is None:
        return Difference("record", "altered in several bytes", "unknown", math.inf)
    offset, error = place
    original = bytearray(record)
    original[offset] ^= error
    leaf = next((x for x in layout.leaves if x.offset - len(x.tag) <= offset < x.offset + x.size), layout.leaves[-1])
    found = list(differences(layout, record, original, (leaf.path.split(".")[0],)))
    return found[0] if found else Difference(f"{leaf.path} (its tag)", record[offset], original[offset], math.inf)


def _locate(syndrome: int, length: int) -> tuple[int, int] | None:
    """(offset, XOR of the byte) of the single changed byte among `length` bytes and the CRC behind them."""
    for shift in range(0, 32, 8):
        if syndrome & ~(0xFF << shift) == 0:
            return length + shift // 8, syndrome >> shift
    table = _crc_table()
    errors = table.copy()  # CRC of a message of zeros that ends in each possible byte
    for offset in range(length - 1, -1, -1):
        (hits,) = np.nonzero(errors == syndrome)
        if len(hits):
            return offset, int(hits[0])
        errors = (errors >> np.uint32(8)) ^ table[errors & np.uint32(0xFF)]
    return None


def _crc_table() -> np.ndarray[Any, np.dtype[np.uint32]]:
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, (table >> np.uint32(1)) ^ np.uint32(_POLYNOMIAL), table >> np.uint32(1))
    return table


def _values(leaf: Leaf, record: Buffer) -> np.ndarray[Any, Any]:
    count = math.prod(leaf.shape)
    return np.frombuffer(bytes(record[leaf.offset : leaf.offset + leaf.size]), leaf.format, count).reshape(leaf.shape)


def _difference(leaf: Leaf, index: tuple[int, ...], logged: Any, replayed: Any) -> Difference:
    field = leaf.path + "".join(f"[{i}]" for i in index)
    a, b = logged.item(), replayed.item()
    if issubclass(leaf.kind, IntEnum | bool):
        return Difference(field, _shown(leaf, a), _shown(leaf, b), math.inf)
    distance = abs(a - b) if math.isfinite(a) and math.isfinite(b) else math.inf
    return Difference(field, _shown(leaf, a), _shown(leaf, b), distance)


def _shown(leaf: Leaf, value: Any) -> Any:
    if issubclass(leaf.kind, IntEnum):
        return leaf.kind(value).name if value in {*leaf.kind} else value
    if issubclass(leaf.kind, bool) and value in (0, 1):
        return bool(value)
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value
