"""The simulated person as a process: where they really are, and what a perfect sensor says about it.

`sim/person`, every 8 ms: the truth, for the plant. `cell/human`, at the sensor's rate: the same person as they were
`latency_ms` ago, with bounds, stamps, sequence and health, as perception publishes them.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import time
import uuid
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from asc_rt import human_state_pb2 as pb
from asc_rt import realtime, topics
from asc_rt.bus import Bus, BusError, open_client
from asc_rt.config import ConfigError, load_cell
from sim_hil.person import Capsules, Person

PRIORITY = 30  # SCHED_FIFO, below the robot's and the controller's
TRUTH_PERIOD_NS = 8_000_000
READY_PERIOD_NS = 500_000_000
SENSOR_ID = 1


@dataclass(frozen=True, slots=True)
class HumanOptions:
    """The cell's [sim.human] table."""

    seed: int = 1
    rate_hz: float = 60.0
    latency_ms: float = 30.0
    position_bound_m: float = 0.02
    velocity_bound_m_s: float = 0.3
    start_s: float = 0.0  # the person stands still outside for so long before the script begins

    @classmethod
    def of(cls, table: dict[str, Any]) -> HumanOptions:
        """ValueError with one line per fault."""
        known = [field.name for field in fields(cls)]
        faults = [f"sim.human.{key}: unknown; known are {', '.join(known)}" for key in table if key not in known]
        for key in known:
            value = table.get(key, 0)
            kind = int if key == "seed" else (int, float)
            if isinstance(value, bool) or not isinstance(value, kind) or not 0 <= value < 1e9:
                faults.append(f"sim.human.{key}: {value!r} is not {'an integer' if kind is int else 'a number'} >= 0")
            elif key == "rate_hz" and key in table and not 1 <= value <= 1000:
                faults.append(f"sim.human.rate_hz: {value!r} Hz is not within 1..1000")
        if faults:
            raise ValueError("\n".join(faults))
        return cls(**table)


class Rhythm:
    """Absolute deadlines: a late one is not made up for, and the next does not move."""

    def __init__(self, start_ns: int, period_ns: int) -> None:
        self.due_ns = start_ns
        self._period_ns = period_ns

    def take(self, now_ns: int) -> int | None:
        """The newest deadline that has passed, once; None: not yet."""
        if now_ns < self.due_ns:
            return None
        passed = (now_ns - self.due_ns) // self._period_ns
        newest = self.due_ns + passed * self._period_ns
        self.due_ns = newest + self._period_ns
        return newest


class HumanSource:
    """The person's script as HumanState messages; `start_ns` is when its time begins."""

    def __init__(self, options: HumanOptions, start_ns: int) -> None:
        self._options = options
        self._person = Person(options.seed)
        self._start_ns = start_ns
        self._session = str(uuid.uuid4())
        self._clock = f"HOST_MONO:{boot_id()}"
        self._seq = {"truth": 0, "sensor": 0}

    def truth(self, t_ns: int) -> bytes:
        """The person at t_ns, exactly."""
        return self._message("truth", t_ns, t_ns, 0.0, 0.0)

    def sensed(self, t_publish_ns: int) -> bytes:
        """The person as captured one latency before, with the bounds of the options."""
        t_capture_ns = t_publish_ns - round(self._options.latency_ms * 1e6)
        bounds = self._options.position_bound_m, self._options.velocity_bound_m_s
        return self._message("sensor", t_capture_ns, t_publish_ns, *bounds)

    def _message(self, stream: str, t_capture_ns: int, t_publish_ns: int, position: float, velocity: float) -> bytes:
        self._seq[stream] += 1
        capsules = self._person.at((t_capture_ns - self._start_ns) * 1e-9)
        message = pb.HumanState(
            schema_version=1,
            sensor_id=SENSOR_ID,
            session_uuid=self._session,
            seq=self._seq[stream],
            clock_id=self._clock,
            t_capture_ns=t_capture_ns,
            t_publish_ns=t_publish_ns,
            frame_id="robot_base",
            method=pb.METHOD_SIMULATED,
            safety_rated=False,
            health=pb.HEALTH_OK,
            coverage=1.0,
            empty_certified=True,
            bodies=[body(capsules, position, velocity)],
        )
        return message.SerializeToString()


def body(capsules: Capsules, position_bound: float, velocity_bound: float) -> pb.Body:
    labels, *arrays = capsules
    rows = zip(labels, *(array.tolist() for array in arrays), strict=True)
    return pb.Body(
        id=1,
        capsules=[
            pb.Capsule(
                label=label,
                p0=p0,
                p1=p1,
                radius=radius,
                v0=v0,
                v1=v1,
                position_bound=position_bound,
                velocity_bound=velocity_bound,
                visibility=pb.OBSERVED,
            )
            for label, p0, p1, radius, v0, v1 in rows
        ],
    )


def boot_id() -> str:
    """Names the boot whose monotonic clock the stamps are of."""
    return Path("/proc/sys/kernel/random/boot_id").read_text().strip()


def publish(bus: Bus, options: HumanOptions, stop: list[int]) -> None:
    """Until `stop` is not empty."""
    truth, sensed = bus.publisher(topics.PERSON_TRUTH.key), bus.publisher(topics.HUMAN.key)
    ready = bus.publisher(topics.ready("human").key)
    now = time.monotonic_ns()
    source = HumanSource(options, now + round(options.start_s * 1e9))
    periods = (TRUTH_PERIOD_NS, round(1e9 / options.rate_hz), READY_PERIOD_NS)
    beat, frame, said = (Rhythm(now, period) for period in periods)
    while not stop:
        if beat.take(time.monotonic_ns()) is not None:
            truth.put(source.truth(time.monotonic_ns()))
        if (due_ns := frame.take(time.monotonic_ns())) is not None:
            sensed.put(source.sensed(due_ns))
        if said.take(time.monotonic_ns()) is not None:
            ready.put_json({"device": "human", "pid": os.getpid()})
        wait_ns = min(beat.due_ns, frame.due_ns, said.due_ns) - time.monotonic_ns()
        time.sleep(max(wait_ns, 0) * 1e-9)


def main(cell_path: str, argv: list[str]) -> int:
    """`python -m sim_hil human CELL`: 0 after SIGTERM or SIGINT, 2 for bad input, 1 without a bus."""
    parser = argparse.ArgumentParser(prog="python -m sim_hil human CELL")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="put over the cell file")
    overrides = parser.parse_args(argv).set
    try:
        cell = load_cell(cell_path, overrides)
        options = HumanOptions.of(cell.sim.get("human", {}))
    except (ConfigError, ValueError) as error:
        print(error, file=sys.stderr)
        return 2
    stop: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda signum, _: stop.append(signum))
    try:
        with open_client(cell.bus_endpoint) as bus:
            realtime.set_up(PRIORITY, None)  # a late person would stop the robot for nothing
            print(f"ready human: seed {options.seed}, {options.rate_hz:g} Hz", flush=True)
            publish(bus, options, stop)
    except BusError as error:
        print(f"human: {error}; {error.hint}", file=sys.stderr)
        return 1
    return 0
