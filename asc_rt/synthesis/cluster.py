"""Chunks on a Dask cluster. `dask.distributed` is an optional extra (`cluster`) and is imported here only."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, TypeVar

from asc_rt.synthesis.sampling import IN_FLIGHT, Workers

Part = TypeVar("Part")
CONNECT_TIMEOUT_S = 10.0


class ClusterError(Exception):
    """No cluster at that address, or no library to speak to it."""


@contextmanager
def connect(address: str) -> Iterator[Any]:
    """A client of the Dask scheduler at `address`, whose workers need this package installed. ClusterError."""
    try:
        from distributed import Client
    except ImportError as error:
        raise ClusterError("--cluster needs dask: install the extra, uv sync --extra cluster") from error
    try:
        client = Client(address, timeout=CONNECT_TIMEOUT_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise ClusterError(f"--cluster: no Dask scheduler answers at {address}") from error
    with client:
        yield client


@contextmanager
def cluster(address: str) -> Iterator[Workers]:
    """Its workers, for chunks that are done in order. ClusterError."""
    with connect(address) as client:
        yield partial(_spread, client)


def _spread(client: Any, work: Callable[[int], Part], count: int) -> Iterator[Part]:
    size = max(1, sum(client.nthreads().values())) * IN_FLIGHT
    waiting: deque[Any] = deque()
    for index in range(count):
        waiting.append(client.submit(work, index, pure=False))
        if len(waiting) >= size:
            yield waiting.popleft().result()
    while waiting:
        yield waiting.popleft().result()
