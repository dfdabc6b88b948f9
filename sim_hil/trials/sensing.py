"""What the controller is told about the world: all of it, late and inexact, or nothing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from asc_rt.core.types import Health, HumanState, vector
from sim_hil.person import Array, Capsules


class World(Protocol):
    def at(self, t: float) -> Capsules:
        """The truth, t seconds after the start."""


class Sensor(Protocol):
    def at(self, t: float) -> tuple[HumanState, float] | None:
        """The newest message and its age in s; None: none has come yet."""


@dataclass(frozen=True, slots=True)
class Ball:
    """An obstacle that stands still."""

    centre: Array  # (3,) m
    radius: float  # m

    def at(self, t: float) -> Capsules:
        point, still = self.centre[None], np.zeros((1, 3))
        return Capsules(("ball",), point, point, np.array([self.radius]), still, still)


class Blind:
    """Nobody is there, it says, and is believed: the run without a filter."""

    def __init__(self) -> None:
        empty, none = np.zeros((0, 3)), np.zeros(0)
        self._message = message(0, 0.0, Capsules((), empty, empty, none, empty, empty), 0.0, 0.0)

    def at(self, t: float) -> tuple[HumanState, float]:
        return self._message, 0.0


class Perfect:
    """Knows a world that stands still."""

    def __init__(self, world: World) -> None:
        self._message = message(0, 0.0, world.at(0.0), 0.0, 0.0)

    def at(self, t: float) -> tuple[HumanState, float]:
        return self._message, 0.0


@dataclass(frozen=True, slots=True)
class Quality:
    """Of a camera. Noise: root mean square of the length of the error of each capsule end, cut off at the bound."""

    rate: float  # Hz
    latency: tuple[float, float]  # s, from capture to arrival, drawn per frame
    position_noise: float  # m
    velocity_noise: float  # m/s
    position_bound: float  # m, as stated in the message
    velocity_bound: float  # m/s


class Camera:
    """A pure function of (seed, time)."""

    def __init__(self, world: World, quality: Quality, seed: int) -> None:
        self._world, self._quality, self._seed = world, quality, seed
        self._newest: tuple[int, HumanState] | None = None
        self._late: dict[int, float] = {}  # s, by frame

    def at(self, t: float) -> tuple[HumanState, float] | None:
        frame = int(t * self._quality.rate)
        while frame >= 0 and self._arrival(frame) > t:
            frame -= 1
        if frame < 0:
            return None
        if self._newest is None or self._newest[0] != frame:
            self._newest = frame, self._capture(frame)
        return self._newest[1], t - frame / self._quality.rate

    def _arrival(self, frame: int) -> float:
        low, high = self._quality.latency
        if frame not in self._late:
            self._late[frame] = low + (high - low) * float(self._random(frame).random())
        return frame / self._quality.rate + self._late[frame]

    def _capture(self, frame: int) -> HumanState:
        q, t = self._quality, frame / self._quality.rate
        person, rng = self._world.at(t), self._random(frame)
        rng.random()  # the latency's
        noisy = person._replace(
            p0=person.p0 + _error(rng, person.p0.shape, q.position_noise, q.position_bound),
            p1=person.p1 + _error(rng, person.p1.shape, q.position_noise, q.position_bound),
            v0=person.v0 + _error(rng, person.v0.shape, q.velocity_noise, q.velocity_bound),
            v1=person.v1 + _error(rng, person.v1.shape, q.velocity_noise, q.velocity_bound),
        )
        return message(frame, t, noisy, q.position_bound, q.velocity_bound)

    def _random(self, frame: int) -> np.random.Generator:
        return np.random.default_rng((self._seed, frame))


def _error(rng: np.random.Generator, shape: tuple[int, ...], rms: float, bound: float) -> Array:
    error = rng.normal(0.0, rms / np.sqrt(3.0), shape)
    length = np.linalg.norm(error, axis=1, keepdims=True)
    return error * np.minimum(1.0, bound / np.maximum(length, 1e-12))


def message(seq: int, t: float, people: Capsules, position_bound: float, velocity_bound: float) -> HumanState:
    m = len(people.radius)
    return HumanState(
        t_capture_ns=round(t * 1e9),
        seq=seq + 1,  # 0 says that no message has come yet
        sensor_id=1,
        calibration_hash=0,
        health=Health.OK,
        coverage=1.0,
        empty_certified=True,
        p0=vector(people.p0),
        p1=vector(people.p1),
        v0=vector(people.v0),
        v1=vector(people.v1),
        radius=vector(people.radius),
        position_bound=vector(np.full(m, position_bound)),
        velocity_bound=vector(np.full(m, velocity_bound)),
        visibility=np.zeros(m, dtype=np.int64),
    )
