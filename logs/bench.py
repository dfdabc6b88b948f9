"""`asc bench log`: what recording costs, in a loop of 1 kHz beside a logger that writes to the disk of the recordings.

ring     in the loop: all that the recorder's `put` does, from packing the record to handing over its slot of the ring.
         It comes after a decision that has left the caches cold, and in every cycle; so the goals are under 1 % of a
         period of 1 ms, and a tenth of one once in a thousand cycles. The packets' tap is the driver's, and not in it
logger   the other process: share of a core, with seals, at 1000 cycles and 2000 packets a second

As in a session, people come as often as a camera tells of them, and nobody presses a button in every cycle.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
import tempfile
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from asc_rt import realtime, ring
from asc_rt.bench import PAIRS, Row, Scene, row
from asc_rt.config import Cell, load_cell
from asc_rt.control import RingRecorder
from asc_rt.core.step import step
from asc_rt.record import RecordLayout, Timings
from drivers.base import WriteReceipt
from logs.context import attachments, session
from logs.display import Display
from logs.session_files import SessionFiles
from logs.writer import POLL_S, Logger

RUNS = Path("runs")  # where recordings go: the disk is part of the cost
PERIOD_NS = 1_000_000
CYCLES = 20_000
WARM_CYCLES = 100
SCENE_CYCLES = 200  # decisions that the loop repeats
PEOPLE_CYCLES = 16  # between two messages of people, as at 60 Hz
REPLY, COMMAND = bytes(132), bytes(104)  # packets as long as Stream Motion's
RING_US = {50: 8.0, 99.9: 100.0}  # goals, by percentile
LOGGER_SHARE = 5.0  # % of a core


def bench_log(cell_name: str, cell: Cell) -> list[Row]:
    """Rows of `asc bench log`."""
    RUNS.mkdir(exist_ok=True)
    with (
        tempfile.TemporaryDirectory(prefix="bench-", dir=RUNS) as place,
        tempfile.TemporaryDirectory(prefix="asc-bench-", dir="/dev/shm") as memory,
    ):
        path = Path(memory, "ring")
        ring.create_session(path, RecordLayout(cell.params.n).size, PERIOD_NS)
        ours, theirs = multiprocessing.Pipe()
        context = multiprocessing.get_context("spawn")
        logger = context.Process(target=_log, args=(cell_name, path, Path(place, "bench.mcap"), theirs), daemon=True)
        logger.start()
        ours.recv()  # it is ready
        costs = _loop(cell, path)
        used_s, records, dropped = ours.recv()
        logger.join()
    made = [
        row(f"ring_p{percentile:g}", float(np.percentile(costs, percentile)) * 1e-3, "us", goal)
        for percentile, goal in RING_US.items()
    ]
    share = 100.0 * used_s / (records * PERIOD_NS * 1e-9)
    logger_row = row("logger", share, "% of a core", LOGGER_SHARE)
    return [*made, logger_row, row("recorded", records, "records", CYCLES), row("dropped", dropped, "records", 1.0)]


def _loop(cell: Cell, path: Path) -> np.ndarray[Any, np.dtype[np.int64]]:
    """ns that each cycle spent on its record."""
    scene = Scene(cell.params, PAIRS[0])
    cycles = [scene.next() for _ in range(SCENE_CYCLES)]
    costs = np.zeros(CYCLES, np.int64)
    with ring.RingWriter(path) as records, ring.RingWriter(ring.wire_path(path)) as wire:
        recorder, tap = RingRecorder(records, RecordLayout(scene.system.n)), ring.wire_tap(wire)
        realtime.set_up(cell.realtime.priority, cell.realtime.cpu)
        due_ns = time.monotonic_ns()
        for k in range(CYCLES):
            due_ns += PERIOD_NS
            time.sleep(max(0, due_ns - time.monotonic_ns()) * 1e-9)
            before, x = cycles[k % SCENE_CYCLES]
            human = cycles[k // PEOPLE_CYCLES % SCENE_CYCLES][1].human
            t_ns = time.monotonic_ns()
            tap("rx", t_ns, REPLY)
            x = dataclasses.replace(x, t_ns=t_ns, human=human, events=())
            _, out = step(scene.system, before, x)
            sent = WriteReceipt(t_ns, k, out.command.q, True) if out.command else None
            tap("tx", t_ns, COMMAND)
            began_ns = time.perf_counter_ns()
            recorder.put(before, x, out, sent, Timings(t_ns, t_ns, t_ns, t_ns))
            costs[k] = time.perf_counter_ns() - began_ns
    return costs[WARM_CYCLES:]


def _log(cell_name: str, path: Path, out: Path, told: Connection) -> None:
    """The logger's process: CPU seconds, records and drops go through `told`."""
    cell = load_cell(cell_name)
    realtime.leave(cell.realtime.cpu)  # as the supervisor does for all that it starts
    layout = RecordLayout(cell.params.n)
    display = Display(cell.params, layout)
    with ring.RingReader(path) as cycles, ring.RingReader(ring.wire_path(path)) as wire:
        key = Ed25519PrivateKey.generate()
        files = SessionFiles(out, attachments(cell), session(cell), key, begin=display.begin)
        logger = Logger(files, layout, cycles, wire, None, display)
        told.send("ready")
        began = time.process_time()
        while not logger.finished:
            logger.poll()
            time.sleep(POLL_S)
        logger.finish("session closed")
        told.send((time.process_time() - began, logger.records, logger.dropped))
