"""The audit's look at the tool: in every cycle the one that was told, and with it its own M, limits and certificate."""

from __future__ import annotations

import numpy as np

from asc_rt.core.params import STAND_IN
from logs.audit_evidence import Column, Evidence
from logs.audit_finding import Finding, skip


def tool(e: Evidence) -> Finding:
    """The tool decided with is the one that the robot told in that very cycle; every swap, with M before and after."""
    changer = e.log.params.changer
    if not changer.mounts:
        return skip("tool", "the cell has one tool")
    used = tools_after(e)
    swaps = np.flatnonzero(used != e.c["state.tool"])
    names = [mount.tool.name for mount in changer.mounts]
    e.notes["swaps"] = [_swap(e, int(i), names, used) for i in swaps]
    detail = "; ".join(f"{s['from']} to {s['to']} at {s['t_s']:.3f} s ({s['mode']})" for s in e.notes["swaps"][:8])
    if changer.told_by_robot:
        numbers = np.array([mount.number for mount in changer.mounts])
        told = e.c["inputs.joint.tool_id"]
        right = (numbers[used] == told) | ((numbers[used] == STAND_IN) & ~np.isin(told, numbers))
        bad = (e.c["inputs.joint.present"] == 1) & e.moving & ~right & np.isin(told, numbers)
        if bad.any():
            return Finding("tool", False, f"another tool than was told, first at {e.at(int(bad.argmax()))}")
    return Finding("tool", True, f"{len(swaps)} swaps{': ' + detail if detail else ''}")


def tools_after(e: Evidence) -> Column:
    """Index of the mount that each cycle was decided with; of the last cycle it is taken as before it."""
    before = e.c["state.tool"]
    return np.append(before[1:], before[-1:])


def _swap(e: Evidence, i: int, names: list[str], used: Column) -> dict[str, object]:
    """One swap: when, in which mode; M and the first joint's speed limit in the cycle before and in its own."""
    found: dict[str, object] = {
        "cycle": int(e.c["inputs.tick"][i]),
        "t_s": round(float(e.t_s[i]), 6),
        "from": names[int(e.c["state.tool"][i])],
        "to": names[int(used[i])],
        "mode": str(e.log.layout.unpack(e.log.record(i))[0].mode.name),
        "missed_ticks": int(e.c["inputs.missed_ticks"][i]),
    }
    for when, cycle in (("before", i - 1), ("after", i)):
        if cycle >= 0:
            M = e.log.layout.unpack(e.log.record(cycle))[2].decision.pairs.M
            held = e.log.params.holding(int(used[cycle]))
            found[f"M_{when}"] = [round(float(value), 4) for value in M[:3]]
            found[f"dq_max_{when}"] = round(held.robot.dq_max[0], 4)
    return found
