"""From state and inputs to the safety rows of this cycle, and from what was decided to the record of it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from asc_rt.core import polytope, safety_index
from asc_rt.core.abstraction import Separation, least_distance, nearest_first, picked, separation_at
from asc_rt.core.kinematics import forward
from asc_rt.core.limits import braking, command_box
from asc_rt.core.people import carried, seen
from asc_rt.core.radius import radii_at
from asc_rt.core.realizable import with_torque
from asc_rt.core.robot_model import unpack
from asc_rt.core.safe_control import Solution
from asc_rt.core.safety_index import free_pairs, phi_rate, row_floors
from asc_rt.core.smoothing import SetPoint
from asc_rt.core.system import System
from asc_rt.core.types import (
    MAX_PAIRS,
    PAIR_ROWS,
    CoreState,
    CycleInputs,
    IntMatrix,
    IntVector,
    Matrix,
    Mode,
    Monitor,
    Pairs,
    SafetyDecision,
    Status,
    Vector,
    frozen,
    vector,
)

NO_PAIRS = Pairs(0, vector(np.zeros((PAIR_ROWS, MAX_PAIRS))))


class Rows(NamedTuple):
    """All active pairs, nearest first: the row of pair i is C[i] u >= floor[i]. In few arrays, because handing one over
    from a kernel costs more than filling it."""

    which: IntMatrix  # (4, p) robot capsule, human capsule, Basis of the floor, Outside
    values: Matrix  # (10, p) see the properties
    C: Matrix  # (p, n) m
    box: Matrix  # what the joint and torque limits allow this period, see polytope.pack

    def _row(self, i: int) -> Vector:
        row: Vector = self.values[i]
        return row

    @property
    def M(self) -> Vector:
        """m/s2"""
        return self._row(0)

    @property
    def M_dot(self) -> Vector:
        """m/s3"""
        return self._row(1)

    @property
    def phi(self) -> Vector:
        return self._row(2)

    @property
    def floor(self) -> Vector:
        """m/s2"""
        return self._row(3)

    @property
    def base(self) -> Vector:
        """m/s2, see safe_control"""
        return self._row(4)

    @property
    def basis(self) -> IntVector:
        basis: IntVector = self.which[2]
        return basis

    @property
    def pairs(self) -> Separation:
        d, d_dot, drift, own, own_drift = self.values[5:]
        return Separation(self.which[0], self.which[1], d, d_dot, self.C, drift, own, own_drift)


def rows(system: System, state: CoreState, x: CycleInputs) -> Rows:
    """Rows at the commanded state against the people of one command latency from now."""
    p, s = system.params, system.params.safety
    horizon = (x.human_age_ns + p.robot.command_latency_ns) * 1e-9
    q, dq, ddq = state.q_cmd, state.dq_cmd, state.ddq_cmd
    people, reach, a_h = seen(x.human), s.activation_distance, s.human_acceleration
    return Rows(*_rows(system.model.packed, system.packed_index, people, horizon, q, dq, ddq, p.period, reach, a_h))


@njit(cache=True)
def _rows(
    packed: Vector,
    packed_index: Vector,
    people: Matrix,
    horizon: float,
    q: Vector,
    dq: Vector,
    ddq: Vector,
    T: float,
    reach: float,
    human_acceleration: float,
) -> tuple[IntMatrix, Matrix, Matrix, Matrix]:
    """The fields of `Rows`."""
    arm, index = unpack(packed), safety_index.unpack(packed_index)
    b = arm.bounds
    then = carried(people, horizon)
    motion = forward(arm.chain, q, dq)
    pairs = nearest_first(separation_at(motion, arm.capsules, then, reach, human_acceleration))
    lower, upper = command_box(b, q, dq, ddq, T, index.at_once)
    U = with_torque(arm, motion, lower, upper)
    brake_time = np.max(np.abs(dq) / b.ddq_max + b.ddq_max / b.dddq_max)
    free = free_pairs(pairs, ddq, b.dddq_max, lower, upper, T, index, brake_time)
    M, M_dot, others = np.zeros(free.shape[0]), np.zeros(free.shape[0]), np.flatnonzero(~free)
    M[others], M_dot[others] = radii_at(arm, motion, then, q, dq, ddq, human_acceleration, picked(pairs, others))
    value, floor, base, basis, outside = row_floors(
        pairs, free, M, M_dot, ddq, b.dddq_max, lower, upper, braking(b, dq, lower, upper), T, index, brake_time
    )
    which, values = np.empty((4, M.shape[0]), np.int64), np.empty((10, M.shape[0]))
    which[0], which[1], which[2], which[3] = pairs.robot, pairs.human, basis, outside
    values[0], values[1], values[2], values[3], values[4] = M, M_dot, value, floor, base
    values[5], values[6], values[7] = pairs.d, pairs.d_dot, pairs.drift
    values[8], values[9] = pairs.d_dot_robot, pairs.drift_robot
    return which, values, pairs.C, polytope.pack(U)


def nearest_measured(system: System, x: CycleInputs) -> float:
    """Smallest separation distance of the measured arm from the people of now, m; inf without a pair."""
    if x.joint is None or x.human is None:
        return math.inf
    return _nearest(system, x, x.joint.q)


def nearest_at_goal(system: System, state: CoreState, x: CycleInputs) -> float:
    """Smallest separation distance of the arm at its goal from the people of now, m; inf without a goal or a pair."""
    return _nearest(system, x, state.goal.q) if state.goal.id > 0 and x.human is not None else math.inf


def _nearest(system: System, x: CycleInputs, q: Vector) -> float:
    return float(_nearest_at(system.model.packed, seen(x.human), x.human_age_ns * 1e-9, q))


@njit(cache=True)
def _nearest_at(packed: Vector, people: Matrix, horizon: float, q: Vector) -> float:
    arm = unpack(packed)
    return least_distance(arm.chain, arm.capsules, carried(people, horizon), q)


def decision(
    system: System,
    state: CoreState,
    found: Rows | None,
    solution: Solution | None,
    d_measured: float,
    d_goal: float,
    monitor: Monitor | None,
    point: SetPoint | None = None,
) -> SafetyDecision:
    """What goes into the record; pairs beyond MAX_PAIRS were in the QP and are only counted."""
    zero = system.zero
    return SafetyDecision(
        status=_status(state, solution),
        reason=state.reason,
        u_ref=vector(solution.u_ref) if solution else zero,
        u_safe=vector(solution.u) if solution and solution.feasible else zero,
        pairs=_pairs(system, found, point.ddq if point else zero),
        pair_count=found.which.shape[1] if found else 0,
        iterations=solution.iterations if solution else 0,
        share=solution.share if solution else 1.0,
        d_measured=d_measured,
        d_goal=d_goal,
        monitor=monitor,
    )


def _status(state: CoreState, solution: Solution | None) -> Status:
    if solution is not None and not solution.feasible:
        return Status.INFEASIBLE
    if solution is not None and state.mode is Mode.ACTIVE:
        return Status.FILTERED if solution.filtered else Status.PASS
    human = state.reason.is_of_people
    return Status.BAD_INPUT if state.mode is Mode.STOPPING and human else Status.STOPPED


def _pairs(system: System, found: Rows | None, ddq: Vector) -> Pairs:
    if found is None:
        return NO_PAIRS
    table = _table(found.which, found.values, found.C, ddq, system.packed_index)
    return Pairs(min(found.which.shape[1], MAX_PAIRS), frozen(table))


@njit(cache=True)
def _table(which: IntMatrix, values: Matrix, C: Matrix, ddq: Vector, packed_index: Vector) -> Matrix:
    """The table of `Pairs`, with C u and phi_dot of what is sent."""
    index, table = safety_index.unpack(packed_index), np.zeros((PAIR_ROWS, MAX_PAIRS))
    whole = table.view(np.int64)
    for i in range(min(C.shape[0], MAX_PAIRS)):
        achieved = 0.0
        for j in range(ddq.shape[0]):
            achieved += C[i, j] * ddq[j]
        M, M_dot, phi, floor = values[0, i], values[1, i], values[2, i], values[3, i]
        d, d_dot, drift = values[5, i], values[6, i], values[7, i]
        table[2, i], table[3, i], table[4, i], table[5, i], table[6, i] = d, d_dot, M, M_dot, phi
        table[7, i] = phi_rate(d, d_dot, achieved + drift, M, M_dot, index)
        table[8, i], table[9, i] = floor, achieved
        whole[0, i], whole[1, i], whole[10, i], whole[11, i] = which[0, i], which[1, i], which[2, i], which[3, i]
    return table
