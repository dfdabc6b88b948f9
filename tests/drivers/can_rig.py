"""A driver `can` with simulated drives in the same thread, in lockstep: time passes while the driver waits."""

from __future__ import annotations

import itertools
import os
import tempfile
from typing import Any, cast

import can
import numpy as np
from can_through import Through

from asc_rt.core.types import CommandKind, JointCommand, JointState, Vector, vector
from drivers.base import WireTap
from drivers.can.driver import Can
from sim_hil.can.arms import ARMS
from sim_hil.can.bus import Bus
from sim_hil.can.faults import Fault
from sim_hil.can.line import Line
from sim_hil.can.mechanics import Joints
from sim_hil.can.plugin import SimulatedBus

HOME = [0.0, 0.3, 0.0, -1.5, 0.0, 1.5, 0.0]  # of the Panda, whose elbow and wrist cannot be straight
_names = itertools.count()


class Rig:
    """`interface`: what the frames go through, see `can_through`."""

    def __init__(
        self,
        arm: str,
        tap: WireTap | None = None,
        mechanics: Any = None,
        interface: str = "asc-sim",
        **options: Any,
    ) -> None:
        data = ARMS[arm]
        drives = data.drives(False)
        self.line = Line(drives, mechanics or joints(arm, len(drives)), Bus(data.bitrate, data.data_bitrate or 1e6))
        name = f"rig-{os.getpid()}-{next(_names)}"
        table = {"interface": interface, "channel": name, "arm": arm, "listen_s": 0.02, "hold_s": 0.05}
        table |= {"lock_dir": tempfile.gettempdir(), **options}

        def open_bus() -> can.BusABC:
            bus = SimulatedBus(name, line=self.line)
            return bus if interface == "asc-sim" else cast(can.BusABC, Through(interface, data.data_bitrate > 0.0, bus))

        self.table, self.open_bus = table, open_bus
        self.driver = Can(table, tap, open_bus, self.now_ns)
        self.period_ns = round(table.get("period_ms", 4.0) * 1e6)
        self._due_ns = 0

    def now_ns(self) -> int:
        return self.line.now_ns

    def silence(self) -> None:
        for drive in self.line.drives:
            drive.is_silent = True

    def wait(self) -> None:
        """Until the next cycle is due."""
        self._due_ns = max(self._due_ns, self.now_ns() - self.period_ns) + self.period_ns
        self.run(max(0, self._due_ns - self.now_ns()))

    def run(self, ns: int) -> None:
        """Time passes; frames for the driver wait in its queue."""
        until_ns = self.now_ns() + ns
        while self.line.advance(until_ns) is not None:
            pass

    def strike(self, fault: str, axis: int = 0, value: float = 1.0) -> None:
        Fault(0.0, fault, axis, value).strike(self.line)

    def cycle(self, command: JointCommand) -> JointState | None:
        self.driver.write(command)
        self.wait()
        return self.driver.read(self.now_ns() + self.period_ns // 4)


def joints(arm: str, n: int) -> Joints:
    made = Joints.arm(n)
    if arm == "panda":
        made.inertia *= 3.0
        made.q[:] = HOME
    return made


def position(q: Vector, dq: Vector | None = None) -> JointCommand:
    zero = vector(np.zeros(len(q)))
    return JointCommand(0, CommandKind.POSITION, vector(q), zero if dq is None else vector(dq), zero, False)


def torque(q: Vector, dq: Vector, tau: Vector) -> JointCommand:
    return JointCommand(0, CommandKind.TORQUE, vector(q), vector(dq), vector(tau), False)
