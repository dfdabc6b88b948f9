"""A driver of either wire, its simulated robot with faults, and a core that follows a path and asks nothing."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from asc_rt.core.types import CommandKind, JointCommand, JointState, RobotFlag, Vector, vector
from drivers.base import DriverError, WriteReceipt
from drivers.fanuc_stream_motion.link import StreamMotion
from drivers.fanuc_stream_motion.link_b import StreamMotionB
from drivers.fanuc_stream_motion.session import Session
from sim_hil.fanuc.arm import KinematicPlant
from sim_hil.fanuc.cabinet import Cabinet
from sim_hil.fanuc.controller import Controller
from sim_hil.fanuc.controller_b import ControllerB
from sim_hil.fanuc.faults import FaultyController
from sim_hil.fanuc.lockstep import Lockstep, RmiLine
from sim_hil.fanuc.rmi import RmiServer
from sim_hil.fanuc.settings import Settings

START = np.radians([10.0, 20.0, -10.0, 40.0, -50.0, 60.0])
MOVE = np.radians([20.0, -10.0, 15.0, 30.0, 10.0, -40.0])
MOVE_S = 4.0
A, B = "A", "B"


class Rig:
    def __init__(
        self, wire: str, options: dict[str, Any] | None = None, period_ms: float = 8.0, **settings: Any
    ) -> None:
        common = {"period_ms": period_ms, "limits": True}
        self.period_ns = round(period_ms * 1e6)
        self.plant = KinematicPlant(START, period_ms * 1e-3)
        self.robot: Cabinet
        self.driver: Session
        if wire == A:
            self.robot = Controller(self.plant, Settings(**{**common, **settings}))
            self.faulty = FaultyController(self.robot)
            self.line = Lockstep(self.faulty)
            self.driver = StreamMotion(
                {"host": "robot", "limits": True, "arm": "lrmate_200id", **(options or {})},
                self._note,
                transport=self.line,
            )
        else:
            crx = {"arm": "crx_10ia_l", "start_move": 2, "filter_cycles": 1, "lag_ms": 110.0}
            self.robot = controller = ControllerB(self.plant, Settings(**{**common, **crx, **settings}))
            self.faulty = FaultyController(self.robot)
            self.line = Lockstep(self.faulty)
            self.rmi = RmiServer(controller, 16002)
            self.driver = StreamMotionB(
                {"host": "robot", "limits": True, "arm": "crx_10ia_l", "settle": 0.1, **(options or {})},
                self._note,
                transport=self.line,
                line=RmiLine(self.line, self.rmi),
            )
        self.sent: list[bytes] = []
        self.k = 0
        self.moving = False
        self.last = START

    def _note(self, direction: str, t_ns: int, data: bytes) -> None:
        if direction == "tx":
            self.sent.append(data)

    def begin(self) -> JointState:
        self.driver.configure()
        return self.driver.activate(self.period_ns)

    def read(self) -> JointState | None:
        return self.driver.read(self.line.now_ns() + 2 * self.period_ns)

    def write(self, q: Vector, last: bool = False) -> WriteReceipt:
        zero = vector(np.zeros(6))
        return self.driver.write(JointCommand(self.k, CommandKind.POSITION, vector(q), zero, zero, last))

    def path(self, k: int) -> Vector:
        """To START + MOVE, at rest at both ends, inside the tables of both arms."""
        t = min(1.0, max(0.0, (k - 10) * self.period_ns * 1e-9 / MOVE_S)) if self.moving else 0.0
        return START + MOVE * float(t**3 * (10 - 15 * t + 6 * t**2))

    def run(self, cycles: int, until: Callable[[], bool] = lambda: False) -> list[JointState | None]:
        """So many cycles as the shell runs them: no sample, no command; a robot that is lost gets none either."""
        joints = []
        for _ in range(cycles):
            joint = self.read()
            joints.append(joint)
            if joint is not None and RobotFlag.FAULTED not in joint.flags:
                self.write(self.path(self.k))
                self.k += 1
            if until():
                break
        return joints

    def try_run(self, cycles: int) -> tuple[list[JointState | None], DriverError | None]:
        joints: list[JointState | None] = []
        try:
            for _ in range(cycles):
                joints += self.run(1)
        except DriverError as error:
            return joints, error
        return joints, None

    def commands(self) -> list[bytes]:
        return [data for data in self.sent if data[3] in (1, 5, 201)]

    def numbers(self) -> list[int]:
        return [int.from_bytes(data[8:12], "big") for data in self.commands()]

    def forge(self, numbers: list[int], last: bool = False, word: int = 0xFFFF, ahead: float = 0.0) -> None:
        """Commands that the driver would not send; each a little ahead of the path."""
        data = bytearray(self.commands()[-1])
        for number in numbers:
            data[8:12] = number.to_bytes(4, "big")
            data[12] = last
            if data[3] == 201:
                data[14:16] = word.to_bytes(2, "big")
            if ahead:
                at = 16 if data[3] == 201 else 32
                value = np.frombuffer(bytes(data[at : at + 8]), ">f8")[0] + ahead
                data[at : at + 8] = np.array([value], ">f8").tobytes()
            self.line.send(bytes(data))

    @property
    def alarms(self) -> list[str]:
        return [alarm.number for alarm in self.robot.alarms]

    @property
    def offences(self) -> list[str]:
        return [offence.rule for offence in self.robot.offences]
