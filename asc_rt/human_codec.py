"""HumanState between protobuf bytes and `asc_rt.core.types`. Whatever is not entirely in order is a HumanCodecError."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from google.protobuf.message import DecodeError

from asc_rt import human_state_pb2 as pb
from asc_rt.cell_checks import hash_number
from asc_rt.core.fusion import unsure
from asc_rt.core.types import (
    MAX_CAPSULES,
    Health,
    HumanState,
    IntVector,
    Matrix,
    MessageFault,
    Visibility,
    vector,
)

SCHEMA_VERSION = 1
FRAME = "robot_base"
DIGEST_SIZE = 32  # SHA-256
INT64_MAX = 2**63 - 1
SIGMA_MAX_NS = 10_000_000_000  # such a stamp says nothing


class HumanCodecError(Exception):
    """The message is not a HumanState that may be used; `fault`: what the decision is told of it."""

    def __init__(self, message: str, fault: MessageFault = MessageFault.UNREADABLE) -> None:
        super().__init__(message)
        self.fault = fault


@dataclass(frozen=True, slots=True)
class Heard:
    """A message that may be used."""

    state: HumanState  # grown by what the error of its stamp may hide
    session: str
    sigma_ns: int  # how far its capture stamp may be off our clock


def clock_id() -> str:
    """Names the clock of our stamps: monotonic time of this boot of this machine. A container may have one of its own:
    hence the time namespace."""
    boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    return f"HOST_MONO:{boot}:{os.readlink('/proc/self/ns/time')}"


def decode(data: bytes, clock: str) -> Heard:
    """The message in `data`, if it is stamped by the clock named `clock`. HumanCodecError: what is wrong."""
    try:
        message = pb.HumanState.FromString(data)
    except DecodeError as error:
        raise HumanCodecError("not a HumanState message") from error
    _check_header(message, clock)
    capsules = [capsule for body in message.bodies for capsule in body.capsules]
    if len(capsules) > MAX_CAPSULES:
        raise HumanCodecError(f"{len(capsules)} capsules; at most {MAX_CAPSULES}")
    for capsule in capsules:
        if any(len(point) != 3 for point in (capsule.p0, capsule.p1, capsule.v0, capsule.v1)):
            raise HumanCodecError(f"capsule {capsule.label!r}: a point or velocity has not 3 coordinates")
        if capsule.visibility not in {*Visibility}:
            raise HumanCodecError(f"capsule {capsule.label!r}: unknown visibility {capsule.visibility}")
    state = HumanState(
        t_capture_ns=message.t_capture_ns,
        seq=message.seq,
        sensor_id=message.sensor_id,
        calibration_hash=hash_number(message.calibration_hash),
        health=Health(message.health),
        coverage=message.coverage,
        empty_certified=message.empty_certified,
        p0=_points([c.p0 for c in capsules]),
        p1=_points([c.p1 for c in capsules]),
        v0=_points([c.v0 for c in capsules]),
        v1=_points([c.v1 for c in capsules]),
        radius=vector([c.radius for c in capsules]),
        position_bound=vector([c.position_bound for c in capsules]),
        velocity_bound=vector([c.velocity_bound for c in capsules]),
        visibility=_visibilities([c.visibility for c in capsules]),
    )
    _check_numbers(state)
    sigma_ns = message.t_capture_sigma_ns
    return Heard(unsure(state, sigma_ns * 1e-9), message.session_uuid, sigma_ns)


def _check_header(message: pb.HumanState, clock: str) -> None:
    if message.schema_version != SCHEMA_VERSION:
        wrong = f"schema version {message.schema_version}, not {SCHEMA_VERSION}"
        raise HumanCodecError(wrong, MessageFault.SCHEMA)
    if message.clock_id != clock:
        raise HumanCodecError(f"stamps of clock {message.clock_id!r}, not of {clock!r}", MessageFault.CLOCK)
    if message.frame_id != FRAME:
        raise HumanCodecError(f"frame {message.frame_id!r}, not {FRAME!r}")
    if message.safety_rated:
        raise HumanCodecError("claims to be safety rated; nothing here is", MessageFault.SENDER)
    if len(message.calibration_hash) not in (0, DIGEST_SIZE):
        raise HumanCodecError(f"calibration hash of {len(message.calibration_hash)} bytes, not {DIGEST_SIZE}")
    if message.health not in {*Health}:
        raise HumanCodecError(f"unknown health {message.health}")
    if not 0 < message.seq <= INT64_MAX:
        raise HumanCodecError(f"sequence number {message.seq} is not within 1..{INT64_MAX}")
    if message.t_capture_ns <= 0:
        raise HumanCodecError(f"capture stamp {message.t_capture_ns} ns")
    if message.t_capture_sigma_ns > SIGMA_MAX_NS:
        raise HumanCodecError(f"a capture stamp that may be off by {message.t_capture_sigma_ns} ns")


def _check_numbers(state: HumanState) -> None:
    vectors = (state.radius, state.position_bound, state.velocity_bound)
    points = (state.p0, state.p1, state.v0, state.v1)
    if not all(bool(np.isfinite(array).all()) for array in (*points, *vectors)):
        raise HumanCodecError("a coordinate, velocity, radius or bound is not finite")
    if bool((state.radius <= 0).any()):
        raise HumanCodecError("a radius is not above 0")
    if bool((state.position_bound < 0).any()) or bool((state.velocity_bound < 0).any()):
        raise HumanCodecError("a bound is below 0")
    if not 0 <= state.coverage <= 1:
        raise HumanCodecError(f"coverage {state.coverage} is not within 0..1")


def _points(rows: Sequence[Sequence[float]]) -> Matrix:
    return vector(np.array(rows, dtype=np.float64).reshape(len(rows), 3))


def _visibilities(values: Sequence[int]) -> IntVector:
    array = np.array(values, dtype=np.int64)
    array.setflags(write=False)
    return array
