"""The perception process's end of the estimator: `offer` frames, take the `newest` limbs. Neither ever waits.

The estimator runs in a process of its own (`process`), asked by a thread. An answer that is not entirely in order is
none, and a line in the log; who does not answer is ended and stays so until perception starts again. People are then
told as without.
"""

from __future__ import annotations

import json
import pickle
import select
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

import numpy as np

from asc_rt.cell_cameras import PoseOptions
from asc_rt.perception.grid import View
from asc_rt.perception.pose import BACKENDS
from asc_rt.perception.pose.limbs import LIMBS, PEOPLE, Found, PoseError, Scene
from asc_rt.perception.volume import steps
from drivers.cameras.base import DepthFrame

START_S = 120.0  # loading the library and the model: 3 s; ten times as long beside two busy processes
ANSWER_NS = 10_000_000_000  # five people: 0.15 s; 1 s beside two busy processes
LONGEST_LINE = 1 << 16  # bytes; five people: 9 kB
FARTHEST = 20.0  # m
LARGEST = 0.5  # m, radius or bound
QUIET_NS = 10_000_000_000  # between two lines of the log


def scene(view: View, bound: float) -> Scene:
    """`bound`: m, of the camera's calibration."""
    far = np.maximum(view.background.astype(np.int32) - steps(view), 0).astype(np.uint16)
    return Scene(view.lens, view.rays, view.unit, view.T, far, bound)


class Link:
    def __init__(self, options: PoseOptions, scenes: Mapping[int, Scene], tell: Callable[[str], None]) -> None:
        """`scenes`: of the cameras that give pictures, by number. PoseError: the estimator must not, or cannot, run."""
        self._tell = tell
        self._told_ns = -QUIET_NS
        self._over = ""  # why it has ended
        self._asked_ns: int | None = None
        self._waiting: dict[int, DepthFrame] = {}
        self._newest: dict[int, Found] = {}
        self._turn = threading.Condition()
        command = [sys.executable, "-m", "asc_rt.perception.pose.process"]
        pipe, nowhere = subprocess.PIPE, subprocess.DEVNULL
        self._child = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=nowhere)
        try:
            version = self._start((BACKENDS[options.backend], options.model, dict(scenes)))
        except PoseError:
            self._child.kill()
            raise
        tell(f"pose: {version}, model {options.model.name} (SHA-256 {options.digest.hex()})")
        self._thread = threading.Thread(target=self._run, name="pose", daemon=True)
        self._thread.start()

    def offer(self, number: int, frame: DepthFrame) -> None:
        """Where one of that camera waits already it is the older one that is left out."""
        if self._over or frame.image is None:
            return
        asked_ns = self._asked_ns
        if asked_ns is not None and time.monotonic_ns() - asked_ns > ANSWER_NS:
            self._end(f"no answer within {ANSWER_NS * 1e-9:g} s")
        with self._turn:
            self._waiting[number] = frame
            self._turn.notify()

    def newest(self) -> list[Found]:
        """Of each camera, however old."""
        return [] if self._over else list(self._newest.copy().values())

    def close(self) -> None:
        self._end("closed")
        self._thread.join(2.0)
        assert self._child.stdin is not None and self._child.stdout is not None
        with suppress(OSError, subprocess.TimeoutExpired):
            self._child.wait(2.0)
            self._child.stdout.close()
            self._child.stdin.close()  # what was not sent cannot be

    def _start(self, setup: tuple[Any, ...]) -> str:
        self._send(setup)
        assert self._child.stdout is not None
        if not select.select([self._child.stdout], [], [], START_S)[0]:
            raise PoseError([f"perception.pose: it does not start within {START_S:g} s; see what the machine is at"])
        told = _read(self._child.stdout.readline(LONGEST_LINE))
        if "ready" in told:
            return str(told["ready"])
        code = self._child.wait() if not told else None
        died = [f"perception.pose: its process ended (exit code {code}); the kernel log may say why (memory?)"]
        raise PoseError(told.get("refused", died))

    def _run(self) -> None:
        served: dict[int, int] = {}
        assert self._child.stdout is not None
        while True:
            with self._turn:
                self._turn.wait_for(lambda: self._waiting or self._over)
                if self._over:
                    break
                number = min(self._waiting, key=lambda one: served.get(one, 0))  # each camera in its turn
                frame = self._waiting.pop(number)
            self._asked_ns = served[number] = time.monotonic_ns()
            self._send((number, frame.depth, frame.image))
            line = self._child.stdout.readline(LONGEST_LINE)
            self._asked_ns = None
            if not line.endswith(b"\n"):
                self._end("its process ended" if not line else "its answer has no end")
                break
            self._take(number, frame.t_capture_ns, line)
        if self._over != "closed":
            self._tell(f"pose: {self._over}; people are told as without until perception starts again")

    def _take(self, number: int, t_ns: int, line: bytes) -> None:
        try:
            self._newest[number] = found(number, t_ns, _read(line))
        except (ValueError, KeyError, TypeError, OverflowError) as error:
            now_ns = time.monotonic_ns()
            if now_ns - self._told_ns > QUIET_NS:
                self._told_ns = now_ns
                self._tell(f"pose: {type(error).__name__}: {error}; such an answer is not used")

    def _send(self, told: Any) -> None:
        assert self._child.stdin is not None
        with suppress(OSError):  # it is gone: reading says so
            pickle.dump(told, self._child.stdin, pickle.HIGHEST_PROTOCOL)
            self._child.stdin.flush()

    def _end(self, why: str) -> None:
        self._over = self._over or why
        self._child.kill()
        with self._turn:
            self._turn.notify()


def _read(line: bytes) -> dict[str, Any]:
    """An answer; empty: there is none."""
    with suppress(ValueError, RecursionError):
        told = json.loads(line)
        if isinstance(told, dict):
            return told
    return {}


def found(camera: int, t_ns: int, told: Mapping[str, Any]) -> Found:
    """The limbs of an answer. ValueError, KeyError, TypeError, OverflowError: it is not entirely in order."""
    if "wrong" in told:
        raise ValueError(str(told["wrong"])[:200])
    rows = told["limbs"]
    if len(rows) > PEOPLE * len(LIMBS):
        raise ValueError(f"{len(rows)} limbs, of {PEOPLE} people at most")
    names = tuple(str(name) for name, *_ in rows)
    if not {limb.name for limb in LIMBS}.issuperset(names):
        raise ValueError("limbs that nobody has")
    numbers = np.array([[*p0, *p1, radius, bound] for _, p0, p1, radius, bound in rows], float).reshape(len(rows), 8)
    ends, sizes = numbers[:, :6], numbers[:, 6:]
    if not (np.abs(ends) <= FARTHEST).all():  # nor NaN, here and below
        raise ValueError("limbs that are nowhere")
    if not ((sizes > 0).all() and (sizes <= LARGEST).all()):
        raise ValueError("limbs of an impossible size")
    return Found(camera, t_ns, names, ends[:, :3], ends[:, 3:], sizes[:, 0], sizes[:, 1])
