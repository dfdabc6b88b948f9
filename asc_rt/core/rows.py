"""From state and inputs to the safety rows of this cycle, and from what was decided to the record of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asc_rt.core.abstraction import Separation, least_distance, radii, separation
from asc_rt.core.limits import command_box
from asc_rt.core.people import predict
from asc_rt.core.polytope import Polytope
from asc_rt.core.safe_control import Solution
from asc_rt.core.safety_index import phi_rate, row_floors
from asc_rt.core.smoothing import SetPoint
from asc_rt.core.system import System
from asc_rt.core.torque import command_set
from asc_rt.core.types import (
    MAX_PAIRS,
    CoreState,
    CycleInputs,
    IntVector,
    Matrix,
    Mode,
    Pairs,
    SafetyDecision,
    Status,
    StopReason,
    Vector,
    vector,
)


@dataclass(frozen=True, slots=True)
class Rows:
    """All active pairs, nearest first: the row of pair i is C[i] u >= floor[i]."""

    pairs: Separation
    M: Vector  # (p,) m/s2
    M_dot: Vector  # (p,) m/s3
    phi: Vector  # (p,)
    floor: Vector  # (p,) m/s2
    base: Vector  # (p,) m/s2
    basis: IntVector  # (p,) Basis
    U: Polytope  # what the joint limits allow this period

    @property
    def C(self) -> Matrix:
        return self.pairs.C


def rows(system: System, state: CoreState, x: CycleInputs) -> Rows:
    """Rows at the commanded state against the people of one command latency from now."""
    s, r = system.params.safety, system.params.robot
    people = predict(x.human, (x.human_age_ns + r.command_latency_ns) * 1e-9)
    model = (system.model.chain, system.model.capsules, people)
    q, dq, ddq = state.q_cmd, state.dq_cmd, state.ddq_cmd
    found = separation(*model, q, dq, s.activation_distance, s.human_acceleration)
    order = np.argsort(found.d, kind="stable")
    found = Separation(*(values[order] for values in found))
    M, M_dot = radii(system.model.arm, people, q, dq, ddq, s.human_acceleration, found)
    T, b = system.params.period, system.bounds
    brake_time = float(np.max(np.abs(dq) / b.ddq_max + b.ddq_max / b.dddq_max))
    U = command_set(system, q, dq, *command_box(b, q, dq, ddq, T))
    value, floor, base, basis = row_floors(
        found,
        M,
        M_dot,
        ddq,
        b.dddq_max,
        U.lower,
        U.upper,
        T,
        s.d_min,
        s.k,
        s.eta,
        s.M_floor,
        brake_time,
    )
    return Rows(
        found,
        M,
        M_dot,
        value,
        floor,
        base,
        basis,
        U,
    )


def nearest_measured(system: System, x: CycleInputs) -> float:
    """Smallest separation distance of the measured arm from the people of now, m; inf without a pair."""
    if x.joint is None or x.human is None:
        return float("inf")
    people = predict(x.human, x.human_age_ns * 1e-9)
    return float(least_distance(system.model.chain, system.model.capsules, people, x.joint.q))


def decision(
    system: System,
    state: CoreState,
    found: Rows | None,
    solution: Solution | None,
    d_measured: float,
    point: SetPoint | None = None,
) -> SafetyDecision:
    """What goes into the record; pairs beyond MAX_PAIRS were in the QP and are only counted."""
    zero = vector(np.zeros(system.n))
    return SafetyDecision(
        status=_status(state, solution),
        reason=state.reason,
        u_ref=vector(solution.u_ref) if solution else zero,
        u_safe=vector(solution.u) if solution and solution.feasible else zero,
        pairs=_pairs(system, found, point.ddq if point else zero),
        pair_count=len(found.M) if found else 0,
        iterations=solution.iterations if solution else 0,
        share=solution.share if solution else 1.0,
        d_measured=d_measured,
    )


def _status(state: CoreState, solution: Solution | None) -> Status:
    if solution is not None and not solution.feasible:
        return Status.INFEASIBLE
    if solution is not None and state.mode is Mode.ACTIVE:
        return Status.FILTERED if solution.filtered else Status.PASS
    human = StopReason.HUMAN_MISSING <= state.reason <= StopReason.HUMAN_INVALID
    return Status.BAD_INPUT if state.mode is Mode.STOPPING and human else Status.STOPPED


def _pairs(system: System, found: Rows | None, ddq: Vector) -> Pairs:
    none = np.zeros(0, dtype=np.int64)
    if found is None:
        empty = vector([])
        return Pairs(none, none, empty, empty, empty, empty, empty, empty, empty, empty, none)
    p = slice(0, MAX_PAIRS)
    s, pairs = system.params.safety, found.pairs
    achieved = pairs.C @ ddq
    return Pairs(
        robot=pairs.robot[p],
        human=pairs.human[p],
        d=vector(pairs.d[p]),
        d_dot=vector(pairs.d_dot[p]),
        M=vector(found.M[p]),
        M_dot=vector(found.M_dot[p]),
        phi=vector(found.phi[p]),
        phi_dot=vector(phi_rate(pairs, found.M, found.M_dot, achieved, s.d_min, s.k)[p]),
        floor=vector(found.floor[p]),
        achieved=vector(achieved[p]),
        basis=found.basis[p],
    )
