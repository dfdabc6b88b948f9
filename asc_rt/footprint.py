"""What the control process keeps in memory.

Linux brings in the pages of a library as they are touched, and counts and locks them as long as the process lives.
LLVM and Pinocchio are touched at the start only; without them a third of the memory is left. MEASURED: see
asc_rt/README.md, "What a decision costs".
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path

# Parts of paths: links the kernels; Pinocchio and all that it needs, reads the URDF. The loop runs no line of either.
START_ONLY = ("libllvmlite", "cmeel.prefix")
ANEW = "ASC_STARTED_ANEW"  # environment of a process that has: once is enough where kernels cannot be kept

_MADV_DONTNEED = 4
_MAPPING = re.compile(r"^(\w+)-(\w+) (\S+) \S+ \S+ \S+ *(.*)\n((?:\w+:.*\n)+)", re.MULTILINE)


def lean_start() -> None:
    """Start numba alone, before other imports come on top of what LLVM takes for that. Must run before numba is
    imported: it would load SciPy for the sake of kernels with linear algebra, which we have none of."""
    if "numba" in sys.modules:
        raise RuntimeError("numba was imported before it could be started lean")
    sys.modules["scipy"] = None  # type: ignore[assignment]  # as if it were not installed
    import numpy as np

    from asc_rt.core.kinematics import Chain, forward
    from asc_rt.core.types import vector

    zero = vector(np.zeros(1))
    forward(Chain(np.eye(3)[None], np.zeros((1, 3)), np.ones((1, 3))), zero, zero)  # any kernel: the first starts all
    release()


def release() -> None:
    """Give back the pages of START_ONLY, locked or not. The libraries stay: what is touched again comes back, from
    disk if it has to. Only pages that are as in the file, so nothing can be lost; what cannot be given back stays."""
    libc = ctypes.CDLL(None)
    for start, end, rights, path, figures in _MAPPING.findall(Path("/proc/self/smaps").read_text()):
        as_in_file = "w" not in rights and re.search(r"^Anonymous: +0 kB", figures, re.MULTILINE)
        if as_in_file and any(name in path for name in START_ONLY):
            place = ctypes.c_void_p(int(start, 16)), ctypes.c_size_t(int(end, 16) - int(start, 16))
            libc.munlock(*place)
            libc.madvise(*place, _MADV_DONTNEED)


@contextlib.contextmanager
def anew_if_compiled() -> Iterator[None]:
    """Start the process anew, from its first line, if a kernel had to be compiled in here: the compiler never gives
    back what it took, 280 MB (MEASURED), and the kernels are in their cache now. Not after anything was opened: it
    would be left behind."""
    from numba.core import event

    with event.install_recorder("numba:compile") as compiled:
        yield
    if compiled.buffer and ANEW not in os.environ:
        os.environ[ANEW] = "1"
        sys.stdout.flush()
        sys.stderr.flush()
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])
