"""Safe control of a robot cell. Importing the package chooses the folder in which the compiled kernels are cached."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path


def _kernel_cache() -> str:
    """A folder of its own for every state of the sources that kernels come from.

    numba looks at the file that a kernel is in and not at those of the kernels that it calls: with one folder for all,
    a change in kinematics.py would go on running as the old machine code inside abstraction.py.
    """
    package = Path(__file__).parent
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        text = path.read_bytes()
        if path.parent.name == "core" or b"import njit" in text:
            digest.update(path.name.encode() + text)
    return str(package / "core" / "__pycache__" / f"kernels-{digest.hexdigest()[:16]}")


os.environ["NUMBA_CACHE_DIR"] = _kernel_cache()
