"""One robot, one controller: an advisory lock that the kernel drops when its process dies, however it dies."""

from __future__ import annotations

import fcntl
import os
import re
import tempfile
from pathlib import Path

from drivers.base import LinkError, OwnershipError


class OwnerLock:
    """Exclusive ownership of the robot called `name` among the processes of this machine."""

    def __init__(self, name: str, directory: str | None = None) -> None:
        self._path = Path(directory or tempfile.gettempdir()) / f"asc-{re.sub(r'[^A-Za-z0-9.-]', '_', name)}.lock"
        self._fd: int | None = None

    def acquire(self) -> None:
        """OwnershipError: another driver holds it. LinkError: the lock file cannot be opened. Idempotent."""
        if self._fd is not None:
            return
        try:
            fd = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise LinkError(
                f"cannot open the lock file {self._path}: {error.strerror}",
                hint="give the driver another lock_dir or remove that file",
            ) from error
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.pread(fd, 32, 0)
            os.close(fd)
            pid = int(holder) if holder.strip().isdigit() else 0
            raise OwnershipError(f"process {pid} already commands this robot ({self._path.name})", pid) from None
        os.ftruncate(fd, 0)
        os.pwrite(fd, str(os.getpid()).encode(), 0)
        self._fd = fd

    def release(self) -> None:
        """Idempotent. The file stays: removing it would let two processes lock two files of the same name."""
        if self._fd is not None:
            os.close(self._fd)
            self._fd = None
