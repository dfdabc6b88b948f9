"""The simulated person as a process: where they really are, and what a perfect sensor says about it.

`sim/person`, every 8 ms: the truth, for the plant. `cell/human/SENSOR`, at the sensor's rate: the same person as they
were `latency_ms` ago, with bounds, stamps, sequence and health, as perception publishes them.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
import uuid
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from asc_rt import human_state_pb2 as pb
from asc_rt import launch, realtime, topics
from asc_rt.bus import Bus, BusError, open_client
from asc_rt.clock_sync import CellClock
from asc_rt.config import Cell, ConfigError, load_cell
from asc_rt.core.params import SensorParams
from asc_rt.remote import join
from calibration.geometry import inverse, perturb
from calibration.result import CalibrationError, load
from sim_hil.person import Capsules, Person

PRIORITY = 30  # SCHED_FIFO, below the robot's and the controller's
TRUTH_PERIOD_NS = 8_000_000
READY_PERIOD_NS = 500_000_000
FIRST = SensorParams()


@dataclass(frozen=True, slots=True)
class HumanOptions:
    """The cell's [sim.human] table."""

    seed: int = 1
    rate_hz: float = 60.0  # 0: no perfect sensor; the cell sees with its own cameras
    latency_ms: float = 30.0
    position_bound_m: float = 0.02
    velocity_bound_m_s: float = 0.3
    calibration: str = ""  # hand-eye file of the camera they are seen by, which errs by as much as it admits
    start_s: float = 0.0  # the person stands still outside for so long before the script begins
    still_at_s: float = 0.0  # above 0: a dummy, which stands as the person does at this time of the script

    @classmethod
    def of(cls, table: dict[str, Any]) -> HumanOptions:
        """ValueError with one line per fault."""
        known = [field.name for field in fields(cls)]
        faults = [f"sim.human.{key}: unknown; known are {', '.join(known)}" for key in table if key not in known]
        texts = {field.name for field in fields(cls) if field.type == "str"}
        faults += [
            f"sim.human.{k}: {v!r} is no text" for k, v in table.items() if k in texts and not isinstance(v, str)
        ]
        for key in (key for key in known if key not in texts):
            value = table.get(key, 0)
            kind = int if key == "seed" else (int, float)
            if isinstance(value, bool) or not isinstance(value, kind) or not 0 <= value < 1e9:
                faults.append(f"sim.human.{key}: {value!r} is not {'an integer' if kind is int else 'a number'} >= 0")
            elif key == "rate_hz" and key in table and value != 0 and not 1 <= value <= 1000:
                faults.append(f"sim.human.rate_hz: {value!r} Hz is not within 1..1000, nor 0")
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


class Never:
    """No deadline ever."""

    due_ns = 2**63 - 1

    def take(self, now_ns: int) -> int | None:
        return None


class HumanSource:
    """The person's script as HumanState messages; `start_ns` is when its time begins."""

    def __init__(
        self, options: HumanOptions, start_ns: int, sensor_id: int = FIRST.id, clock: CellClock | None = None
    ) -> None:
        """`clock`: the cell runs on another machine."""
        self._options, self._sensor_id, self._cell_clock = options, sensor_id, clock
        self._person = Person(options.seed)
        self._start_ns = start_ns
        self._session = str(uuid.uuid4())
        self._seq = {"truth": 0, "sensor": 0}
        self._camera = CalibratedCamera(Path(options.calibration), options.seed) if options.calibration else None

    def truth(self, t_ns: int) -> bytes | None:
        """The person at t_ns, exactly. None: the cell's clock is not known yet."""
        return self._message("truth", t_ns, t_ns, self._at(t_ns), 0.0, 0.0)

    def sensed(self, t_publish_ns: int) -> bytes | None:
        """The person as captured one latency before, with the bounds of the options."""
        t_capture_ns = t_publish_ns - round(self._options.latency_ms * 1e6)
        velocity = self._options.velocity_bound_m_s
        capsules, digest = self._at(t_capture_ns), b""
        position: float | np.ndarray = self._options.position_bound_m
        if self._camera is not None:
            capsules, more = self._camera.see(capsules)
            position, digest = position + more, self._camera.digest
        return self._message("sensor", t_capture_ns, t_publish_ns, capsules, position, velocity, digest)

    def _at(self, t_ns: int) -> Capsules:
        if self._options.still_at_s:
            dummy = self._person.at(self._options.still_at_s)
            return dummy._replace(v0=np.zeros_like(dummy.v0), v1=np.zeros_like(dummy.v1))
        return self._person.at((t_ns - self._start_ns) * 1e-9)

    def _message(
        self, stream: str, t_capture_ns: int, t_publish_ns: int, capsules: Capsules, position: float | np.ndarray,
        velocity: float, digest: bytes = b"",
    ) -> bytes | None:  # fmt: skip
        stamp = (t_capture_ns, 0) if self._cell_clock is None else self._cell_clock.convert(t_capture_ns)
        if stamp is None:
            return None
        self._seq[stream] += 1
        message = pb.HumanState(
            schema_version=1,
            sensor_id=self._sensor_id,
            session_uuid=self._session,
            seq=self._seq[stream],
            clock_id=clock_id() if self._cell_clock is None else self._cell_clock.id,
            t_capture_ns=stamp[0],
            t_capture_sigma_ns=stamp[1],
            t_publish_ns=stamp[0] + t_publish_ns - t_capture_ns,
            frame_id="robot_base",
            calibration_hash=digest,
            method=pb.METHOD_SIMULATED,
            safety_rated=False,
            health=pb.HEALTH_OK,
            coverage=1.0,
            empty_certified=True,
            bodies=[body(capsules, position, velocity)],
        )
        return message.SerializeToString()


class CalibratedCamera:
    """What a hand-eye result does to what is seen: everything moved by one error drawn from its covariance, and a bound
    of 3 sigma on each capsule that says so. CalibrationError: a file that must not be used."""

    def __init__(self, path: Path, seed: int) -> None:
        self._result = load(path, "hand-eye")
        self.digest = self._result.digest
        drawn = np.random.default_rng([seed, 5]).multivariate_normal(np.zeros(6), np.array(self._result.covariance))
        said = self._result.pose()
        self._moved = said @ inverse(perturb(said, drawn))

    def see(self, capsules: Capsules) -> tuple[Capsules, np.ndarray]:
        R, t = self._moved[:3, :3], self._moved[:3, 3]
        p0, p1 = capsules.p0 @ R.T + t, capsules.p1 @ R.T + t
        return capsules._replace(p0=p0, p1=p1), self._result.capsule_bounds(p0, p1, capsules.radius)


def body(capsules: Capsules, position_bound: float | np.ndarray, velocity_bound: float) -> pb.Body:
    labels, *arrays = capsules
    bounds = np.broadcast_to(position_bound, len(labels)).tolist()
    rows = zip(labels, *(array.tolist() for array in arrays), bounds, strict=True)
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
                position_bound=bound,
                velocity_bound=velocity_bound,
                visibility=pb.OBSERVED,
            )
            for label, p0, p1, radius, v0, v1, bound in rows
        ],
    )


def clock_id() -> str:
    """Names the clock of the stamps: monotonic, of this boot and of this time namespace."""
    boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    return f"HOST_MONO:{boot}:{Path('/proc/self/ns/time').readlink()}"


def publish(
    bus: Bus, options: HumanOptions, stop: list[int], sensor: SensorParams = FIRST, clock: CellClock | None = None
) -> None:
    """As `sensor`, until `stop` is not empty."""
    truth, sensed = bus.publisher(topics.PERSON_TRUTH.key), bus.publisher(topics.human(sensor.name).key)
    ready = bus.publisher(topics.ready("human").key)
    now = time.monotonic_ns()
    source = HumanSource(options, now + round(options.start_s * 1e9), sensor.id, clock)
    beat, said = Rhythm(now, TRUTH_PERIOD_NS), Rhythm(now, READY_PERIOD_NS)
    frame = Rhythm(now, round(1e9 / options.rate_hz)) if options.rate_hz else Never()
    while not stop:
        if beat.take(time.monotonic_ns()) is not None and (data := source.truth(time.monotonic_ns())) is not None:
            truth.put(data)
        if (due_ns := frame.take(time.monotonic_ns())) is not None and (data := source.sensed(due_ns)) is not None:
            sensed.put(data)
        if said.take(time.monotonic_ns()) is not None:
            ready.put_json({"device": "human", "pid": os.getpid()})
        wait_ns = min(beat.due_ns, frame.due_ns, said.due_ns) - time.monotonic_ns()
        time.sleep(max(wait_ns, 0) * 1e-9)


def _sensor(cell: Cell, name: str | None) -> SensorParams:
    """ValueError: no such sensor."""
    sensors = {sensor.name: sensor for sensor in cell.params.human.sensors}
    if name is not None and name not in sensors:
        raise ValueError(f"--sensor {name}: not in human.sensors: {', '.join(sensors)}")
    return sensors[name] if name is not None else cell.params.human.sensors[0]


def main(cell_path: str, argv: list[str]) -> int:
    """`python -m sim_hil human CELL`: 0 after SIGTERM or SIGINT, 2 for bad input, 1 without a bus."""
    parser = argparse.ArgumentParser(prog="python -m sim_hil human CELL")
    launch.add_overrides(parser)
    parser.add_argument("--sensor", help="under whose name of human.sensors it speaks; default: the first")
    parser.add_argument("--remote", action="store_true", help="the cell runs on another machine: [bus.remote]")
    given = parser.parse_args(argv)
    try:
        cell = load_cell(cell_path, given.set)
        options = HumanOptions.of(cell.sim.get("human", {}))
        CalibratedCamera(Path(options.calibration), 0) if options.calibration else None
        sensor = _sensor(cell, given.sensor)
    except (ConfigError, ValueError, CalibrationError) as error:
        print(error, file=sys.stderr)
        return 2
    stop = launch.told_to_end()
    try:
        with join(cell, sensor.name) if given.remote else open_client(cell.bus_endpoint) as bus:
            realtime.set_up(PRIORITY, None)  # a late person would stop the robot for nothing
            print(f"ready human: seed {options.seed}, {options.rate_hz:g} Hz", flush=True)
            publish(bus, options, stop, sensor, CellClock(bus) if given.remote else None)
    except BusError as error:
        print(f"human: {error}; {error.hint}", file=sys.stderr)
        return 1
    return 0
