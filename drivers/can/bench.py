"""`python -m drivers.can.bench`: a cycle of seven MIT axes on the simulated bus, beside python-can's `virtual`.

Round trip: from the first command to the last answer taken in, us; cost: CPU time of this process in a cycle, us. The
simulated bus runs in a process of its own and has physics; behind `virtual` a thread answers at once.
"""

from __future__ import annotations

import subprocess
import sys
import threading
import time

import can
import numpy as np

from asc_rt import realtime
from asc_rt.core.types import Vector
from drivers.can.arms import ARMS
from drivers.can.link import Link, opener
from drivers.can.stream import Stream, look

CYCLES = 500
ARM, CHANNEL = "openarm", "bench"
ANSWER = bytes([0, 0x80, 0, 0x80, 0x08, 0, 30, 30])


def measure(interface: str, hz: int) -> tuple[Vector, float, int]:
    """(round trips in us, CPU us for a cycle, answers missed). Nothing is enabled."""
    period_ns = 1_000_000_000 // hz
    link = Link(opener(interface, CHANNEL, is_fd=True))
    link.open()
    stream = Stream(link, ARMS[ARM], period_ns, 1_000_000_000, None)
    trips, begin = [], time.process_time()
    due_ns = time.monotonic_ns()
    for _ in range(CYCLES):
        due_ns += period_ns
        time.sleep(max(0, due_ns - time.monotonic_ns()) * 1e-9)
        sent_ns = time.monotonic_ns()
        stream.send(look(len(stream.axes)))
        stream.collect(sent_ns + period_ns)
        trips.append((max(axis.t_rx_ns for axis in stream.axes) - sent_ns) * 1e-3)
    link.close()
    return np.array(trips), (time.process_time() - begin) / CYCLES * 1e6, stream.counters.missed


def answer(bus: can.BusABC, over: threading.Event) -> None:
    """Seven drives that do nothing but answer."""
    while not over.is_set():
        message = bus.recv(0.1)
        if message is not None:
            node = message.data[0]
            data = bytes([node]) + ANSWER[1:]
            bus.send(can.Message(arbitration_id=0x10 + node, data=data, is_extended_id=False, is_fd=True))


def main() -> int:
    command = [sys.executable, "-m", "asc_rt", "sim", "can", "openarm-sim", "--set", f"driver.channel={CHANNEL}"]
    simulator = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert simulator.stdout is not None
    while "ready" not in (line := simulator.stdout.readline()):
        if not line:
            return 1
    other, over = can.Bus(interface="virtual", channel=CHANNEL, protocol=can.CanProtocol.CAN_FD), threading.Event()
    thread = threading.Thread(target=answer, args=(other, over))
    thread.start()
    realtime.set_up(80, None)
    print(f"{'bus':10} {'Hz':>5} {'p50 us':>8} {'p99 us':>8} {'CPU us':>8} {'missed':>7}")
    for hz in (250, 500):
        for interface in ("asc-sim", "virtual"):
            trips, cost, missed = measure(interface, hz)
            p50, p99 = np.percentile(trips, (50, 99))
            print(f"{interface:10} {hz:5} {p50:8.0f} {p99:8.0f} {cost:8.0f} {missed:7}")
    over.set()
    thread.join()
    other.shutdown()
    simulator.terminate()
    return 0


if __name__ == "__main__":
    sys.exit(main())
