"""What the wire costs: `python -m drivers.fanuc_stream_motion.bench [--host ADDRESS] [--port N] [--cycles N]`.

Without a host, packets <-> numbers alone. With one, a session that holds the arm where it is, on the classic wire.
Rows, JSON, us: `codec` decode a status and encode, check and read back its command (`codec_ros` on the other wire);
`wake` a status in the kernel -> in this process; `answer` from there -> its command sent; `wake_to_send` both;
`round_trip` a command sent -> next status.
"""

from __future__ import annotations

import argparse
import json
import os
import socket
import struct
import time
from types import ModuleType
from typing import Any

import numpy as np

from asc_rt.core.types import CommandKind, JointCommand, JointState, vector
from drivers.base import LinkError
from drivers.fanuc_stream_motion import codec, codec_b
from drivers.fanuc_stream_motion.arms import ARMS
from drivers.fanuc_stream_motion.limits import LimitCheck, Tables
from drivers.fanuc_stream_motion.link import StreamMotion
from drivers.fanuc_stream_motion.packets import DOF, PORT, STAGES, Thresholds
from drivers.fanuc_stream_motion.transport import UdpTransport

REPETITIONS = 20_000
WARM_UP = 50  # cycles
PERIOD_NS = 8_000_000
PRIORITY = 80
_SO_TIMESTAMPNS = 35  # not in Python's socket module
_TIMESPEC = struct.Struct("@qq")


class StampedTransport(UdpTransport):
    """Notes when the kernel had each datagram."""

    def __init__(self, host: str, port: int) -> None:
        super().__init__(host, port)
        self.wake_ns = 0  # from the kernel's stamp of the newest datagram to us

    def open(self) -> None:
        super().open()
        self._open_socket().setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)

    def receive(self, deadline_ns: int) -> tuple[int, bytes] | None:
        link = self._open_socket()
        link.settimeout(max(0.0, (deadline_ns - time.monotonic_ns()) * 1e-9))
        try:
            data, ancillary, _, _ = link.recvmsg(2048, 64)
        except (BlockingIOError, TimeoutError):
            return None
        now_ns, t_ns = time.time_ns(), time.monotonic_ns()
        for _, kind, stamp in ancillary:
            if kind == _SO_TIMESTAMPNS:
                seconds, rest = _TIMESPEC.unpack(stamp)
                self.wake_ns = now_ns - (seconds * 1_000_000_000 + rest)
        return t_ns, data


def _tables() -> list[Thresholds]:
    wide = vector(np.full(STAGES, 1e6))
    return [Thresholds(axis + 1, kind, 4.0, wide, wide) for kind in range(3) for axis in range(DOF)]


def bench_codec(version: int, repetitions: int = REPETITIONS) -> list[int]:
    """ns per cycle of everything that turns bytes into numbers and back, on the classic wire."""
    status = struct.pack(">III BBHHH I 27f", 0, version, 7, 5, 0, 0, 0, 0, 0, *np.linspace(-90, 90, 27))
    return _time(codec, status, version, repetitions)


def bench_codec_ros(repetitions: int = REPETITIONS) -> list[int]:
    """The same on the ROS 2 wire, version 3."""
    numbers = np.linspace(-90, 90, 28)
    status = struct.pack(">III BBBB I 28f 256s", 202, 3, 7, 5, 0, 0, 0, 0, *numbers, bytes(256))
    return _time(codec_b, status, 3, repetitions)


def _time(wire: ModuleType, status: bytes, version: int, repetitions: int) -> list[int]:
    check = LimitCheck(Tables(_tables(), 1.0), ARMS["lrmate_200id"], PERIOD_NS * 1e-9)
    spent = []
    for _ in range(repetitions):
        began = time.perf_counter_ns()
        joint = wire.decode(status, version)
        data = wire.encode_command(version, 7, joint.q, False)
        told = wire.decode_command(data)
        check.breach(told.q)
        check.sent(told.q)
        spent.append(time.perf_counter_ns() - began)
    return spent


def bench_session(host: str, port: int, version: int, cycles: int) -> dict[str, list[int]]:
    """Hold the arm for so many cycles. DriverError: what the driver says."""
    transport = StampedTransport(host, port)
    driver = StreamMotion({"host": host, "port": port, "version": version}, transport=transport)
    rows: dict[str, list[int]] = {"wake": [], "answer": [], "wake_to_send": [], "round_trip": []}
    zero = vector(np.zeros(DOF))
    try:
        driver.configure()
        hold = driver.activate(PERIOD_NS).q
        sent_ns = 0
        for cycle in range(cycles):
            joint: JointState | None = driver.read(time.monotonic_ns() + 10 * PERIOD_NS)
            if joint is None:
                raise LinkError("the robot fell silent", hint="read the alarm at the pendant")
            wake = transport.wake_ns
            receipt = driver.write(JointCommand(cycle, CommandKind.POSITION, hold, zero, zero, False))
            answer = receipt.t_tx_ns - joint.t_rx_ns
            if cycle >= WARM_UP:
                for name, value in zip(rows, (wake, answer, wake + answer, joint.t_rx_ns - sent_ns), strict=True):
                    rows[name].append(value)
            sent_ns = receipt.t_tx_ns
    finally:
        driver.close()
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--host")
    parser.add_argument("--port", type=int, default=PORT)
    parser.add_argument("--version", type=int, choices=codec.VERSIONS, default=codec.VERSIONS[-1])
    parser.add_argument("--cycles", type=int, default=1000)
    args = parser.parse_args()
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
        real_time = True
    except OSError:
        real_time = False
    times = {"codec": bench_codec(args.version), "codec_ros": bench_codec_ros()}
    if args.host:
        times |= bench_session(args.host, args.port, args.version, args.cycles)
    rows: list[dict[str, Any]] = [
        {"name": name, "p50_us": np.median(t) * 1e-3, "p99_us": np.percentile(t, 99) * 1e-3, "max_us": max(t) * 1e-3}
        for name, t in times.items()
    ]
    print(json.dumps({"real_time": real_time, "version": args.version, "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
