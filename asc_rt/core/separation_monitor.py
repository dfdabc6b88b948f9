"""Speed and separation monitoring in ISO's terms, beside the filter: a figure to look at; a stop where a cell asks.

ISO/TS 15066:2016, 5.5.4.2.3 (taken over by ISO 10218-2:2025), structure as in Marvel & Norcross, RCIM 44 (2017): the
robot may move while the distance to the person is at least the protective separation distance

    S_p = S_h + S_r + S_s + C + Z_d + Z_r

    S_h = v_h (T_a + T_r + T_s)   the person's way until the robot stands; v_h = 1.6 m/s walking where it is not
                                  measured (ISO 13855:2010)
    S_r = v_r T_r                 the robot's way until it begins to brake
    S_s = v_r T_s / 2             its way while it brakes: an S-curve from v_r to rest is symmetric
    C                             intrusion distance of ISO 13855: how far a part of the body reaches before it is seen
    Z_d, Z_r                      uncertainty of the person's and of the robot's place

T_a is the age of what is known of the person. The robot is taken as the worse of what is measured and of what it has
been told: the set-point sent last is where it will be one command latency from now, and its acceleration has to be
ramped down before it brakes (part of T_r), which makes it faster still. Of the measured robot alone S_p was too small
for an arm that starts (MEASURED: it approached at 0.34 m/s after such a stop had begun). The distance that S_p is
compared with is the one to where the person *was* then, without their velocity and without growth: S_h takes the place
of both. Not a safety function.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from asc_rt.core.abstraction import People, least_distance
from asc_rt.core.kinematics import Chain, cross, forward
from asc_rt.core.params import MonitorParams
from asc_rt.core.people import seen
from asc_rt.core.robot_model import Capsules, unpack
from asc_rt.core.system import System
from asc_rt.core.types import CoreState, CycleInputs, Matrix, Monitor, Vector


@dataclass(frozen=True, slots=True)
class ProtectiveDistance:
    """The terms of S_p, m."""

    S_h: float
    S_r: float
    S_s: float
    C: float
    Z_d: float
    Z_r: float

    @property
    def S_p(self) -> float:
        return self.S_h + self.S_r + self.S_s + self.C + self.Z_d + self.Z_r


def watch(system: System, state: CoreState, x: CycleInputs) -> Monitor | None:
    """This cycle's figures. What cannot be told is as bad as can be: a distance of 0, an infinite speed."""
    if x.joint is None or x.human is None:
        return None
    p, told = system.params, (state.q_cmd, state.dq_cmd, state.ddq_cmd)
    distance, speed, ramp, stop, uncertainty = _figures(
        system.model.packed, seen(x.human), x.joint.q, x.joint.dq, *told, p.period
    )
    age = max([x.human_age_ns, *(report.age_ns + report.sigma_ns for report in x.sensors)]) * 1e-9
    reaction = (p.period_ns + p.robot.command_latency_ns) * 1e-9 + ramp
    needed = protective_distance(p.monitor, speed, age, reaction, stop, uncertainty).S_p
    return Monitor(distance, math.inf if math.isnan(needed) else needed, speed, age, reaction, stop)


@njit(cache=True)
def _figures(
    packed: Vector, people: Matrix, q: Vector, dq: Vector, q_told: Vector, dq_told: Vector, ddq_told: Vector, T: float
) -> tuple[float, float, float, float, float]:
    """(distance to where the people were seen, v_r, ramp that T_r contains, T_s, Z_d)."""
    arm = unpack(packed)
    still, none = np.zeros((people.shape[0], 3)), np.zeros(people.shape[0])
    there = People(people[:, 0:3].copy(), people[:, 3:6].copy(), still, still, people[:, 12].copy(), none)
    distance = least_distance(arm.chain, arm.capsules, there, q)
    uncertainty = 0.0
    for h in range(people.shape[0]):
        uncertainty = max(uncertainty, people[h, 13])
    b = arm.bounds
    fastest, ramp = ramped_down(dq_told + T * ddq_told, ddq_told, b.dddq_max)
    stop = max(stopping_time(dq, b.ddq_max, b.dddq_max), stopping_time(fastest, b.ddq_max, b.dddq_max))
    speed = max(
        greatest_speed(arm.chain, arm.capsules, q, dq), greatest_speed(arm.chain, arm.capsules, q_told, fastest)
    )
    return 0.0 if np.isnan(distance) else distance, speed, ramp, stop, uncertainty


@njit(cache=True)
def ramped_down(dq: Vector, ddq: Vector, dddq_max: Vector) -> tuple[Vector, float]:
    """Speeds (n,) from which the joints brake when told to stop at (dq, ddq), and the time that takes, s.

    An acceleration away from rest is brought to zero first: |a| / J later the speed is v + a |a| / 2J. One that brakes
    already goes on, unless it would turn the joint round.
    """
    speed, ramp = dq.copy(), 0.0
    for i in range(dq.shape[0]):
        v, a, J = dq[i], ddq[i], dddq_max[i]
        after = v + a * abs(a) / (2.0 * J)
        if v * a >= 0.0 or after * v < 0.0:
            speed[i], ramp = after, max(ramp, abs(a) / J)
    return speed, ramp


def protective_distance(
    monitor: MonitorParams,
    robot_speed: float,
    age: float,
    reaction_time: float,
    stopping_time: float,
    sensor_uncertainty: float,
) -> ProtectiveDistance:
    """S_p of a robot whose fastest point moves at `robot_speed` (m/s); times in s, `sensor_uncertainty` Z_d in m."""
    return ProtectiveDistance(
        S_h=monitor.human_speed * (max(age, 0.0) + reaction_time + stopping_time),
        S_r=robot_speed * reaction_time,
        S_s=robot_speed * stopping_time / 2.0,
        C=monitor.intrusion_distance,
        Z_d=sensor_uncertainty,
        Z_r=monitor.robot_uncertainty,
    )


@njit(cache=True)
def stopping_time(dq: Vector, ddq_max: Vector, dddq_max: Vector) -> float:
    """T_s, s: until the last joint is at rest by an S-curve of its own, max of |dq| / A + A / J; 0 at rest.

    Too slow to reach A, a joint takes 2 sqrt(|dq| / J), which is less.
    """
    longest = 0.0
    for i in range(dq.shape[0]):
        v, A, J = abs(dq[i]), ddq_max[i], dddq_max[i]
        if np.isnan(v):
            return np.inf
        longest = max(longest, 2.0 * np.sqrt(v / J) if v * J < A * A else v / A + A / J)
    return longest


@njit(cache=True)
def greatest_speed(chain: Chain, capsules: Capsules, q: Vector, dq: Vector) -> float:
    """v_r, m/s: greatest speed of a point on the axes of the moving capsules; it is at an end, speed being convex.

    A capsule's surface turns with it: its radius times the angular speed is added.
    """
    motion = forward(chain, q, dq)
    greatest = 0.0
    for i in range(capsules.joint.shape[0]):
        joint = capsules.joint[i]
        if joint < 0:
            continue
        rotation, omega = motion.rotation[joint], motion.omega[joint]
        spin = np.sqrt(omega[0] * omega[0] + omega[1] * omega[1] + omega[2] * omega[2])
        for local in (capsules.p0[i], capsules.p1[i]):
            arm = np.empty(3)
            for k in range(3):
                arm[k] = rotation[k, 0] * local[0] + rotation[k, 1] * local[1] + rotation[k, 2] * local[2]
            turn = cross(omega, arm)
            square = 0.0
            for k in range(3):
                v = motion.velocity[joint, k] + turn[k]
                square += v * v
            speed = np.sqrt(square) + spin * capsules.radius[i]
            if np.isnan(speed):
                return np.inf
            greatest = max(greatest, speed)
    return greatest
