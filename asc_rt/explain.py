"""Validation errors as one line each: the key, what is wrong (value and unit), what would be right."""

from __future__ import annotations

import difflib
import types
import typing
from collections.abc import Sequence
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

# Longest suffix first: d_min_m ends in _m, velocity_m_s in _m_s.
UNITS = {
    "_deg_s3": "deg/s3", "_deg_s2": "deg/s2", "_deg_s": "deg/s", "_deg": "deg", "_m_s2": "m/s2", "_m_s": "m/s",
    "_nm": "Nm", "_ms": "ms", "_kg": "kg", "_hz": "Hz", "_m": "m",
}  # fmt: skip
METRES = ("p0", "p1", "radius", "com")


def suggestion(word: str, known: Sequence[str]) -> str:
    """ " did you mean 'x'?" for the nearest known word, or nothing."""
    near = difflib.get_close_matches(word, known, n=1, cutoff=0.6)
    return f" did you mean {near[0]!r}?" if near else ""


def explain(model: type[BaseModel], error: ValidationError) -> list[str]:
    """One line for each fault that pydantic found in `model`."""
    return [_line(model, dict(item)) for item in error.errors(include_url=False)]


def _line(model: type[BaseModel], item: dict[str, Any]) -> str:
    path = [part for part in item["loc"] if isinstance(part, int) or part not in ("str", "dict[str,str]")]
    kind, value, rules = item["type"], item["input"], item.get("ctx", {})
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in path).lstrip(".")
    unit = _unit(path)
    if kind == "extra_forbidden":
        known = _known(model, path[:-1])
        return f"{key}: unknown key;{suggestion(str(path[-1]), known)} known: {', '.join(known)}"
    right = _right(model, path, unit)
    if kind == "missing":
        return f"{key}: missing; {right}"
    if kind == "literal_error":
        return f"{key}: {value!r}{unit} is not possible; one of {rules['expected']}{unit}".replace("'", "")
    if kind == "finite_number":
        return f"{key}: {value} is not a finite number; {right}"
    if kind in ("greater_than_equal", "less_than_equal"):
        return f"{key}: {value:g}{unit} is out of range; {right} (check sign and unit)"
    if kind in ("too_short", "too_long"):
        return f"{key}: {rules['actual_length']} values; {right}"
    if kind == "string_pattern_mismatch":
        return f'{key}: {value!r} is not of the right form; for example "tcp/127.0.0.1:17447"'
    return f"{key}: {value!r} is wrong; {right}"


def _unit(path: Sequence[Any]) -> str:
    """ " m" for ["safety", "d_min_m"]; empty without a unit."""
    name = next((part for part in reversed(path) if isinstance(part, str)), "")
    if name in METRES:
        return " m"
    return next((f" {unit}" for suffix, unit in UNITS.items() if name.endswith(suffix)), "")


def _known(model: type[BaseModel], path: Sequence[Any]) -> list[str]:
    kind: Any = model
    for part in path:
        kind = _inside(kind, part)
    return sorted(kind.model_fields) if isinstance(kind, type) and issubclass(kind, BaseModel) else []


def _inside(kind: Any, part: Any) -> Any:
    """The type under key or index `part` of `kind`."""
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return _annotation(kind.model_fields[part]) if part in kind.model_fields else None
    args = typing.get_args(_bare(kind))
    if isinstance(part, int):
        return args[part] if typing.get_origin(_bare(kind)) is tuple and part < len(args) else (args or [None])[0]
    return None


def _annotation(field: FieldInfo) -> Any:
    return typing.Annotated[field.annotation, *field.metadata] if field.metadata else field.annotation


def _bare(kind: Any) -> Any:
    """Without rules, and without "or None"."""
    if typing.get_origin(kind) in (typing.Annotated, types.UnionType):
        return _bare(typing.get_args(kind)[0])
    return kind


def _right(model: type[BaseModel], path: Sequence[Any], unit: str) -> str:
    """What would be right at `path`, from the model itself."""
    kind: Any = model
    for part in path:
        kind = _inside(kind, part)
    return _describe(kind, unit)


def _describe(kind: Any, unit: str) -> str:
    rules = [m for outer in getattr(kind, "__metadata__", ()) for m in (outer, *getattr(outer, "metadata", ()))]
    low = next((m.ge for m in rules if hasattr(m, "ge")), None)
    high = next((m.le for m in rules if hasattr(m, "le")), None)
    bare = _bare(kind)
    if typing.get_origin(bare) is typing.Literal:
        return f"one of {', '.join(str(v) for v in typing.get_args(bare))}{unit}"
    if bare in (int, float):
        noun = "a whole number" if bare is int else "a number"
        return noun if low is None else f"{noun} from {low:g} to {high:g}{unit}"
    if bare is bool:
        return "true or false"
    if typing.get_origin(bare) is tuple:
        args = typing.get_args(bare)
        return f"a list of {len(args)}, each {_describe(args[0], unit)}"
    if typing.get_origin(bare) is list:
        return f"a list, each {_describe(typing.get_args(bare)[0], unit)}"
    if isinstance(bare, type) and issubclass(bare, BaseModel):
        return f"a table with {', '.join(bare.model_fields)}"
    return "a text"
