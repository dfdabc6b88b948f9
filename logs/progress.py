"""How far long work is: a bar on a terminal, elsewhere a plain line now and then."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from typing import Any

LINE_S = 5.0  # between two lines; short work says nothing


def progress(unit: str) -> Callable[[Iterable[Any]], Iterable[Any]]:
    """Goes over things and tells on stderr how many of them are done."""
    if not sys.stderr.isatty():
        return lambda items: _lines(items, unit)
    from tqdm import tqdm

    return lambda items: tqdm(items, unit=f" {unit}")


def _lines(items: Iterable[Any], unit: str) -> Iterator[Any]:
    total = f" of {len(items)}" if isinstance(items, Sized) else ""
    told = time.monotonic()
    for done, item in enumerate(items):
        if time.monotonic() - told > LINE_S:
            told = time.monotonic()
            print(f"{done}{total} {unit}", file=sys.stderr, flush=True)
        yield item
