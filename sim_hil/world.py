"""The simulated world of one arm, as its simulated controller uses it: plant, person, and the truth told.

`sim/truth`, one JSON per control period: {"t_ns", "q", "dq", "distance_m" (null: nobody), "robot_part", "person_part",
"approach_m_s", "contact" (within the period)}.
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

LONGEST_EXTRAPOLATION = 0.05  # s; a person whose process has died stands where they were last


class SimulatedCell(Protocol):
    @property
    def params(self) -> Params: ...
    @property
    def bus_endpoint(self) -> str: ...


class World:
    """Each period: `set_target`, `step`, `publish`. BusError: nobody routes the cell's bus."""

    def __init__(self, cell: SimulatedCell, q0: npt.ArrayLike | None = None) -> None:
        self._plant = MujocoPlant(cell.params, q0)
        self._bus: Bus = open_client(cell.bus_endpoint)
        self._messages = self._bus.latest(topics.PERSON_TRUTH.key)
        self._truth = self._bus.publisher(topics.PLANT_TRUTH.key)
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

    def set_target(self, q: npt.ArrayLike) -> None:
        self._plant.set_target(q)

    def step(self) -> None:
        """One control period, the person where they are now."""
        data = self._messages.take()
        if data is not None:
            self._person = decode(data) or self._person
        if self._person is not None:
            t_ns, person = self._person
            self._plant.set_person(extrapolate(person, (time.monotonic_ns() - t_ns) * 1e-9))
        self._plant.step()

    def publish(self, t_ns: int) -> None:
        """Say what is true now; `t_ns`: monotonic time of this period."""
        nearest = self._plant.distance()
        self._truth.put_json(
            {
                "t_ns": t_ns,
                "q": self._plant.q.tolist(),
                "dq": self._plant.dq.tolist(),
                "distance_m": nearest.distance if np.isfinite(nearest.distance) else None,
                "robot_part": nearest.robot_part,
                "person_part": nearest.person_part,
                "approach_m_s": nearest.approach,
                "contact": bool(self._plant.contacts),
            }
        )

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
