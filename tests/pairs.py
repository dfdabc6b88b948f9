"""`Pairs` made of their rows."""

from __future__ import annotations

from typing import Any

import numpy as np

from asc_rt.core.types import MAX_PAIRS, Pairs

ROWS = ("robot", "human", "d", "d_dot", "M", "M_dot", "phi", "phi_dot", "floor", "achieved", "basis", "outside")


def pairs_of(**rows: Any) -> Pairs:
    """All of ROWS, each as long as the others, (p,)."""
    count = len(rows["d"])
    return with_rows(Pairs(count, np.zeros((len(ROWS), MAX_PAIRS))), **{name: rows[name] for name in ROWS})


def with_rows(pairs: Pairs, **rows: Any) -> Pairs:
    """The same pairs with other values in some rows."""
    table = np.array(pairs.table)
    for name, values in rows.items():
        whole = getattr(pairs, name).dtype == np.int64
        table[ROWS.index(name), : pairs.count] = np.asarray(values, np.int64).view(np.float64) if whole else values
    table.setflags(write=False)
    return Pairs(pairs.count, table)
