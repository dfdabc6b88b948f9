"""What perception loads before its first picture."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from asc_rt.config import load_cell
from asc_rt.perception import process


def test_somebody_has_been_seen_before_the_first_picture_counts() -> None:
    """Or the kernels of the first person are loaded while they walk up: MEASURED, 0.2 s late, compiled 1 s."""
    background, seen = np.full((48, 64), 3000, np.uint16), []
    observer = SimpleNamespace(observe=lambda t_ns, depths, q: seen.append((t_ns, depths)))
    eyes = [SimpleNamespace(view=SimpleNamespace(background=background))] * 2
    sensor: Any = SimpleNamespace(observer=observer, eyes=eyes)
    process.warm_up(sensor, load_cell("fanuc-sim"))
    nearer = [all(depth is not None and (depth < 2000).sum() > 500 for depth in depths) for _, depths in seen]
    blind = [all(depth is None for depth in depths) for _, depths in seen]
    assert sum(nearer) == sum(blind) == 1 and not nearer[0]
    assert [t_ns for t_ns, _ in seen] == sorted({t_ns for t_ns, _ in seen})
