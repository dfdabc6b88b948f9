"""A made-up session: a decision that is cheap and uses most inputs, and the log that it leaves."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from asc_rt.config import Cell, load_cell
from asc_rt.core.fusion import heard
from asc_rt.core.params import Params
from asc_rt.core.step import step
from asc_rt.core.system import System, initial
from asc_rt.core.types import (
    CommandKind,
    CoreState,
    CycleInputs,
    CycleOutputs,
    EventKind,
    Goal,
    Health,
    HumanState,
    JointCommand,
    JointState,
    Mode,
    OperatorEvent,
    RobotFlag,
    SafetyDecision,
    Status,
    StopReason,
    Vector,
    vector,
)
from asc_rt.record import RecordLayout, Timings
from drivers.base import ReplayCodec, WriteReceipt
from drivers.registry import driver_class
from logs import schema
from logs.context import attachments, session
from logs.log_file import LogFile
from sim_hil.fanuc import wire as peer
from tests.pairs import pairs_of

PERIOD_NS = 8_000_000
KEY = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))
T0_NS = 5_000_000_000
Cycle = tuple[CoreState, CycleInputs, CycleOutputs, WriteReceipt | None, Timings]


def decide(state: CoreState, x: CycleInputs) -> tuple[CoreState, CycleOutputs]:
    """Stands in for `step`: pure, quick, and blind to the motor currents, as the real one may be."""
    q = state.q_cmd + 0.1 * (state.goal.q - state.q_cmd)
    d = float(np.linalg.norm(x.human.p0)) if x.human else float("inf")
    column, index = vector([d, d + 1.0]), np.arange(2)
    pairs = pairs_of(
        robot=index, human=index, basis=index, d=column, d_dot=column, M=column, M_dot=column, phi=column,
        phi_dot=column, floor=column, achieved=column, outside=0 * index,
    )  # fmt: skip
    armed = any(event.kind is EventKind.ARM for event in x.events)
    mode = Mode.ACTIVE if armed else state.mode
    last = any(event.kind is EventKind.END for event in x.events)
    reason = StopReason.SESSION_END if last else StopReason.NONE
    decision = SafetyDecision(
        status=Status.PASS, reason=reason, u_ref=vector(np.sin(x.joint.q)) if x.joint else vector(q), u_safe=vector(q),
        pairs=pairs, pair_count=2, iterations=x.missed_ticks, share=1.0, d_measured=d, d_goal=d, monitor=None,
    )  # fmt: skip
    command = JointCommand(x.tick, CommandKind.POSITION, vector(q), vector(q), vector(0 * q), last)
    after = dataclasses.replace(
        state, tick=x.tick + 1, mode=mode, reason=reason, q_cmd=vector(q), reached_id=x.tick // 40
    )
    return after, CycleOutputs(decision, command, None)


def inputs(tick: int, n: int) -> CycleInputs:
    t_ns = T0_NS + tick * PERIOD_NS
    rng = np.random.default_rng(tick)
    q, dq, current = (vector(rng.normal(size=n)) for _ in range(3))
    joint = JointState(t_ns - 20_000, tick, tick, q, dq, current, RobotFlag.READY, 0, True)
    m = tick % 3
    p0, p1, v0, v1 = (vector(rng.normal(size=(m, 3))) for _ in range(4))
    bound = vector(rng.uniform(0.1, 1.0, size=m))
    human = HumanState(
        t_capture_ns=t_ns - 30_000_000, seq=tick, sensor_id=1, calibration_hash=0, health=Health.OK, coverage=1.0,
        empty_certified=True, p0=p0, p1=p1, v0=v0, v1=v1, radius=bound, position_bound=bound, velocity_bound=bound,
        visibility=np.zeros(m, np.int64),
    )  # fmt: skip
    events = (OperatorEvent(1, EventKind.ARM),) if tick == 2 else ()
    seen = human if tick > 1 else None
    return CycleInputs(tick, t_ns, PERIOD_NS, joint, seen, 30_000_000, heard(seen, 30_000_000), None, events, 0, False)


def run_session(n: int, count: int, end: bool = True) -> list[Cycle]:
    zero = vector(np.zeros(n))
    state = CoreState(
        tick=0, mode=Mode.HOLD, reason=StopReason.NONE, slow=StopReason.NONE, tool=0, q_cmd=zero, dq_cmd=zero,
        ddq_cmd=zero, goal=Goal(1, vector(np.ones(n))), reached_id=0, event_id=0, silent_cycles=0, ending=False,
    )  # fmt: skip
    cycles: list[Cycle] = []
    for tick in range(count):
        x = inputs(tick, n)
        if end and tick == count - 1:
            x = dataclasses.replace(x, events=(OperatorEvent(2, EventKind.END),))
        after, out = decide(state, x)
        assert out.command is not None
        receipt = WriteReceipt(x.t_ns + 1_000_000, tick, out.command.q, True)
        cycles.append((state, x, out, receipt, Timings(x.t_ns - 10_000, x.t_ns, x.t_ns + 500_000, x.t_ns + 600_000)))
        state = after
    return cycles


@functools.cache
def _cell() -> Cell:
    return load_cell("fanuc-sim-truth")


@functools.cache
def _attachments() -> dict[str, bytes]:
    return attachments(_cell())


@functools.cache
def _session() -> dict[str, str]:
    return session(_cell())


class Recording:
    """Writes sessions to MCAP files the way the logger does."""

    def __init__(self, folder: Path) -> None:
        self.cell = _cell()
        self.params: Params = self.cell.params
        self.layout = RecordLayout(self.params.n)
        self._names = (folder / f"log{i}.mcap" for i in itertools.count())

    def cycles(self, count: int = 60, **options: Any) -> list[Cycle]:
        return run_session(self.params.n, count, **options)

    def packed(self, cycles: list[Cycle]) -> list[bytes]:
        buffer = self.layout.buffer()
        out = []
        for cycle in cycles:
            self.layout.pack(buffer, *cycle)
            out.append(self.layout.sealed(buffer))
        return out

    def write(
        self,
        records: list[bytes],
        messages: list[tuple[schema.Channel, int, dict[str, Any]]] = [],  # noqa: B006
        wire: bool = True,
        without: tuple[schema.Channel, int] | None = None,
        close: bool = True,
        fingerprint: dict[str, Any] | None = None,
        key: Ed25519PrivateKey | None = None,
    ) -> Path:
        path = next(self._names)
        files = dict(_attachments())
        if fingerprint is not None:
            files[schema.FINGERPRINT] = json.dumps(fingerprint).encode()
        # These packets are no robot's: a driver without a codec to check them with.
        about = {**_session(), "driver": json.dumps({"name": "loopback"})}
        log = LogFile(path, files, about, key=key)
        for k, record in enumerate(records):
            row = np.frombuffer(record, self.layout.dtype)[0]
            log.message(schema.CYCLE, T0_NS + k * PERIOD_NS, record)
            if wire:
                rx, tx = int(row["inputs.joint.t_rx_ns"]), int(row["receipt.t_tx_ns"])
                for channel, t_ns in ((schema.WIRE_RX, rx), (schema.WIRE_TX, tx)):
                    if (channel, k) != without:
                        log.message(channel, t_ns, schema.wire_message(t_ns, 3, b"abc"))
            if k % 6 == 5:
                log._next_seal_ns = 0  # as if a second had passed
                log.flush()
        for channel, t_ns, value in messages:
            log.json(channel, t_ns, value)
        log.flush()
        if close:
            log.close({"reason": "session closed"})
        return path


@pytest.fixture
def recording(tmp_path: Path) -> Recording:
    return Recording(tmp_path)


@pytest.fixture
def decision() -> Callable[[Params], Any]:
    """The stepper that made the recordings."""
    return lambda _: decide


# --- the real decision -----------------------------------------------------------------------------------------------


def approaching(t_ns: int, seq: int) -> HumanState:
    """An arm at 0.9 m that comes 2 mm closer every cycle."""
    p0 = vector([[0.9 - 0.002 * seq, 0.1, 0.2], [0.9 - 0.002 * seq, 0.2, 0.5]])
    v = vector(np.tile([-0.25, 0.0, 0.0], (2, 1)))
    bounds = vector([0.08] * 2), vector([0.02] * 2), vector([0.3] * 2)
    return HumanState(t_ns - 30_000_000, seq, 1, 0, Health.OK, 1.0, True, p0, p0, v, v, *bounds, np.zeros(2, np.int64))


@pytest.fixture
def core_session(recording: Recording) -> tuple[Path, list[Any]]:
    """The arm follows its set-points exactly and works towards a goal."""
    system = System(recording.params)
    state, goal = initial(system), Goal(1, vector([1.0, 0.3, 0.2, 0.0, -1.2, 0.0]))
    q: Vector = vector([0.0, 0.3, 0.2, 0.0, -1.2, 0.0])
    cycles = []
    for plain in (cycle[1] for cycle in recording.cycles(150)):
        k = plain.tick
        joint = dataclasses.replace(
            plain.joint, q=state.q_cmd if k else q, dq=state.dq_cmd, flags=RobotFlag.READY | RobotFlag.SERVO_ON
        )
        events = (OperatorEvent(1, EventKind.ARM),) if k == 3 else ()
        human = approaching(plain.t_ns, k + 1)
        sensors = heard(human, plain.human_age_ns)
        x = dataclasses.replace(plain, joint=joint, human=human, sensors=sensors, goal=goal, events=events, late=False)
        before = state
        state, out = step(system, before, x)
        assert out.command is not None
        cycles.append(
            (before, x, out, WriteReceipt(x.t_ns + 1_000_000, k, out.command.q, True), Timings(*[x.t_ns] * 4))
        )
    return recording.write(recording.packed(cycles), key=KEY), cycles


# --- true packets ----------------------------------------------------------------------------------------------------

Packets = list[tuple[schema.Channel, int, bytes]]


def status(seq: int, joints: Any, current: Any) -> bytes:
    return peer.write_reply("status", 3, sequence=seq, status=0x0F, joints=joints, current=current)


def codec() -> ReplayCodec:
    made = driver_class("fanuc-j519")({"host": "127.0.0.1", "version": 3})
    assert isinstance(made, ReplayCodec)
    return made


@pytest.fixture
def wire_session(recording: Recording, tmp_path: Path) -> Callable[..., Path]:
    """A session whose packets are true, and `spoil` to change them or the cycles."""

    def build(spoil: Callable[[Packets], None] = lambda packets: None, cell: Any = None) -> Path:
        packets: Packets = []
        cycles = []
        for state, x, out, receipt, timings in recording.cycles(12):
            joints = np.float32(np.linspace(-20, 30, 9) + x.tick)
            data = status(x.tick, joints, joints / 10)
            told = codec().decode_sample(data)
            assert told is not None
            joint = dataclasses.replace(x.joint, seq=told[0], q=told[1], current=told[2])
            packets.append((schema.WIRE_RX, joint.t_rx_ns, data))
            sent = codec().encode_command(receipt.seq, out.command)
            packets.append((schema.WIRE_TX, receipt.t_tx_ns, sent))
            cycles.append((state, dataclasses.replace(x, joint=joint), out, receipt, timings))
        spoil(packets)
        log = LogFile(tmp_path / "a.mcap", attachments(recording.cell), session(cell or recording.cell))
        for cycle, record in zip(cycles, recording.packed(cycles), strict=True):
            log.message(schema.CYCLE, cycle[1].t_ns, record)
        for channel, t_ns, data in packets:
            log.message(channel, t_ns, schema.wire_message(t_ns, len(data), data))
        log.close({})
        return tmp_path / "a.mcap"

    return build
