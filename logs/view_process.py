"""The viewer's processes: bound to this machine, silent towards the world, ended with us.

Rerun's own ways of starting listen on all interfaces and report use to its maker, so the program is started directly,
with an address to bind and a private configuration folder in which reporting is off.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.parse
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import rerun_cli  # type: ignore[import-untyped]
from rerun.experimental import ViewerClient

from logs.mcap_scan import LogError
from logs.view_layout import TIMELINE

PROGRAM = str(Path(rerun_cli.__file__).parent / "rerun")
HOST = "127.0.0.1"
START_TIMEOUT_S, LOAD_TIMEOUT_S, END_TIMEOUT_S = 30.0, 60.0, 5.0
SETTLE_S = 1.0  # the picture is taken this long after everything is loaded: texts and shapes take a few frames
POLL_S = 0.1
PICTURE = "1600x1000"
NO_ADAPTER = "No graphics adapter was found"

_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None)


T = TypeVar("T")


class ViewError(LogError):
    """The recording cannot be shown; says in one line what is missing."""


@dataclass(slots=True)
class Viewer:
    """A running viewer, and what it wrote."""

    process: subprocess.Popen[bytes]
    output: Path

    def complaint(self) -> str:
        """Why it ended, in one line."""
        text = self.output.read_text(errors="replace")
        if NO_ADAPTER in text:
            return "no graphics driver for pictures: apt-get install mesa-vulkan-drivers libvulkan1"
        lines = [line for line in text.splitlines() if "panicked" in line or "rror" in line]
        return f"the viewer ended: {lines[0] if lines else f'exit code {self.process.poll()}'}"

    def wait(self) -> None:
        """Until it is closed, or Ctrl-C. ViewError: it did not work."""
        with contextlib.suppress(KeyboardInterrupt):
            if self.process.wait() != 0:
                raise ViewError(self.complaint())


@contextlib.contextmanager
def viewer(*arguments: str) -> Iterator[Viewer]:
    """`rerun ARGUMENTS`, ended when the block is left."""
    with tempfile.TemporaryDirectory(prefix="asc-view-") as folder:
        _switch_reporting_off(Path(folder, "rerun"))
        environment = {**os.environ, "XDG_CONFIG_HOME": folder, "NO_COLOR": "1", "RUST_LOG": "warn"}
        environment.setdefault("XDG_RUNTIME_DIR", folder)
        output = Path(folder, "output")
        with open(output, "wb") as file:
            command = [PROGRAM, "--bind", HOST, "--hide-welcome-screen", *arguments]
            process = subprocess.Popen(command, env=environment, stdout=file, stderr=file, preexec_fn=_end_with_parent)
        try:
            yield Viewer(process, output)
        finally:
            process.terminate()
            try:
                process.wait(END_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _end_with_parent() -> None:
    """In the child: SIGTERM when we die, however we die."""
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)


def _switch_reporting_off(folder: Path) -> None:
    """As the program's own `analytics disable` leaves it; that command would itself write a report first."""
    folder.mkdir()
    config = folder / "analytics.json"
    paths = {"config_file_path": str(config), "data_dir_path": str(folder)}
    config.write_text(json.dumps({"analytics_enabled": False, "analytics_id": "", "metadata": {}, **paths}))


def need_display(instead: str) -> None:
    """ViewError: a window cannot be opened here."""
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ViewError(f"no display for a window: use {instead}")


def browser_arguments(port: int) -> list[str]:
    """For a viewer in the browser instead of a window; tells where to find it. `port`: where the data come from."""
    web_port = free_port()
    source = urllib.parse.quote(address(port), safe="")
    print(f"open http://{HOST}:{web_port}/?url={source} - Ctrl-C ends", file=sys.stderr)
    return ["--serve-web", "--web-viewer-port", str(web_port)]


def address(port: int) -> str:
    return f"rerun+http://{HOST}:{port}/proxy"


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        port: int = probe.getsockname()[1]
    return port


def screenshot(rrd: Path, at_ns: int) -> bytes:
    """PNG of the whole layout with the cursor at `at_ns` after the start. No display is needed. ViewError."""
    port = free_port()
    with viewer("--headless", "--renderer", "vulkan", "--window-size", PICTURE, "--port", str(port)) as running:
        client = _connect(running, port)
        client.open(str(rrd))
        recording = wait_for(lambda: _loaded(client), running, LOAD_TIMEOUT_S)
        client.set_time(TIMELINE, duration=np.timedelta64(at_ns, "ns"), play_state="paused", recording=recording)
        time.sleep(SETTLE_S)
        return client.take_screenshot()


def _connect(running: Viewer, port: int) -> ViewerClient:
    def attempt() -> ViewerClient | None:
        try:
            client = ViewerClient.connect(address(port))
            client.get_state()
        except (RuntimeError, OSError):
            return None
        return client

    return wait_for(attempt, running)


def _loaded(client: ViewerClient) -> str | None:
    """The recording, once all of it is there."""
    state = client.get_state()
    ready = [r.store_id for r in state.recordings if any(t.name == TIMELINE for t in r.timelines)]
    return ready[-1] if ready and not state.loading else None


def wait_for(attempt: Callable[[], T | None], running: Viewer, timeout_s: float = START_TIMEOUT_S) -> T:
    """What `attempt` brings once it brings something. ViewError: the viewer ended before, or takes too long."""
    deadline = time.monotonic() + timeout_s
    while (found := attempt()) is None:
        if running.process.poll() is not None:
            raise ViewError(running.complaint())
        if time.monotonic() > deadline:
            raise ViewError(f"the viewer did not get ready within {timeout_s:g} s")
        time.sleep(POLL_S)
    return found
