"""The two ways to drive an arm, behind one interface: `step` decides accelerations and does not know which one it is.

STREAMING  the robot takes position set-points; the commanded state is the state, Ruckig makes the set-points
TORQUE     the robot takes torques; the measured state is the state, tau = H(q) u + h(q, dq)
"""

from __future__ import annotations

import dataclasses
from typing import Protocol

import numpy as np

from asc_rt.core import brake, gate, reference, smoothing, torque
from asc_rt.core.smoothing import SetPoint
from asc_rt.core.system import System
from asc_rt.core.types import CommandKind, CoreState, CycleInputs, Mode, Vector


class Level(Protocol):
    kind: CommandKind

    def track(self, system: System, state: CoreState, x: CycleInputs) -> CoreState:
        """Bring the state that the rows are evaluated at up to date with the robot."""

    def reference(self, system: System, state: CoreState) -> Vector:
        """u_ref, (n,) rad/s2."""

    def set_point(self, system: System, state: CoreState, u: Vector) -> SetPoint:
        """What makes the acceleration u happen. Raises smoothing.SmoothingError."""

    def stop(self, system: System, state: CoreState, x: CycleInputs) -> SetPoint:
        """Brake, or hold at rest. Raises smoothing.SmoothingError."""

    def may_pass(self, system: System, state: CoreState, point: SetPoint) -> bool:
        """The gate's limits."""


class Streaming:
    kind = CommandKind.POSITION

    def track(self, system: System, state: CoreState, x: CycleInputs) -> CoreState:
        return state  # what was sent is the state; a re-seed from the measured pose would be a jump

    def reference(self, system: System, state: CoreState) -> Vector:
        return reference.reference(system, state)

    def set_point(self, system: System, state: CoreState, u: Vector) -> SetPoint:
        return smoothing.smooth(system, state, u)

    def stop(self, system: System, state: CoreState, x: CycleInputs) -> SetPoint:
        return brake.brake(system, state)

    def may_pass(self, system: System, state: CoreState, point: SetPoint) -> bool:
        return gate.may_pass(system, state, point)


class Torque:
    kind = CommandKind.TORQUE

    def track(self, system: System, state: CoreState, x: CycleInputs) -> CoreState:
        """Moving: the measured state. At rest: the pose that is held, which nothing may drag along."""
        if x.joint is None or state.mode not in (Mode.ACTIVE, Mode.STOPPING):
            return state
        if state.mode is Mode.STOPPING and np.all(np.abs(x.joint.dq) < torque.REST_SPEED):
            return dataclasses.replace(state, q_cmd=x.joint.q, dq_cmd=system.zero, ddq_cmd=system.zero)
        return dataclasses.replace(state, q_cmd=x.joint.q, dq_cmd=x.joint.dq)

    def reference(self, system: System, state: CoreState) -> Vector:
        return torque.reference(system, state)

    def set_point(self, system: System, state: CoreState, u: Vector) -> SetPoint:
        return torque.set_point(system, state.q_cmd, state.dq_cmd, u)

    def stop(self, system: System, state: CoreState, x: CycleInputs) -> SetPoint:
        return torque.stop(system, state, x)

    def may_pass(self, system: System, state: CoreState, point: SetPoint) -> bool:
        return gate.torque_may_pass(system, point)


LEVELS: dict[str, Level] = {"acceleration": Streaming(), "torque": Torque()}
