"""Canonical bytes: exact round trip, and every field counts."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import pytest

from asc_rt.core.params import Params


def leaves(value: Any, path: tuple[Any, ...] = ()) -> Any:
    if dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield from leaves(getattr(value, field.name), (*path, field.name))
    elif isinstance(value, tuple):
        for i, item in enumerate(value):
            yield from leaves(item, (*path, i))
    else:
        yield path, value


def changed(value: Any, path: tuple[Any, ...]) -> Any:
    if not path:
        return (
            value + "x"
            if isinstance(value, str)
            else value + 1
            if isinstance(value, int)
            else value + 1e-15 + value * 1e-12
        )
    head, *rest = path
    if isinstance(value, tuple):
        return tuple(changed(item, tuple(rest)) if i == head else item for i, item in enumerate(value))
    return dataclasses.replace(value, **{head: changed(getattr(value, head), tuple(rest))})


def test_round_trip_is_exact(bench: Any) -> None:
    params = bench.params()
    again = Params.from_canonical(params.canonical())
    assert again == params
    assert again.canonical() == params.canonical()
    assert hash(again) == hash(params)  # tuples all the way down, no lists left over from JSON


def test_every_single_field_changes_the_hash(bench: Any) -> None:
    params = bench.params()
    seen = {params.content_hash()}
    for path, _ in leaves(params):
        other = changed(params, path)
        assert Params.from_canonical(other.canonical()) == other
        seen.add(other.content_hash())
    assert len(seen) == 1 + sum(1 for _ in leaves(params))


@pytest.mark.parametrize("damage", ["missing", "unknown", "nested"])
def test_parameters_of_another_version_are_refused(bench: Any, damage: str) -> None:
    table = json.loads(bench.params().canonical())
    if damage == "missing":
        del table["safety"]["k"]
    elif damage == "unknown":
        table["safety"]["kk"] = 1.0
    else:
        table["robot"] = None
    with pytest.raises((TypeError, KeyError)):
        Params.from_canonical(json.dumps(table).encode())
