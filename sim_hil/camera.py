"""The simulated depth cameras of a cell as a process: they look at the arm and the person where these really are.

    python -m sim_hil camera CELL

`sim/truth` and `sim/person` say where; each camera is a depth stream (depth_camera.py) where the cell's own
[perception.camera.NAME.device] looks for it. Their true poses are in [sim.camera.NAME]: what the cell believes of them
is its calibration's affair.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from asc_rt import launch, realtime, topics
from asc_rt.bus import Bus, BusError, open_client
from asc_rt.config import Cell, ConfigError, load_cell
from calibration.geometry import look_at
from sim_hil import fault_script
from sim_hil.camera_faults import Fault, struck
from sim_hil.depth import Eye, Optics, Scene
from sim_hil.depth_camera import StreamServer
from sim_hil.human import READY_PERIOD_NS, Rhythm
from sim_hil.person import Array, Capsules
from sim_hil.world import decode, extrapolate

PRIORITY = 10  # SCHED_FIFO, below everything else: a late picture is an old one, nothing worse
LONGEST_EXTRAPOLATION = 0.05  # s


@dataclass(frozen=True, slots=True)
class Mount:
    """One [sim.camera.NAME] table."""

    name: str
    serial: str
    T_base_cam: Array  # (4, 4), the truth
    host: str
    port: int


@dataclass(frozen=True, slots=True)
class Settings:
    """The [sim.camera] table."""

    rate_hz: float
    latency_ms: float  # from mid-exposure to sending, at least
    clock_behind_ms: float  # its stamps, behind the arm's clock
    seed: int
    optics: Optics
    start: Array  # rad, where the arm stands until the plant tells
    mounts: tuple[Mount, ...]

    @classmethod
    def of(cls, cell: Cell) -> Settings:
        """ValueError: one line per fault."""
        table = dict(cell.sim.get("camera", {}))
        devices = {camera.name: camera.device for camera in cell.perception.cameras} if cell.perception else {}
        faults, mounts = [], []
        for name, entry in [(k, v) for k, v in table.items() if isinstance(v, dict)]:
            del table[name]
            try:
                device = devices[name]
                host, port = device.get("host", "127.0.0.1"), device.get("port", 0)
                mounts.append(Mount(name, entry["serial"], true_pose(entry), host, port))
            except (KeyError, TypeError, ValueError) as error:
                faults.append(
                    f"sim.camera.{name}: {error}; serial, at and target or pose (4 x 4); a name of [perception.camera]"
                )
        numbers = {
            "rate_hz": 15.0,
            "latency_ms": 20.0,
            "clock_behind_ms": 0.0,
            "seed": 1,
            "width": 160,
            "height": 120,
            "focal_px": 112.0,
        }
        start = table.pop("start_deg", [0.0] * cell.params.n)
        for key, value in table.items():
            if key not in numbers:
                faults.append(f"sim.camera.{key}: unknown; known are {', '.join(numbers)}, start_deg and cameras")
            elif isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < 1e6:
                faults.append(f"sim.camera.{key}: {value!r} is not a number >= 0")
        if not mounts:
            faults.append("sim.camera: no camera in it; one table [sim.camera.NAME] for each")
        if np.shape(start) != (cell.params.n,):
            faults.append(f"sim.camera.start_deg: {start!r} are not {cell.params.n} angles")
        if faults:
            raise ValueError("\n".join(faults))
        got = numbers | table
        focal = float(got["focal_px"])
        optics = Optics(int(got["width"]), int(got["height"]), focal, focal)
        return cls(
            float(got["rate_hz"]),
            float(got["latency_ms"]),
            float(got["clock_behind_ms"]),
            int(got["seed"]),
            optics,
            np.radians(start),
            tuple(mounts),
        )


def true_pose(entry: dict[str, Any]) -> Array:
    """(4, 4) T_base_cam of a [sim.camera.NAME] table. KeyError, ValueError: it says none."""
    if "pose" in entry:
        return np.array(entry["pose"], float).reshape(4, 4)
    return look_at(entry["at"], entry["target"])


class Stage:
    """Arm and person as they really are now."""

    def __init__(self, cell: Cell, settings: Settings, bus: Bus) -> None:
        self.scene = Scene(cell.params)
        self.scene.pose(settings.start)
        self._arm, self._people = bus.latest(topics.PLANT_TRUTH.key), bus.latest(topics.PERSON_TRUTH.key)
        self._truth: dict[str, Any] | None = None
        self._person: tuple[int, Capsules] | None = None

    def set(self, t_ns: int) -> None:
        """At t_ns."""
        if (data := self._arm.take()) is not None:
            self._truth = json.loads(data)
        if (data := self._people.take()) is not None:
            self._person = decode(data) or self._person
        if self._truth is not None:
            seconds = min(max((t_ns - self._truth["t_ns"]) * 1e-9, 0.0), LONGEST_EXTRAPOLATION)
            self.scene.pose(np.array(self._truth["q"]) + seconds * np.array(self._truth["dq"]))
        if self._person is not None:
            told_ns, person = self._person
            self.scene.set_person(extrapolate(person, (t_ns - told_ns) * 1e-9))


def serve(cell: Cell, settings: Settings, bus: Bus, script: Sequence[Fault], stop: list[int]) -> None:
    """Until `stop` is not empty. OSError: a port is in use."""
    period_ns, latency_ns = round(1e9 / settings.rate_hz), round(settings.latency_ms * 1e6)
    behind_ns = round(settings.clock_behind_ms * 1e6)
    stage = Stage(cell, settings, bus)
    eyes = {
        m.name: Eye(stage.scene, m.T_base_cam, settings.optics, settings.seed + i)
        for i, m in enumerate(settings.mounts)
    }
    servers = {
        m.name: StreamServer(m.host, m.port, settings.optics, m.serial, period_ns, latency_ns) for m in settings.mounts
    }
    ready, wrongs = bus.publisher(topics.ready("camera").key), bus.queue(topics.CAMERA_FAULT.key)
    script = list(script)
    try:
        for server in servers.values():
            server.open()
        print(f"ready camera: {', '.join(servers)}, {settings.rate_hz:g} Hz", flush=True)
        began = time.monotonic_ns()
        frame, said = Rhythm(began, period_ns), Rhythm(began, READY_PERIOD_NS)
        while not stop:
            if said.take(time.monotonic_ns()) is not None:
                ready.put_json({"device": "camera", "pid": os.getpid()})
            now_ns = time.monotonic_ns()
            if frame.take(now_ns) is None:
                time.sleep(max(min(frame.due_ns, said.due_ns) - time.monotonic_ns(), 0) * 1e-9)
                continue
            stage.set(now_ns)
            t = (now_ns - began) * 1e-9
            script += [replace(f, at_s=t) for f in fault_script.heard(wrongs.take, Fault, topics.CAMERA_FAULT.key)]
            for name, wrong, moved in struck(script, list(eyes), t):
                servers[name].faults = wrong
                eyes[name].move(moved)
            pictures = {name: eye.sense() for name, eye in eyes.items()}
            time.sleep(max(now_ns + latency_ns - time.monotonic_ns(), 0) * 1e-9)
            for name, picture in pictures.items():
                servers[name].send(picture, now_ns - behind_ns)
    finally:
        for server in servers.values():
            server.close()


def main(argv: list[str]) -> int:
    """0 after SIGTERM or SIGINT, 2 for bad input, 1 without a bus or a port."""
    parser = argparse.ArgumentParser(prog="python -m sim_hil camera")
    parser.add_argument("cell")
    launch.add_overrides(parser)
    parser.add_argument("--faults", type=Path, metavar="FILE", help="script of faults, TOML with [[faults]]")
    given = parser.parse_args(argv)
    stop = launch.told_to_end()
    try:
        cell = load_cell(given.cell, given.set)
        settings = Settings.of(cell)
        script = fault_script.read(given.faults, Fault) if given.faults else []
    except (ConfigError, ValueError) as error:
        print(error, file=sys.stderr)
        return 2
    try:
        with open_client(cell.bus_endpoint) as bus:
            realtime.set_up(PRIORITY, None)
            serve(cell, settings, bus, script, stop)
    except BusError as error:
        print(f"camera: {error}; {error.hint}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"camera: cannot listen: {error}; is another session running?", file=sys.stderr)
        return 1
    return 0
