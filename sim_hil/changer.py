"""`python -m sim_hil changer CELL TOOL ...`: swaps the tool of a simulated robot while it moves and nobody is near, one
number after the other (0: nothing; a number that the cell does not know is an unknown tool). What the controller makes
of each is in the recording: `asc audit`, rule "tool".
"""

from __future__ import annotations

import argparse
import json
import sys
import time

from asc_rt import topics
from asc_rt.bus import Bus, BusError, open_client
from asc_rt.config import ConfigError, load_cell

FAST = 0.5  # rad/s of some joint: it moves
CLEAR = 0.7  # m: no tool appears where a person is
LOOK = 0.05  # s between looks
WAIT_S = 300.0  # for a cell that is starting


def main(argv: list[str]) -> int:
    """Exit codes: 0 all were swapped, 1 the robot never moved in time, 2 bad usage."""
    parser = argparse.ArgumentParser(prog="python -m sim_hil changer", description=__doc__)
    parser.add_argument("cell", metavar="CELL")
    parser.add_argument("tools", metavar="TOOL", type=int, nargs="+", help="number, as the changer tells it")
    parser.add_argument("--every", metavar="S", type=float, default=4.0, help="least time between two swaps")
    asked = parser.parse_args(argv)
    try:
        cell = load_cell(asked.cell)
        with open_client(cell.bus_endpoint, timeout_s=WAIT_S) as bus:
            return _swap(bus, asked.tools, asked.every)
    except (ConfigError, BusError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def _swap(bus: Bus, tools: list[int], every: float) -> int:
    states, truths = bus.latest(topics.STATE.key), bus.latest(topics.PLANT_TRUTH.key)
    faults = bus.event_publisher(topics.FAULT.key)
    deadline, due = time.monotonic() + WAIT_S, 0.0
    while tools and time.monotonic() < deadline:
        time.sleep(LOOK)
        data, truth = states.take(), truths.take()
        if data is None or truth is None or time.monotonic() < due:
            continue
        state, distance = json.loads(data), json.loads(truth)["distance_m"]
        is_clear = distance is None or distance > CLEAR
        if is_clear and state["mode"] == "ACTIVE" and max(map(abs, state["dq_cmd"])) > FAST:
            faults.put_json({"at_s": 0, "fault": "tool", "value": tools.pop(0)})
            due = time.monotonic() + every
    time.sleep(LOOK)  # the last one is on its way
    return 1 if tools else 0
