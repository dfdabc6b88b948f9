"""What the operator of a stopped robot can do, reason by reason."""

from __future__ import annotations

from asc_rt.core.types import StopReason

R = StopReason
HINTS: dict[StopReason, str] = {
    R.SESSION_END: "nothing: the session ended as asked",
    R.OPERATOR_STOP: "arm it when the cell is clear",
    R.HUMAN_MISSING: "start perception; nothing was heard of it yet",
    R.HUMAN_STALE: "see why perception fell silent, then arm",
    R.HUMAN_UNHEALTHY: "see what perception says of its cameras, then arm",
    R.HUMAN_COVERAGE: "see what hides the cell from its cameras, then arm",
    R.HUMAN_UNSYNCED: "see the network between perception's machine and this one, then arm",
    R.HUMAN_INVALID: "see that one perception runs, with the cell's calibration, then arm",
    R.TOOL_CHANGED: "see that the right tool is locked in the changer, then arm",
    R.TOOL_UNKNOWN: "see that the tool sits in the changer and that its number reaches the controller, then arm",
    R.TOOL_MISMATCH: "mount the tool that the cell file names, or name the one that is mounted, then arm",
    R.TOOL_UNCERTIFIED: "certify this tool in this cell (asc certify --cell CELL --tool TOOL), or mount another one",
    R.INFEASIBLE: "wait until the person has room, then arm",
    R.START_INSIDE: "ask the person to step back beyond the rearm distance, then arm",
    R.LATE: "see what loads this PC (asc doctor), then arm",
    R.SEPARATION: "wait until the person has gone farther away, then arm",
    R.ROBOT_WARM: "let its drives cool down: it goes slowly until then",
    R.HUMAN_SCHEMA: "let perception and control run the same version; start the session again",
    R.HUMAN_CLOCK: "start perception anew, so that it measures this PC's clock; start the session again",
    R.HUMAN_CALIBRATION: "let perception use the calibration that the cell names; start the session again",
    R.TRACKING: "see what holds the arm, and its payload; start the session again",
    R.GATE: "keep the recording and report it: a defect was caught; start the session again",
    R.EXCEPTION: "keep the recording and report it: a defect of the controller; start the session again",
    R.ROBOT_NOT_READY: "bring the robot into the state that takes set-points; start the session again",
    R.ROBOT_SILENT: "see the robot's network and power; start the session again",
    R.ROBOT_FAULTED: "clear the alarm at the robot; start the session again",
}
