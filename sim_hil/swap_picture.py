"""`python -m sim_hil swaps LOG -o PICTURE.png`: M and speed limit over the swaps of a recording, by cycle."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np

from logs.audit_evidence import Evidence, gather
from logs.audit_tools import tools_after

BEFORE, AFTER = 40, 40  # cycles shown around a swap
MOST = 3  # swaps shown, those with people in reach first


def main(argv: list[str]) -> int:
    """Exit codes: 0 drawn, 1 no tool was swapped in motion, 2 bad usage."""
    parser = argparse.ArgumentParser(prog="python -m sim_hil swaps", description=__doc__)
    parser.add_argument("log", type=Path, metavar="LOG")
    parser.add_argument("-o", dest="out", type=Path, metavar="PNG", required=True)
    asked = parser.parse_args(argv)
    try:
        e = gather(asked.log)
    except (OSError, ValueError) as error:
        print(f"error: {asked.log}: {error}", file=sys.stderr)
        return 2
    used = tools_after(e)
    swaps = [int(i) for i in np.flatnonzero((used != e.c["state.tool"]) & e.moving)]
    if not swaps:
        print(f"{asked.log}: no tool was swapped in motion", file=sys.stderr)
        return 1
    with_people = sorted(swaps, key=lambda i: not np.any(_M(e, i) > 0.0))[:MOST]
    _draw(e, used, sorted(with_people), asked.out)
    return 0


def _M(e: Evidence, i: int) -> Any:
    """m/s2, of the nearest pairs of this cycle."""
    return e.log.layout.unpack(e.log.record(i))[2].decision.pairs.M


def _draw(e: Evidence, used: Any, swaps: list[int], path: Path) -> None:
    from matplotlib.figure import Figure

    names = [mount.tool.name for mount in e.log.params.changer.mounts]
    figure = Figure(figsize=(3.6 * len(swaps), 4.6), layout="constrained")
    panels = np.atleast_2d(figure.subplots(2, len(swaps), sharex="col", squeeze=False))
    for column, i in enumerate(swaps):
        cycles = np.arange(max(0, i - BEFORE), min(len(used), i + AFTER))
        limits = [e.log.params.holding(int(used[k])).robot.dq_max[0] for k in cycles]
        M = [float(found[0]) if len(found := _M(e, int(k))) else np.nan for k in cycles]
        speed = np.abs(e.c["state.dq_cmd"][cycles, 0])
        above, below = panels[0, column], panels[1, column]
        above.step(cycles - i, M, where="post", color="tab:blue", label="M of the nearest pair")
        below.step(cycles - i, limits, where="post", color="tab:red", label="speed limit of J1")
        below.plot(cycles - i, speed, color="black", label="speed of J1")
        above.set(title=f"{names[int(e.c['state.tool'][i])]} to {names[int(used[i])]}")
        below.set(xlabel="cycles from the swap", ylim=(0, None))
        for panel in (above, below):
            panel.axvline(0, color="grey", linestyle=":")
    panels[0, 0].set_ylabel("M [m/s2]")
    panels[1, 0].set_ylabel("[rad/s]")
    panels[0, 0].legend(fontsize="small")
    panels[1, 0].legend(fontsize="small")
    figure.savefig(path, dpi=90)
