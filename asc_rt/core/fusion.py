"""What several sensors say of people as one, and what each says of itself."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from asc_rt.core.types import HumanState, Matrix, MessageFault, SensorReport, Vector, vector

SEVERAL = 0  # sensor_id of what more than one sensor sees


def union(states: Sequence[HumanState]) -> HumanState | None:
    """What all sensors together see: every capsule of each, brought to the newest capture. None: no state at all.

    An older capsule moves with its velocity and grows by its velocity bound, so that `predict` places it as it would
    have done from its own capture. Of what the sensors say of themselves the worst is kept.
    """
    if len(states) < 2:
        return states[0] if states else None
    newest_ns = max(state.t_capture_ns for state in states)
    waits = [(newest_ns - state.t_capture_ns) * 1e-9 for state in states]

    def joined(name: str) -> Vector:
        return vector(np.concatenate([getattr(state, name) for state in states]))

    def moved(place: str, velocity: str) -> Matrix:
        ends = [getattr(s, place) + wait * getattr(s, velocity) for s, wait in zip(states, waits, strict=True)]
        return vector(np.concatenate(ends))

    grown = [s.position_bound + wait * s.velocity_bound for s, wait in zip(states, waits, strict=True)]
    visibility = np.concatenate([state.visibility for state in states])
    visibility.setflags(write=False)
    return HumanState(
        t_capture_ns=newest_ns,
        seq=max(state.seq for state in states),
        sensor_id=SEVERAL,
        calibration_hash=0,
        health=max(state.health for state in states),
        coverage=min(state.coverage for state in states),
        empty_certified=all(state.empty_certified for state in states),
        p0=moved("p0", "v0"),
        p1=moved("p1", "v1"),
        v0=joined("v0"),
        v1=joined("v1"),
        radius=joined("radius"),
        position_bound=vector(np.concatenate(grown)),
        velocity_bound=joined("velocity_bound"),
        visibility=visibility,
    )


def unsure(human: HumanState, sigma: float) -> HumanState:
    """`human` whose capture stamp may be off by `sigma` seconds: grown by how far the people move in that time."""
    fastest = np.maximum(np.linalg.norm(human.v0, axis=1), np.linalg.norm(human.v1, axis=1))
    grown = human.position_bound + sigma * (fastest + human.velocity_bound)
    return dataclasses.replace(human, position_bound=vector(grown))


def report(human: HumanState, age_ns: int, sigma_ns: int = 0, fault: MessageFault = MessageFault.NONE) -> SensorReport:
    """What the sensor of `human` says of itself, `age_ns` after its capture."""
    return SensorReport(
        id=human.sensor_id,
        seq=human.seq,
        age_ns=age_ns,
        sigma_ns=sigma_ns,
        fault=fault,
        health=human.health,
        coverage=human.coverage,
        calibration_hash=human.calibration_hash,
        says_nothing=len(human.radius) == 0 and not human.empty_certified,
    )


def heard(human: HumanState | None, age_ns: int) -> tuple[SensorReport, ...]:
    """The reports of a cell whose only sensor sent `human`."""
    return () if human is None else (report(human, age_ns),)
