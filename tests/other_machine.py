"""Another machine: a network namespace that reaches us by a link of its own. Its clock can be another, too."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

WORKER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))  # each has a link of its own
HERE, THERE = f"10.213.{WORKER}.1", f"10.213.{WORKER}.2"


@contextmanager
def made() -> Iterator[str]:
    """Its name for `ip netns exec`; it reaches us at HERE. Skips the test where there can be none."""
    name = f"asc{os.getpid()}"
    if os.geteuid() != 0:
        pytest.skip("needs root to make a network namespace")
    if not _ip("netns", "add", name):
        pytest.skip("network namespaces cannot be made here")
    try:
        linked = (
            _ip("link", "add", f"{name}a", "type", "veth", "peer", "name", f"{name}b", "netns", name)
            and _ip("addr", "add", f"{HERE}/30", "dev", f"{name}a")
            and _ip("link", "set", f"{name}a", "up")
            and _ip("-n", name, "addr", "add", f"{THERE}/30", "dev", f"{name}b")
            and _ip("-n", name, "link", "set", f"{name}b", "up")
        )
        if not linked:
            pytest.skip("a link between two network namespaces cannot be made here")
        yield name
    finally:
        _ip("link", "del", f"{name}a")  # a process that is still there would keep it, and our address with it
        _ip("netns", "del", name)


def there(name: str, ahead_s: int = 0) -> list[str]:
    """What a command is led in by that shall run there, with a monotonic clock that is `ahead_s` ahead of ours."""
    clock = ["unshare", "--time", "--monotonic", str(ahead_s), "--fork"] if ahead_s else []
    return ["ip", "netns", "exec", name, *clock]


def _ip(*words: str) -> bool:
    return subprocess.run(["ip", *words], capture_output=True).returncode == 0
