from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from drivers.base import LinkError, OwnershipError
from drivers.owner import OwnerLock

HOLD = """
import sys
from drivers.owner import OwnerLock
lock = OwnerLock("robot", sys.argv[1]); lock.acquire(); print("held", flush=True); sys.stdin.read()
"""


def test_a_second_owner_learns_the_pid_of_the_first(tmp_path: Path) -> None:
    first, second = OwnerLock("robot", str(tmp_path)), OwnerLock("robot", str(tmp_path))
    first.acquire()
    with pytest.raises(OwnershipError) as caught:
        second.acquire()
    assert caught.value.pid == os.getpid()
    assert str(os.getpid()) in caught.value.hint
    OwnerLock("other robot", str(tmp_path)).acquire()
    first.release()
    second.acquire()


def test_the_lock_dies_with_its_process(tmp_path: Path) -> None:
    lock = OwnerLock("robot", str(tmp_path))
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as holder:
        assert holder.stdout is not None and holder.stdout.readline() == "held\n"
        with pytest.raises(OwnershipError) as caught:
            lock.acquire()
        assert caught.value.pid == holder.pid
        holder.kill()
    lock.acquire()


def test_a_lock_file_that_cannot_be_opened_is_a_link_error(tmp_path: Path) -> None:
    with pytest.raises(LinkError, match="cannot open the lock file") as caught:
        OwnerLock("robot", str(tmp_path / "absent")).acquire()
    assert "lock_dir" in caught.value.hint
