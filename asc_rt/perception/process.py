"""The perception process: cameras -> HumanState on the bus. `python -m asc_rt.perception CELL`.

Exit code 0: ended as asked; 1: no bus; 2: bad input, or a camera that must not be used.
"""

from __future__ import annotations

import argparse
import json
import os
import queue
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from typing import Any

import cv2
import numpy as np

from asc_rt import launch, realtime, topics
from asc_rt.bus import Bus, BusError, Queue, open_client
from asc_rt.cell_cameras import PoseOptions
from asc_rt.clock_sync import CellClock
from asc_rt.config import Cell, ConfigError, load_cell
from asc_rt.core.system import System
from asc_rt.core.types import MAX_CAPSULES
from asc_rt.human_codec import clock_id
from asc_rt.perception.background import BackgroundError
from asc_rt.perception.cameras import CameraError, Frames, Opened, Reader, observer_of, open_all
from asc_rt.perception.pictures import Pictures
from asc_rt.perception.pose.limbs import Found, PoseError
from asc_rt.perception.pose.link import Link, scene
from asc_rt.perception.sensor import Identity, Sensor, around
from asc_rt.remote import join
from drivers.cameras.base import Depth, DepthFrame, frozen

PRIORITY = 20  # SCHED_FIFO, below all that moves something
READY_NS = 500_000_000
WAIT_S = 0.01  # for the next frame
Offer = Callable[[int, DepthFrame], None]  # number of the camera, frame
Limbs = Callable[[], Sequence[Found]]
TOGETHER = 0.4  # of a period, for which the frame of one camera waits for the others'


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m asc_rt.perception", description="Cameras to people with bounds.")
    parser.add_argument("cell", help="cell file or name of a cell")
    launch.add_overrides(parser)
    parser.add_argument("--remote", action="store_true", help="the cell runs on another machine: [bus.remote]")
    given = parser.parse_args(argv)
    stop = launch.told_to_end()
    try:
        cell = load_cell(given.cell, given.set)
        if cell.perception is None:
            raise ConfigError([f"{cell.path}: perception: missing; a cell that sees has a table [perception]"])
        with join(cell, cell.perception.sensor) if given.remote else open_client(cell.bus_endpoint) as bus:
            run(cell, bus, CellClock(bus) if given.remote else None, stop)
    except (ConfigError, CameraError, PoseError) as error:
        return _refuse(error.lines, 2)
    except BackgroundError as error:
        return _refuse([str(error)], 2)
    except BusError as error:
        return _refuse([f"{error}; {error.hint}"], 1)
    return 0


def run(cell: Cell, bus: Bus, clock: CellClock | None, stop: Sequence[int]) -> None:
    """Until `stop` is not empty. CameraError, BackgroundError, PoseError."""
    assert cell.perception is not None
    cv2.setNumThreads(1)
    opened = open_all(cell.perception, stop)
    with ExitStack() as stack:
        for one in opened:
            stack.callback(one.camera.close)
        frames: Frames = queue.SimpleQueue()
        for i, one in enumerate(opened):
            stack.callback(Reader(i, one, frames, _tell).close)
        offers = [_recorded(stack, opened, bus)] if cell.perception.record else []
        warm = sensor_of(cell, opened, clock)
        warm_up(warm, cell)
        limbs: Limbs = tuple
        if cell.perception.pose is not None:
            link = _posed(stack, cell.perception.pose, opened, warm)
            limbs, offers = link.newest, [*offers, link.offer]
        sensor = sensor_of(cell, opened, clock, limbs)
        realtime.set_up(PRIORITY, None)  # the threads above keep the priority of then
        _Loop(cell, bus, sensor, frames, offers).run(stop)


def _recorded(stack: ExitStack, opened: Sequence[Opened], bus: Bus) -> Offer:
    puts = (bus.publisher(topic.key).put for topic in (topics.CAMERA, topics.CAMERA_CALIBRATION))
    pictures = Pictures([(one.options.name, one.info) for one in opened], *puts)
    stack.callback(pictures.close)
    return pictures.offer


def _posed(stack: ExitStack, options: PoseOptions, opened: Sequence[Opened], sensor: Sensor) -> Link:
    """PoseError: no camera gives a picture, or the estimator cannot run."""
    scenes = {
        i: scene(eye.view, sensor.observer.pose_bounds[i]) for i, eye in enumerate(sensor.eyes) if eye.info.has_image
    }
    if not scenes:
        names = ", ".join(one.options.name for one in opened)
        need = "use one that does (realsense with infrared = true), or take [perception.pose] out"
        raise PoseError([f"perception.pose: no camera of {names} gives a picture; {need}"])
    link = Link(options, scenes, _tell)
    stack.callback(link.close)
    return link


def sensor_of(cell: Cell, opened: Sequence[Opened], clock: CellClock | None = None, limbs: Limbs = tuple) -> Sensor:
    """`clock`: of the cell, where it runs on another machine; `limbs`: as Sensor takes them. BackgroundError."""
    options = cell.perception
    assert options is not None
    observer, eyes = observer_of(options, opened, System(cell.params).model, len(cell.params.human.sensors))
    (number,) = [sensor.id for sensor in cell.params.human.sensors if sensor.name == options.sensor]
    least = around(cell.params.safety.activation_distance)
    share = MAX_CAPSULES // len(cell.params.human.sensors)
    identity = Identity(number, options.digest, options.margin, options.detection, least, share)
    if clock is None:
        return Sensor(identity, eyes, observer, clock_id, lambda t_ns: (t_ns, 0), limbs)
    return Sensor(identity, eyes, observer, lambda: clock.id, clock.convert, limbs)


def warm_up(sensor: Sensor, cell: Cell) -> None:
    """Compiles and loads what the first picture, and the first person, would wait for. `sensor` has lived now."""
    q, empty = np.zeros(cell.params.n), [eye.view.background for eye in sensor.eyes]
    pictures: list[list[Depth | None]] = [[*empty], [*empty], [_with_a_wall(d) for d in empty], [None] * len(empty)]
    for t_ns, depths in enumerate(pictures):
        sensor.observer.observe(t_ns, depths, q)


def _with_a_wall(background: Depth) -> Depth:
    """Something in the middle of the picture, half as far away as the room."""
    depth = np.array(background)
    h, w = depth.shape
    depth[h // 4 : 3 * h // 4, w // 4 : 3 * w // 4] //= 2
    return frozen(depth)


class _Loop:
    def __init__(self, cell: Cell, bus: Bus, sensor: Sensor, frames: Frames, offers: Sequence[Offer]) -> None:
        assert cell.perception is not None
        self._sensor, self._frames, self._offers, self._n = sensor, frames, offers, cell.params.n
        self._people = bus.publisher(topics.human(cell.perception.sensor).key)
        self._ready = bus.publisher(topics.ready(topics.PERCEPTION).key)
        self._joints = bus.queue(topics.JOINTS.key)
        self._together_ns = round(TOGETHER * min(eye.info.period_ns for eye in sensor.eyes))
        self._told_ns = 0
        self._fault = sensor.fault

    def run(self, stop: Sequence[int]) -> None:
        waiting: dict[int, DepthFrame] = {}
        while not stop:
            self._collect(waiting)
            now_ns = time.monotonic_ns()
            hear(self._joints, self._sensor, self._n)
            if self._is_whole(waiting, now_ns):
                messages = self._sensor.take(waiting, now_ns)
                waiting.clear()
            else:
                messages = self._sensor.wait(now_ns)
            for message in messages:
                self._people.put(message)
            self._say(now_ns)

    def _collect(self, waiting: dict[int, DepthFrame]) -> None:
        """The newest frame of each camera; all of them are offered to who else wants them."""
        with suppress(queue.Empty):
            number, frame = self._frames.get(timeout=WAIT_S)
            while True:
                waiting[number] = frame
                for offer in self._offers:
                    offer(number, frame)
                number, frame = self._frames.get_nowait()

    def _is_whole(self, waiting: dict[int, DepthFrame], now_ns: int) -> bool:
        """A frame of every camera in order, or one that has waited for long enough."""
        if not waiting:
            return False
        missing = [i for i, eye in enumerate(self._sensor.eyes) if eye.is_believed and i not in waiting]
        oldest_ns = min(frame.t_arrival_ns for frame in waiting.values())
        return not missing or now_ns - oldest_ns > self._together_ns

    def _say(self, now_ns: int) -> None:
        if now_ns - self._told_ns > READY_NS:
            self._told_ns = now_ns
            self._ready.put_json({"pid": os.getpid()})
        if self._sensor.fault != self._fault:
            self._fault = self._sensor.fault
            names = {eye.name: eye.fault.name or "in order" for eye in self._sensor.eyes}
            _tell("; ".join(f"camera {name}: {fault}" for name, fault in names.items()))


def hear(inbox: Queue, sensor: Sensor, n: int) -> None:
    """Takes over the joints that have come. What is no batch of them is as good as none."""
    while (data := inbox.take()) is not None:
        try:
            told: dict[str, Any] = json.loads(data)
            q = np.array(told["q"], float).reshape(-1, n)
            times = [int(t_ns) for t_ns in told["t_ns"]]
        except (ValueError, KeyError, TypeError, OverflowError):
            continue
        if np.isfinite(q).all() and len(q) == len(times):
            for t_ns, row in zip(times, q, strict=True):
                sensor.joints.add(t_ns, row)


def _tell(line: str) -> None:
    print(f"perception: {line}", file=sys.stderr, flush=True)


def _refuse(lines: Sequence[str], code: int) -> int:
    for line in lines:
        _tell(line)
    return code
