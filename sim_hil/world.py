"""The simulated world of one arm, as its simulated controller uses it: plant, person, and the truth told.

`sim/truth`, 125 a second or one per control period, whichever is less: {"t_ns", "q", "dq", "distance_m" (null: nobody),
"robot_part", "person_part", "approach_m_s", "contact" (since the last one)}. The person is looked at as often: together
they cost more than a period of 1 or 2 ms has.
"""

from __future__ import annotations

import time
from typing import Protocol

import numpy as np
import numpy.typing as npt
from google.protobuf.message import DecodeError

from asc_rt import human_state_pb2 as pb
from asc_rt import topics
from asc_rt.bus import Bus, open_client
from asc_rt.core.params import Params
from asc_rt.core.types import MAX_CAPSULES
from sim_hil.person import Array, Capsules
from sim_hil.plant import MujocoPlant

READY_NS = 500_000_000
LONGEST_EXTRAPOLATION = 0.05  # s; a person whose process has died stands where they were last


class SimulatedCell(Protocol):
    @property
    def params(self) -> Params: ...
    @property
    def bus_endpoint(self) -> str: ...


class World:
    """Each period: `set_target`, `step`, `publish`. BusError: nobody routes the cell's bus."""

    def __init__(self, cell: SimulatedCell, device: str, q0: npt.ArrayLike | None = None) -> None:
        self._plant = MujocoPlant(cell.params, q0)
        self._tools = {mount.number: mount.tool for mount in cell.params.changer.mounts}
        for tool in reversed(self._tools.values()):  # each model is built once, before it is needed
            self._plant.carry(tool)
        self._bus: Bus = open_client(cell.bus_endpoint)
        self._messages = self._bus.latest(topics.PERSON_TRUTH.key)
        self._truth = self._bus.publisher(topics.PLANT_TRUTH.key)
        self._ready = self._bus.publisher(topics.ready(device).key)
        self.take_fault = self._bus.queue(topics.FAULT.key).take
        self._every = max(1, round(1.0 / (topics.PLANT_TRUTH.rate_hz * cell.params.period)))  # periods
        self._periods = 0
        self._touched = False  # since the truth was last told
        self._told_ready_ns = 0
        self._person: tuple[int, Capsules] | None = None  # when, where

    @property
    def q(self) -> Array:
        return self._plant.q

    @property
    def dq(self) -> Array:
        return self._plant.dq

    @property
    def torque(self) -> Array:
        return self._plant.torque

    def carry(self, number: int) -> None:
        """The tool of this number from now on; of one that the cell does not know nothing is known here either."""
        if number in self._tools:
            self._plant.carry(self._tools[number])

    def set_target(self, q: npt.ArrayLike) -> None:
        self._plant.set_target(q)

    def set_torque(self, tau: npt.ArrayLike) -> None:
        self._plant.set_torque(tau)

    def set_brakes(self, closed: npt.NDArray[np.bool_]) -> None:
        self._plant.set_brakes(closed)

    def step(self) -> None:
        """One control period."""
        if self._periods % self._every == 0:
            self._look()
        self._plant.step()
        self._periods += 1
        self._touched |= bool(self._plant.contacts)

    def _look(self) -> None:
        """The person where they are now."""
        data = self._messages.take()
        if data is not None:
            self._person = decode(data) or self._person
        if self._person is not None:
            t_ns, person = self._person
            self._plant.set_person(extrapolate(person, (time.monotonic_ns() - t_ns) * 1e-9))

    def publish(self, t_ns: int) -> None:
        """Say what is true now, and now and then that there is a robot; `t_ns`: monotonic time of this period."""
        if t_ns - self._told_ready_ns > READY_NS:
            self._told_ready_ns = t_ns
            self._ready.put_json({"t_ns": t_ns})
        if self._periods % self._every == 0:
            self._truth.put_json(self._plant.truth(t_ns) | {"contact": self._touched})
            self._touched = False

    def close(self) -> None:
        self._bus.close()


def decode(data: bytes) -> tuple[int, Capsules] | None:
    """A HumanState as (capture time, capsules); None: not a HumanState, or one that the plant cannot show."""
    try:
        message = pb.HumanState.FromString(data)
        capsules = [capsule for person in message.bodies for capsule in person.capsules]
        rows = [[*c.p0, *c.p1, c.radius, *c.v0, *c.v1] for c in capsules]
        table = np.array(rows, float).reshape(len(capsules), 13)
    except (DecodeError, ValueError):
        return None
    if len(capsules) > MAX_CAPSULES or not np.isfinite(table).all():
        return None
    labels = tuple(capsule.label for capsule in capsules)
    p0, p1, radius, v0, v1 = np.split(table, [3, 6, 7, 10], axis=1)
    return message.t_capture_ns, Capsules(labels, p0, p1, radius[:, 0], v0, v1)


def extrapolate(person: Capsules, seconds: float) -> Capsules:
    """The person so much later, each end at constant velocity."""
    seconds = min(max(seconds, 0.0), LONGEST_EXTRAPOLATION)
    return person._replace(p0=person.p0 + seconds * person.v0, p1=person.p1 + seconds * person.v1)
