"""The simulated controller's Remote Motion Interface: one JSON object in, the replies out."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from sim_hil.fanuc.arm import to_wire
from sim_hil.fanuc.controller_b import ControllerB

PROGRAM = "STREAM_MOTN"
CANNOT_RUN, NOT_PAUSED, INVALID, WRONG_STATE, NOT_READY = 2556934, 2556938, 2556941, 2556943, 2556955
KINDS = ("Communication", "Command", "Instruction")


class RmiServer:
    def __init__(self, controller: ControllerB, port: int) -> None:
        self.controller = controller
        self.port = port  # that a client is sent to
        self.override = 100  # percent
        self._initialised = False
        self._next = 1

    def handle(self, line: bytes) -> list[bytes]:
        """What the controller answers to one line."""
        try:
            request = json.loads(line)
            kind, name = next((key, request[key]) for key in KINDS if key in request)
        except (ValueError, TypeError, StopIteration):
            return [_line({"Command": "Unknown", "ErrorID": INVALID})]
        answers: dict[str, Any] = {
            "FRC_Connect_STMO": lambda: {"PortNumber": self.port, "MajorVersion": 1, "MinorVersion": 0},
            "FRC_Disconnect": dict,
            "FRC_GetStatus": self._status,
            "FRC_Abort": self._abort,
            "FRC_Reset": self._reset,
            "FRC_Initialize": self._initialise,
            "FRC_Continue": lambda: {"ErrorID": NOT_PAUSED},
            "FRC_ReadJointAngles": self._joints,
            "FRC_ReadCartesianPosition": self._position,
            "FRC_ReadError": lambda: self._alarms(int(request.get("Count", 1))),
            "FRC_Call": lambda: self._call(request),
        }
        if name not in answers:
            return [_line({kind: name, "ErrorID": INVALID})]
        reply = answers[name]()
        return [] if reply is None else [_line({kind: name, "ErrorID": 0, **reply})]

    def _status(self) -> dict[str, Any]:
        robot = self.controller
        return {
            "ServoReady": int(robot.servo_on),
            "TPMode": int(robot.pendant_enabled),
            "RMIMotionStatus": 0,
            "ProgramStatus": 0 if robot.program_runs else 2,
            "SingleStepMode": 0,
            "NumberUTool": 10,
            "NumberUFrame": 9,
            "NextSequenceID": self._next,
            "Override": self.override,
        }

    def _abort(self) -> dict[str, Any]:
        self.controller.abort()
        self._initialised = False
        return {}

    def _reset(self) -> dict[str, Any]:
        self.controller.reset()
        return {}

    def _initialise(self) -> dict[str, Any]:
        if self.controller.program_runs:
            return {"ErrorID": WRONG_STATE}
        if not self.controller.servo_on:
            return {"ErrorID": NOT_READY}
        self._initialised = True
        return {"GroupMask": 1}

    def _call(self, request: dict[str, Any]) -> dict[str, Any] | None:
        if request.get("SequenceID") != self._next:
            return None  # dropped without a word
        self._next += 1
        number = {"SequenceID": request["SequenceID"]}
        if not self._initialised:
            return {"ErrorID": WRONG_STATE, **number}
        if request.get("ProgramName") != PROGRAM or self.controller.alarms:
            return {"ErrorID": CANNOT_RUN, **number}
        self.controller.call()
        return number

    def _joints(self) -> dict[str, Any]:
        """The pendant's J3, on this channel: against the horizontal. Resolution 0.001 deg."""
        angles = {f"J{i + 1}": round(float(angle), 3) for i, angle in enumerate(to_wire(self.controller.joints))}
        return {"TimeTag": self.controller.time_stamp, "JointAngle": angles}

    def _position(self) -> dict[str, Any]:
        pose = np.round(self.controller.arm.pose(self.controller.joints), 3)
        names = ("X", "Y", "Z", "W", "P", "R", "Ext1", "Ext2", "Ext3")
        return {"Configuration": {}, "Position": {n: float(v) for n, v in zip(names, pose, strict=True)}}

    def _alarms(self, count: int) -> dict[str, Any]:
        newest = [str(alarm) for alarm in reversed(self.controller.alarms)][:count]
        return {"ErrorData" + (str(i + 1) if i else ""): text for i, text in enumerate(newest)} or {"Count": 0}


def _line(reply: dict[str, Any]) -> bytes:
    return json.dumps(reply).encode()
