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
import platform
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from asc_rt import ring, topics
from asc_rt.bus import Bus, BusError, Latest, Publisher, Queue, open_client
from asc_rt.config import Cell, ConfigError, load_cell
from asc_rt.core.types import Mode, StopReason
from asc_rt.fingerprint import fingerprint
from asc_rt.record import RecordLayout
from logs import schema
from logs.log_file import LogFile

POLL_S = 0.02
FLUSH_NS = 50_000_000  # what a crash of the machine may cost
STATE_NS = 100_000_000
MAX_TAKE = 1000  # messages of one key in one poll: a flood must not keep the cycles waiting
ORPHAN_NS = 1_000_000_000  # without a supervisor and without new cycles for this long, the session is over

BUS_CHANNELS = (
    (topics.HUMAN, schema.HUMAN),
    (topics.OPERATOR, schema.OPERATOR),
    (topics.GOAL, schema.GOAL),
    (topics.CONTROL, schema.CONTROL),
    (topics.PLANT_TRUTH, schema.TRUTH),
)


class Logger:
    """Moves everything that is there into the file: `poll` again and again, then `finish`."""

    def __init__(
        self,
        log: LogFile,
        layout: RecordLayout,
        cycles: ring.RingReader,
        wire: ring.RingReader | None,
        bus: Bus | None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._log, self._layout, self._clock = log, layout, clock
        self._cycles, self._wire = cycles, wire
        self._inboxes: list[tuple[Latest | Queue, schema.Channel]] = []
        self._state: Publisher | None = None
        if bus is not None:
            self._inboxes = [(bus.queue(topic.key), channel) for topic, channel in BUS_CHANNELS]
            self._state = bus.publisher(topics.STATE.key)
        self._lost = {"cycle": 0, "wire": 0}
        self._newest: bytes | None = None
        self._next_flush_ns = self._next_state_ns = self.last_cycle_ns = clock()
        self.records = 0

    @property
    def finished(self) -> bool:
        """The producer has closed the ring, and all of it is taken."""
        return self._cycles.finished

    def poll(self) -> None:
        """Take what is there; flush and tell the state when it is time."""
        self._take_cycles()
        self._take_wire()
        self._take_bus()
        self._count_losses()
        now_ns = self._clock()
        if now_ns >= self._next_flush_ns:
            self._flush()
            self._next_flush_ns = now_ns + FLUSH_NS
        if now_ns >= self._next_state_ns:
            self._tell_state()
            self._next_state_ns = now_ns + STATE_NS

    def finish(self, reason: str) -> None:
        """Take the rest and close the file."""
        self.poll()
        self._tell_state()
        lost = {f"lost {name}": str(count) for name, count in self._lost.items()}
        self._flush()
        self._log.close({"reason": reason, "records": str(self.records), **lost})

    def _take_cycles(self) -> None:
        t_offset = self._layout.dtype.fields["inputs.t_ns"][1]  # type: ignore[index]
        for record in self._cycles.drain():
            t_ns = int.from_bytes(record[t_offset : t_offset + 8], "little", signed=True)
            self._log.message(schema.CYCLE, t_ns, record)
            self._newest = record
            self.records += 1
            self.last_cycle_ns = self._clock()

    def _take_wire(self) -> None:
        if self._wire is None:
            return
        for payload in self._wire.drain():
            direction, t_ns, length, data = ring.parse_wire(payload)
            channel = schema.WIRE_RX if direction == "rx" else schema.WIRE_TX
            self._log.message(channel, t_ns, schema.wire_message(t_ns, length, data))

    def _take_bus(self) -> None:
        for inbox, channel in self._inboxes:
            for _ in range(MAX_TAKE):
                if (data := inbox.take()) is None:
                    break
                self._log.message(channel, self._clock(), data)

    def _count_losses(self) -> None:
        lost = {"cycle": self._cycles.lost, "wire": self._wire.lost if self._wire else 0}
        if lost != self._lost:
            self._lost = lost
            self._log.json(schema.DROPOUT, self._clock(), lost)

    def _flush(self) -> None:
        self._log.flush()
        for reader in (self._cycles, self._wire):
            if reader is not None:
                reader.commit()

    def _tell_state(self) -> None:
        if self._state is not None and self._newest is not None:
            self._state.put_json(state_message(self._layout, self._newest, self._lost["cycle"]))


def state_message(layout: RecordLayout, record: bytes, dropped: int) -> dict[str, Any]:
    """What the newest cycle says to the slow world; `d_min_now` in m, None: nobody near."""
    row = np.frombuffer(record, layout.dtype)[0]
    distance = float(row["outputs.decision.d_measured"])
    return {
        "tick": int(row["inputs.tick"]),
        "mode": Mode(int(row["state.mode"])).name,
        "reason": StopReason(int(row["outputs.decision.reason"])).name,
        "goal_id": int(row["state.goal.id"]),
        "reached_id": int(row["state.reached_id"]),
        "d_min_now": distance if math.isfinite(distance) else None,
        "dropped": dropped,
    }


# --- what is known before the first cycle ----------------------------------------------------------------------------


def attachments(cell: Cell) -> dict[str, bytes]:
    """Everything that a reader needs to run the session again and to judge it."""
    robot = cell.params.robot
    return {
        schema.PARAMS: cell.params.canonical(),
        schema.CELL: cell.text.encode(),
        f"{robot.name}.urdf": robot.urdf.encode(),
        schema.FINGERPRINT: json.dumps(fingerprint(), indent=1).encode(),
    }


def session(cell: Cell) -> dict[str, str]:
    """Who, where and what, as text."""
    uname = platform.uname()
    return {
        "cell": cell.name,
        "overrides": " ".join(cell.overrides),
        "simulated": str(cell.simulated).lower(),
        "params_sha256": cell.params.content_hash(),
        "git_commit": git_commit(),
        "host": f"{uname.node} {uname.system} {uname.release} {uname.machine}",
        "python": platform.python_version(),
        "started": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }


def git_commit(root: Path = Path(__file__).parent) -> str:
    """The commit of this code, with `-dirty` when files differ from it; `unknown` outside a checkout."""
    command = ["git", "-C", str(root), "describe", "--always", "--abbrev=40", "--dirty", "--exclude=*"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=5, check=True)
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return done.stdout.strip()


# --- the process -----------------------------------------------------------------------------------------------------


def record_session(logger: Logger, stopping: Callable[[], bool]) -> str:
    """Poll until the session is over; why it is."""
    supervisor = os.getppid()
    while True:
        logger.poll()
        if logger.finished:
            return "session closed"
        if stopping():
            return "terminated"
        if os.getppid() != supervisor and time.monotonic_ns() - logger.last_cycle_ns > ORPHAN_NS:
            return "supervisor died"
        time.sleep(POLL_S)


def run(cell: Cell, ring_path: str, out: str, stopping: Callable[[], bool]) -> None:
    layout = RecordLayout(cell.params.n)
    with ring.RingReader(ring_path) as cycles, ring.RingReader(ring.wire_path(ring_path)) as wire:
        if cycles.slot_size != layout.size:
            raise ring.RingError(f"{ring_path}: made for another record", hint="both ends must run the same code")
        Path(out).parent.mkdir(parents=True, exist_ok=True)
        with open_client(cell.bus_endpoint) as bus:
            log = LogFile(out, attachments(cell), session(cell))
            logger = Logger(log, layout, cycles, wire, bus)
            logger.finish(record_session(logger, stopping))


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
        run(load_cell(options.cell, options.set), options.ring, options.out, lambda: bool(terminated))
    except ConfigError as error:
        return _refuse(*error.lines)
    except (ring.RingError, BusError) as error:
        return _refuse(f"{error}; {error.hint}" if error.hint else str(error))
    except OSError as error:
        return _refuse(f"{options.out}: cannot record: {error.strerror or error}")
    return 0


def _refuse(*lines: str) -> int:
    for line in lines:
        print(f"logger: {line}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
