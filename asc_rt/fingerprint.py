"""What the numbers depend on besides code and inputs: processor, libraries, and the settings that choose their kernels.

Two machines with the same fingerprint must replay to the same bytes; with different ones they need not (linear algebra
and elementary functions pick their code by processor).
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
import platform
from pathlib import Path
from typing import Any

import numpy as np
import piqp

PACKAGES = ("numpy", "pin", "eigenpy", "piqp", "ruckig", "numba", "llvmlite")
SETTINGS = (  # variables that change which kernel runs; thread counts do not for matrices as small as ours
    "OPENBLAS_CORETYPE",
    "NPY_DISABLE_CPU_FEATURES",
    "NPY_ENABLE_CPU_FEATURES",
    "GLIBC_TUNABLES",
    "NUMBA_CPU_NAME",
    "NUMBA_CPU_FEATURES",
    "NUMBA_OPT",
    "NUMBA_DISABLE_JIT",
)


def fingerprint() -> dict[str, Any]:
    """Everything as one JSON-able table; `hash` is over all of it."""
    model, flags = _cpu()
    found = {
        "machine": platform.machine(),
        "cpu": model,
        "cpu_flags": flags,
        "libc": " ".join(platform.libc_ver()),
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in PACKAGES},
        "blas": _blas(),
        "piqp_binary": Path(piqp.__file__).name,  # it loads the widest one that the processor can run
        "settings": {name: os.environ[name] for name in SETTINGS if name in os.environ},
    }
    return {**found, "hash": digest(found)}


def digest(found: dict[str, Any]) -> str:
    """SHA-256 of a fingerprint without its hash."""
    plain = {key: value for key, value in found.items() if key != "hash"}
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()


def differences(a: dict[str, Any], b: dict[str, Any]) -> list[str]:
    """The keys in which two fingerprints differ."""
    return sorted(key for key in (a.keys() | b.keys()) - {"hash"} if a.get(key) != b.get(key))


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "absent"


def _blas() -> str:
    build: dict[str, Any] = np.show_config(mode="dicts")  # type: ignore[assignment]
    blas = build.get("Build Dependencies", {}).get("blas", {})
    return f"{blas.get('name', 'unknown')} {blas.get('version', '')}".strip()


def _cpu() -> tuple[str, list[str]]:
    """Model name and feature flags of the first processor; unknown where the kernel does not tell."""
    told: dict[str, str] = {}
    try:
        for line in Path("/proc/cpuinfo").read_text().split("\n\n")[0].splitlines():
            key, _, value = line.partition(":")
            told[key.strip()] = value.strip()
    except OSError:
        pass
    flags = told.get("flags", told.get("Features", ""))
    return told.get("model name", platform.processor() or "unknown"), sorted(flags.split())
