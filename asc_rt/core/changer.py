"""Which tool the arm carries, and what a change of it means.

The tool that is told is taken over in the cycle that tells it: from there on model, capsules, M and limits are its own
(`System.holding`). Not to be moved with are a tool that nobody has told, that the cell does not know, that no
certificate covers, or that weighs something else than its file says. A mount with the number STAND_IN takes the place
of whatever the cell does not know.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from asc_rt.core.abstraction import Separation
from asc_rt.core.dynamics import inertia_and_bias
from asc_rt.core.kinematics import forward
from asc_rt.core.params import STAND_IN, ChangerParams, Params
from asc_rt.core.rows import Rows
from asc_rt.core.safety_index import JERK_SHARE, NO_JERK, Index, psi
from asc_rt.core.system import System
from asc_rt.core.types import CoreState, CycleInputs, EventKind, JointState, Mode, StopReason, Vector

UNTOLD, NOT_TOLD_OF = -1, 0  # JointState.tool_id: the robot should tell, and has not yet; it numbers no tools


def told(params: Params, state: CoreState, x: CycleInputs) -> int:
    """Index of the mount that the arm carries, by what this cycle tells; what nobody knows changes nothing."""
    changer, tool = params.changer, state.tool
    if changer.told_by_robot:
        found = _mount(changer, x.joint.tool_id) if x.joint is not None else None
        return tool if found is None else found
    for event in x.events:
        at_rest = state.mode in (Mode.HOLD, Mode.STOPPED)
        if event.kind is EventKind.TOOL and event.id > state.event_id and at_rest:
            found = _mount(changer, event.tool)
            tool = tool if found is None else found
    return tool


def _mount(changer: ChangerParams, number: int) -> int | None:
    numbers = [mount.number for mount in changer.mounts]
    if number in numbers:
        return numbers.index(number)
    return numbers.index(STAND_IN) if STAND_IN in numbers else None


def finding(params: Params, state: CoreState, joint: JointState) -> StopReason:
    """Why the arm must not move with the tool that it carries."""
    changer = params.changer
    if not changer.told_by_robot and joint.tool_id != NOT_TOLD_OF:  # it tells of one: the cell should listen
        return StopReason.TOOL_UNKNOWN if joint.tool_id == UNTOLD else StopReason.TOOL_MISMATCH
    if not changer.mounts:
        return StopReason.NONE
    if changer.told_by_robot and _mount(changer, joint.tool_id) is None:
        return StopReason.TOOL_UNKNOWN if joint.tool_id == UNTOLD else StopReason.TOOL_MISMATCH
    return StopReason.NONE if changer.mounts[state.tool].covered else StopReason.TOOL_UNCERTIFIED


def knows(params: Params, number: int) -> bool:
    """A person may name this tool."""
    return not params.changer.told_by_robot and _mount(params.changer, number) is not None


# --- the mass --------------------------------------------------------------------------------------------------------


def weighs_other(params: Params, state: CoreState, held: System, x: CycleInputs) -> bool:
    """At rest: some joint's motor current says another holding torque than arm and stated tool need. What a stand-in
    stands for may weigh anything."""
    changer = params.changer
    if not changer.nm_per_ampere or x.joint is None or changer.mounts[state.tool].number == STAND_IN:
        return False
    return not torque_misfit(held, x.joint, np.array(changer.nm_per_ampere)) <= changer.torque_tolerance


def torque_misfit(held: System, joint: JointState, nm_per_ampere: Vector) -> float:
    """max_i ||tau_i| - |g_i||, Nm: measured holding torques of an arm at rest against those of arm and stated tool.

    Currents come without a sign. All joints count, not a mass alone: a light tool that reaches far loads the arm in one
    pose like a heavy one that is short.
    """
    g = inertia_and_bias(forward(held.model.chain, joint.q, np.zeros(held.n)), held.model.arm.bodies)[1]
    return float(np.max(np.abs(np.abs(nm_per_ampere * joint.current) - np.abs(g))))


# --- in motion -------------------------------------------------------------------------------------------------------


def may_go_on(params: Params, held: System, state: CoreState, found: Rows, d_measured: float) -> bool:
    """A swap in motion: the new tool is where it could have come to by the rules, had it been there all along.

    That is: psi <= 0 for every pair (the set that the rows keep, so all that is proven of a run holds from here on),
    the measured arm as far from people as arming asks for, and no joint faster than this tool allows. Else it stops:
    the brake from the commanded state is the fastest there is, but no row had kept room for this tool.
    """
    s, b = held.params.safety, held.bounds
    if not (params.changer.goes_on and d_measured >= s.rearm_distance and np.all(np.abs(state.dq_cmd) <= b.dq_max)):
        return False
    brake_time = float(np.max(np.abs(state.dq_cmd) / b.ddq_max + b.ddq_max / b.dddq_max))
    worst = _worst(found.pairs, found.M, found.M_dot, state.ddq_cmd, b.dddq_max, held.index, brake_time)
    return bool(worst <= 0.0)


@njit(cache=True)
def _worst(
    pairs: Separation,
    M: Vector,
    M_dot: Vector,
    ddq: Vector,
    dddq_max: Vector,
    index: Index,
    brake_time: float,
) -> float:
    """Largest psi of all pairs; where the control hardly reaches (M under its floor), of the joint-space brake."""
    worst = -np.inf
    for i in range(M.shape[0]):
        along = J = 0.0
        for j in range(ddq.shape[0]):
            along += pairs.C[i, j] * ddq[j]
            J += JERK_SHARE * abs(pairs.C[i, j]) * dddq_max[j]
        d, v = pairs.d[i], -pairs.d_dot[i]
        if M[i] <= index.M_floor or J <= NO_JERK:
            value = max(v, -pairs.d_dot_robot[i]) * brake_time - (d - index.d_min)
        else:
            value = psi(d, v, -(along + pairs.drift[i]), M[i], M_dot[i], J, index)
        worst = max(worst, value)
    return worst
