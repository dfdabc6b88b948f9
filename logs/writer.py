"""The logger process: rings and bus -> one MCAP file.

    python -m logs.writer --cell CELL --ring /dev/shm/RING --out FILE.mcap

It ends by itself once the producer has closed the ring and everything is in the file; on SIGTERM it writes what is in
the ring and closes the file. Ctrl-C is left to the supervisor: the cycles of the braking robot are still to be written.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import struct
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from asc_rt import ring, topics
from asc_rt.bus import Bus, BusError, Latest, Publisher, Queue, open_client
from asc_rt.config import Cell, ConfigError, load_cell
from asc_rt.core.types import Mode, StopReason
from asc_rt.fixed_protobuf import Buffer
from asc_rt.record import RecordLayout
from logs import schema
from logs.context import attachments, session
from logs.display import Display
from logs.seal import KeyFileError, load_key
from logs.session_files import SessionFiles

POLL_S = 0.02  # joints reach perception so late at most: beyond its history it has to carry them on
FLUSH_NS = 50_000_000  # what a crash of the machine may cost
STATE_NS = 100_000_000
MAX_CAMERA_TOPICS = 16  # topics, two for each camera: an open bus must not fill the file with channels
MAX_TAKE = 1000  # messages of one key in one poll: a flood must not keep the cycles waiting
ORPHAN_NS = 1_000_000_000  # without a supervisor and without new cycles for this long, the session is over

BUS_CHANNELS = (
    (topics.HUMAN, schema.HUMAN),
    (topics.OPERATOR, schema.OPERATOR),
    (topics.GOAL, schema.GOAL),
    (topics.CONTROL, schema.CONTROL),
    (topics.PLANT_TRUTH, schema.TRUTH),
)


_WIRES = {"rx": schema.WIRE_RX, "tx": schema.WIRE_TX}
_STAMP = struct.Struct("<q")


class Logger:
    """Moves everything that is there into the file: `poll` again and again, then `finish`.

    When the disk takes no more, the file is closed as well as it can be, and from then on cycles are counted only.
    """

    def __init__(
        self,
        log: SessionFiles,
        layout: RecordLayout,
        cycles: ring.RingReader,
        wire: ring.RingReader | None,
        bus: Bus | None,
        display: Display | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._log, self._layout, self._clock = log, layout, clock
        self._cycles, self._wire, self._display = cycles, wire, display
        self._t_offset = layout.dtype.fields["inputs.t_ns"][1]  # type: ignore[index]
        self._inboxes: list[tuple[Latest | Queue, schema.Channel]] = []
        self._eyes: list[tuple[Queue, Callable[[bytes], schema.Channel | None]]] = []
        self._cameras: set[str] = set()  # topics of theirs
        self._state: Publisher | None = None
        self._joints: Publisher | None = None
        if bus is not None:
            self._inboxes = [(bus.queue(topic.key), channel) for topic, channel in BUS_CHANNELS]
            self._eyes = [
                (bus.queue(topics.CAMERA_CALIBRATION.key), schema.camera_calibration),
                (bus.queue(topics.CAMERA.key), schema.camera),
            ]
            self._state = bus.publisher(topics.STATE.key)
            self._joints = bus.publisher(topics.JOINTS.key)
        self._lost = {"cycle": 0, "wire": 0}
        self._newest: memoryview | None = None
        self._next_flush_ns = self._next_state_ns = self.last_cycle_ns = clock()
        self.records = 0
        self._unsafe = 0  # cycles taken since the last flush
        self.unrecorded = 0  # cycles taken that are not in the file
        self.failure: OSError | None = None  # why nothing is written any more

    @property
    def finished(self) -> bool:
        """The producer has closed the ring, and all of it is taken."""
        return self._cycles.finished

    def poll(self) -> None:
        """Take what is there; flush and tell the state when it is time."""
        now_ns = self._clock()
        try:
            self._take(now_ns)
        except OSError as error:
            if self.failure is not None:
                raise
            self._give_up(error)
        if now_ns >= self._next_state_ns:
            self._tell_state()
            self._next_state_ns = now_ns + STATE_NS

    def finish(self, reason: str) -> None:
        """Take the rest and close the file."""
        self._next_flush_ns = self._clock()
        self.poll()
        self._tell_state()
        if self.failure is None:
            try:
                self._close(reason)
                self._commit()
            except OSError as error:
                self._give_up(error)

    def _take(self, now_ns: int) -> None:
        self._take_cycles()
        self._take_wire()
        self._take_bus()
        for inbox, channel_of in self._eyes:
            self._take_camera(inbox, channel_of)
        self._count_losses()
        if now_ns >= self._next_flush_ns and self.failure is None:
            self._log.flush()
            self._commit()
            self._next_flush_ns = now_ns + FLUSH_NS

    def _close(self, reason: str) -> None:
        lost = {f"lost {name}": str(count) for name, count in self._lost.items()}
        self._log.close({"reason": reason, "records": str(self.records), "unrecorded": str(self.unrecorded), **lost})

    def _give_up(self, error: OSError) -> None:
        """What was taken and is not safe stays in the ring, uncommitted: `asc recover --ring` finds it there."""
        self.failure = error
        self.unrecorded += self._unsafe
        self.records -= self._unsafe
        self._log.log.forget()
        try:
            self._close(f"the disk failed: {error.strerror}")
        except OSError:
            self._log.log.abandon()

    def _take_cycles(self) -> None:
        while payloads := self._cycles.drain():
            self.last_cycle_ns, self._newest = self._clock(), payloads[-1]
            if self._joints is not None and (joints := joints_message(self._layout, payloads)):
                self._joints.put_json(joints)
            if self.failure is not None:
                self.unrecorded += len(payloads)
                continue
            self.records += len(payloads)
            self._unsafe += len(payloads)
            times = [_STAMP.unpack_from(payload, self._t_offset)[0] for payload in payloads]
            self._log.messages(schema.CYCLE, times, [self._layout.sealed(payload) for payload in payloads])
            if self._display is not None:
                for t_ns, payload in zip(times, payloads, strict=True):
                    self._display.cycle(self._log.log, t_ns, payload)

    def _take_wire(self) -> None:
        if self._wire is None:
            return
        while payloads := self._wire.drain():
            if self.failure is not None:
                continue
            passed: dict[str, tuple[list[int], list[bytes]]] = {direction: ([], []) for direction in _WIRES}
            for direction, t_ns, length, data in map(ring.parse_wire, payloads):
                times, packets = passed[direction]
                times.append(t_ns)
                packets.append(schema.wire_message(t_ns, length, data))
            for direction, (times, packets) in passed.items():
                if packets:
                    self._log.messages(_WIRES[direction], times, packets)

    def _take_bus(self) -> None:
        for inbox, channel in self._inboxes:
            for _ in range(MAX_TAKE):
                if (data := inbox.take()) is None:
                    break
                if self.failure is None:
                    self._log.message(channel, self._clock(), data)
                    if channel is schema.CONTROL:
                        self._keep_decided(data)

    def _take_camera(self, inbox: Queue, channel_of: Callable[[bytes], schema.Channel | None]) -> None:
        for _ in range(MAX_TAKE):
            if (data := inbox.take()) is None:
                return
            channel = channel_of(data)
            if channel is None or self.failure is not None:
                continue
            if channel.topic in self._cameras or len(self._cameras) < MAX_CAMERA_TOPICS:
                self._cameras.add(channel.topic)
                self._log.message(channel, self._clock(), data)

    def _keep_decided(self, data: bytes) -> None:
        """The control process tells what it really decides with, the robot's own limits included: replay needs that."""
        try:
            decided = json.loads(data)["params"].encode()
        except (ValueError, KeyError, TypeError, AttributeError):
            return  # another event, or not ours: the topic is open to anybody on the bus
        self._log.attach(schema.DECIDED, decided)

    def _count_losses(self) -> None:
        lost = {"cycle": self._cycles.lost, "wire": self._wire.lost if self._wire else 0}
        if lost != self._lost and self.failure is None:
            self._lost = lost
            self._log.json(schema.DROPOUT, self._clock(), lost)

    def _commit(self) -> None:
        """Everything taken is safe in the file."""
        self._unsafe = 0
        for reader in (self._cycles, self._wire):
            if reader is not None:
                reader.commit()

    @property
    def dropped(self) -> int:
        """Cycles that are not in the file."""
        return self._cycles.lost + self.unrecorded

    def _tell_state(self) -> None:
        if self._state is not None and self._newest is not None:
            self._state.put_json(state_message(self._layout, self._newest, self.dropped))


def joints_message(layout: RecordLayout, records: list[memoryview]) -> dict[str, Any]:
    """The samples of these cycles, for who has to know where the arm was at a capture; {}: the robot said nothing."""
    rows = np.frombuffer(b"".join(records), layout.dtype)
    rows = rows[rows["inputs.joint.present"] == 1]
    if not len(rows):
        return {}
    return {"t_ns": rows["inputs.joint.t_rx_ns"].tolist(), "q": rows["inputs.joint.q"].tolist()}


def state_message(layout: RecordLayout, record: Buffer, dropped: int) -> dict[str, Any]:
    """What the newest cycle says to the slow world; `d_min_now` in m, None: nobody near. `d_goal`: the same of the arm
    at its goal; under safety.d_min_m it waits until the person makes way."""
    row = np.frombuffer(record, layout.dtype)[0]
    distance, at_goal = float(row["outputs.decision.d_measured"]), float(row["outputs.decision.d_goal"])
    return {
        "tick": int(row["inputs.tick"]),
        "mode": Mode(int(row["state.mode"])).name,
        "reason": StopReason(int(row["outputs.decision.reason"])).name,
        "goal_id": int(row["state.goal.id"]),
        "reached_id": int(row["state.reached_id"]),
        "q_cmd": row["state.q_cmd"].tolist(),
        "dq_cmd": row["state.dq_cmd"].tolist(),
        "d_min_now": distance if math.isfinite(distance) else None,
        "d_goal": at_goal if math.isfinite(at_goal) else None,
        "dropped": dropped,
    }


# --- the process -----------------------------------------------------------------------------------------------------


def record_session(logger: Logger, stopping: Callable[[], bool], stop_when_full: bool) -> str:
    """Poll until the session is over; why it is."""
    supervisor = os.getppid()
    while True:
        logger.poll()
        if logger.finished:
            return "session closed"
        if stopping():
            return "terminated"
        if logger.failure is not None and stop_when_full:
            return "the disk failed"
        if os.getppid() != supervisor and time.monotonic_ns() - logger.last_cycle_ns > ORPHAN_NS:
            return "supervisor died"
        time.sleep(POLL_S)


def run(cell: Cell, ring_path: str, out: str, stopping: Callable[[], bool]) -> int:
    """Exit code: 0, or 1 if cycles are missing because of the disk."""
    layout = RecordLayout(cell.params.n)
    with ring.RingReader(ring_path) as cycles, ring.RingReader(ring.wire_path(ring_path)) as wire:
        if cycles.slot_size != layout.size:
            raise ring.RingError(f"{ring_path}: made for another record", hint="both ends must run the same code")
        path = Path(out)
        path.parent.mkdir(parents=True, exist_ok=True)
        display = Display(cell.params, layout)
        with open_client(cell.bus_endpoint) as bus:
            files = SessionFiles(
                path, attachments(cell), session(cell), _key(cell), cell.log.rotate_ns, begin=display.begin
            )
            logger = Logger(files, layout, cycles, wire, bus, display)
            logger.finish(record_session(logger, stopping, cell.log.stop_when_full))
    if logger.failure is None:
        return 0
    reason = logger.failure.strerror or str(logger.failure)
    return _refuse(f"{out}: {reason}: {logger.unrecorded} cycles are not in the log", code=1)


def _key(cell: Cell) -> Ed25519PrivateKey | None:
    """KeyFileError: the cell names a key that cannot be used. Without a place for a key of one's own there are no
    seals, and the audit says so."""
    try:
        return load_key(cell.log.key)
    except KeyFileError as error:
        if cell.log.key is not None:
            raise
        print(f"logger: not sealed: {error}; {error.hint}", file=sys.stderr)
        return None


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m logs.writer", description="Record one session.")
    parser.add_argument("--cell", required=True, help="name or file of the cell")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="override a value of the cell")
    parser.add_argument("--ring", required=True, help="the session's ring")
    parser.add_argument("--out", required=True, help="file to write; must not exist")
    options = parser.parse_args(arguments)
    terminated: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _: terminated.append(number))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        return run(load_cell(options.cell, options.set), options.ring, options.out, lambda: bool(terminated))
    except ConfigError as error:
        return _refuse(*error.lines)
    except (ring.RingError, BusError, KeyFileError) as error:
        return _refuse(f"{error}; {error.hint}" if error.hint else str(error))
    except OSError as error:
        return _refuse(f"{options.out}: cannot record: {error.strerror or error}")


def _refuse(*lines: str, code: int = 2) -> int:
    for line in lines:
        print(f"logger: {line}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
