"""A step of the ladder in lockstep: the real loop, core, driver and operator, the simulated robot with its faults, a
simulated person; in simulated time and without a process. Its recording is one like any other."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from asc_rt.config import Cell, load_cell
from asc_rt.core.system import System
from asc_rt.core.types import CoreState, CycleInputs, CycleOutputs, EventKind
from asc_rt.cycle import run
from asc_rt.inputs import Mail
from asc_rt.ladder.operator import StepOperator
from asc_rt.ladder.rules import Run
from asc_rt.ladder.steps import Step
from asc_rt.pacing import DevicePaced
from asc_rt.record import RecordLayout, Timings
from asc_rt.robot_limits import within
from drivers.base import WriteReceipt
from drivers.fanuc_stream_motion.link import StreamMotion
from logs import schema
from logs.audit_evidence import gather
from logs.context import attachments, session
from logs.log_file import LogFile
from logs.writer import state_message
from sim_hil.fanuc.arm import KinematicPlant
from sim_hil.fanuc.controller import Controller
from sim_hil.fanuc.faults import FaultyController
from sim_hil.fanuc.lockstep import Lockstep
from sim_hil.fanuc.settings import Settings
from sim_hil.human import HumanOptions, HumanSource
from tests.box import Box

KEY = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))
STATE_NS, SENSOR_NS = 100_000_000, 16_000_000

Mischief = Callable[["Rig"], None]  # called once in each cycle


class Rig:
    """`climb` runs the step to its end; as recorder it also lets person and operator speak once in each cycle."""

    def __init__(
        self,
        step: Step,
        log: Path,
        settings: Sequence[str] = (),
        name: str = "fanuc-sim-truth",
        mischief: Mischief | None = None,
    ) -> None:
        self.step, self.mischief = step, mischief or (lambda rig: None)
        base = load_cell(name, settings)
        speed = min(base.params.task.speed, step.task.speed)
        self.cell: Cell = load_cell(name, [*step.sim, f"task.speed={speed:g}", *settings])
        table = {k: v for k, v in self.cell.sim["fanuc"].items() if k != "faults"}
        self.plant = KinematicPlant(np.radians(table.get("start_deg", Settings().start_deg)), 0.008)
        self.robot = FaultyController(Controller(self.plant, Settings.parse({**table, "period_ms": 8.0})))
        self.line = Lockstep(self.robot, t_ns=5_000_000_000)
        self.packets: list[tuple[schema.Channel, int, bytes]] = []
        self.driver = StreamMotion(self.cell.driver_options, self._tap, transport=self.line)
        self.people, self.events, self.goals, self.faults = Box(), Box(), Box(), Box()
        self.operator = StepOperator(self.events, self.goals, self.faults, step, self.cell, lambda text: None)
        self.person = HumanSource(
            options := HumanOptions.of(self.cell.sim["human"]), self.line.now_ns() + round(options.start_s * 1e9)
        )
        self.sensor_works, self.cycles, self.ended = True, 0, False
        self._log_path, self._next_state_ns, self._next_sensor_ns = log, 0, 0

    def _tap(self, direction: str, t_ns: int, data: bytes) -> None:
        self.packets.append((schema.WIRE_RX if direction == "rx" else schema.WIRE_TX, t_ns, data))

    def climb(self) -> Run:
        params = within(self.cell.params, self.driver.configure().limits)
        self._layout = RecordLayout(params.n)
        self._buffer = self._layout.buffer()
        files = attachments(self.cell) | {schema.DECIDED: params.canonical()}
        self._log = LogFile(self._log_path, files, session(self.cell), key=KEY)
        self.driver.activate(params.period_ns)
        mail = Mail({1: self.people}, self.events, self.goals, joints=params.n)
        pacer = DevicePaced(params.period_ns, self.line.now_ns)
        self._begin_ns = self.line.now_ns()
        run(System(params), self.driver, mail, self, pacer, self.line.now_ns)
        self.driver.close()
        for channel, t_ns, data in self.packets:
            self._log.message(channel, t_ns, schema.wire_message(t_ns, len(data), data))
        self._log.close({"reason": "session closed"})
        return Run.of(self.step, gather(self._log_path))

    def put(
        self, before: CoreState, x: CycleInputs, out: CycleOutputs, sent: WriteReceipt | None, timings: Timings
    ) -> None:
        self._layout.pack(self._buffer, before, x, out, sent, timings)
        record = self._layout.sealed(self._buffer)
        self._log.message(schema.CYCLE, x.t_ns, record)
        self.cycles += 1
        now = self.line.now_ns()
        truth = {"q": self.plant.q.tolist(), "distance_m": None, "approach_m_s": 0.0, "contact": False}
        self._log.json(schema.TRUTH, x.t_ns, {"t_ns": x.t_ns, **truth})
        if self.sensor_works and now >= self._next_sensor_ns and (data := self.person.sensed(now)) is not None:
            self._next_sensor_ns = now + SENSOR_NS
            self.people.put(data)
        if now >= self._next_state_ns:
            self._next_state_ns = now + STATE_NS
            self._operate(record, now)
        self.mischief(self)

    def _operate(self, record: bytes, now: int) -> None:
        """What the supervisor does with a state."""
        self.operator.hear(state_message(self._layout, record, 0), now * 1e-9)
        if "human" in self.operator.takes_away:
            self.operator.takes_away.clear()
            self.sensor_works = False
        while (fault := self.faults.take()) is not None:
            told = json.loads(fault)
            self.robot.inject(told["fault"], 1, told["value"])
        timed_out = now - self._begin_ns > self.step.task.seconds * 1e9
        if (self.operator.is_done or timed_out) and not self.ended:
            self.ended = True
            self.operator.say(EventKind.END)
