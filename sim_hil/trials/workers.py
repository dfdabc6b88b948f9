"""Where trials run: processes of this machine, or a Dask cluster. Both are executors of concurrent.futures."""

from __future__ import annotations

import ctypes
import multiprocessing
import signal
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager

from asc_rt.synthesis import cluster

PR_SET_PDEATHSIG = 1


@contextmanager
def processes(count: int) -> Iterator[Executor]:
    context = multiprocessing.get_context("spawn")  # numba's threads do not survive a fork
    with ProcessPoolExecutor(count, context, _as_worker) as pool:
        yield pool


@contextmanager
def dask(address: str) -> Iterator[Executor]:
    """Workers of the scheduler at `address`; they need this package installed. cluster.ClusterError."""
    with cluster.connect(address) as client:
        yield client.get_executor(pure=False)


def _as_worker() -> None:
    """Ctrl-C is the parent's affair; if the parent dies otherwise, so does its worker."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
