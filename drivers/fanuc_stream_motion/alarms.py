"""The controller's alarms: what they mean, what to do at the pendant. Numbers can change with the software version."""

from __future__ import annotations

import re
from typing import NamedTuple


class Meaning(NamedTuple):
    meaning: str
    do: str


_LIMIT_DO = "lower the limits in the robot's profile; check payload and 100 % override; RESET, start the program"
_LOWER = "a set-point beyond the controller's limit table"

MEANINGS = {
    "MOTN-018": Meaning("position not reachable", "select a zero user tool; send joint positions"),
    "MOTN-156": Meaning("another arm configuration", "send joint positions, or keep the configuration"),
    "MOTN-601": Meaning(
        "a command number was repeated or left out", "check cable and switch for lost packets; RESET, start the program"
    ),
    "MOTN-603": Meaning(
        "commands came too late and the buffer ran dry",
        "check real-time set-up, load and network of the PC; raise $STMO.$START_MOVE; RESET, start the program",
    ),
    "MOTN-607": Meaning(
        "the PC speaks a newer protocol version", "set driver.version to $STMO.$USABLE_VER or lower; RESET"
    ),
    "MOTN-609": Meaning(f"{_LOWER}: joint velocity", _LIMIT_DO),
    "MOTN-610": Meaning(f"{_LOWER}: joint acceleration", _LIMIT_DO),
    "MOTN-611": Meaning(f"{_LOWER}: joint jerk", _LIMIT_DO),
    "MOTN-615": Meaning("brake control is on", "$PARAM_GROUP[1].$SV_OFF_ENB[*] = FALSE, then power off and on"),
    "MOTN-623": Meaning("resume offset is on", "disable the resume offset, RESET"),
    "MOTN-625": Meaning(
        "the first set-point is not where the arm is", "RESET and start again: a session begins at the measured pose"
    ),
    "MOTN-720": Meaning(f"{_LOWER}: joint velocity", _LIMIT_DO),
    "MOTN-721": Meaning(f"{_LOWER}: joint acceleration", _LIMIT_DO),
    "MOTN-722": Meaning(f"{_LOWER}: joint jerk", _LIMIT_DO),
    "PRIO-023": Meaning("a signal that is not assigned", "correct driver.tool_input, or assign the signal"),
    "SYST-322": Meaning("moved longer than the automatic status check allows", "raise the DCS auto status check time"),
    "SYST-323": Meaning("faster than the collaborative speed limit", "lower task.speed; the limit is 750 mm/s"),
    "SYST-328": Meaning("payload not confirmed", "confirm the payload at the pendant"),
    "SYST-348": Meaning("payload not confirmed", "confirm the payload at the pendant"),
    "HOST-380": Meaning(
        "a packet that the controller does not know, or another PC", "stop every other client; if it stays, restart it"
    ),
    "SRVO-002": Meaning("emergency stop of the pendant", "release the emergency stop, press RESET"),
    "SRVO-115": Meaning("an axis is at its limit", "RESET, jog the axis back with the pendant"),
    "SRVO-289": Meaning("emergency stop", "release the emergency stop, press RESET"),
    "RMIT-016": Meaning("the remote motion interface is stuck", "switch the controller off and on"),
}

LIMIT_ALARMS = ("MOTN-720", "MOTN-721", "MOTN-722")  # velocity, acceleration, jerk; older software 609-611
START_ALARM = "MOTN-625"
LATE_ALARM = "MOTN-603"


def explain(text: str) -> Meaning | None:
    """Of the first known alarm number in `text`, such as a line of the alarm history."""
    for number in re.findall(r"[A-Z]{4}-\d{3}", text):
        if number in MEANINGS:
            return MEANINGS[number]
    return None
