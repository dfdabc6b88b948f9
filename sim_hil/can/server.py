"""The simulated bus as a process: clients on a Unix socket, drives and arm inside, one bit clock for all.

What happens does not depend on how punctual this process is: a frame is on the bus from when its client sent it, and
every tick of drives and arm comes before the frames that end after it. A late process only tells late. To answer, the
bus runs ahead of the real clock by the bit times of what waits: frames are stamped with the bus time at which they end
and passed on at once, because sleeping for 100 us is nothing that this operating system can do. What the wire cannot
carry in time is refused to its sender by an error frame.
Exit code 0 after SIGTERM or SIGINT, 1 without a bus of the cell, 2 for bad input.
"""

from __future__ import annotations

import argparse
import select
import socket
import struct
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from asc_rt import launch, realtime
from asc_rt.bus import BusError
from asc_rt.config import Cell, ConfigError, load_cell
from sim_hil.can.arms import ARMS
from sim_hil.can.bus import Bus, Delivery
from sim_hil.can.faults import Fault, check_axes, due, heard, parse_script, read_script
from sim_hil.can.frames import Frame, pack, unpack
from sim_hil.can.line import TICK_NS, Line
from sim_hil.can.plugin import MAX_RECORD, STAMP, address, is_for, refusal
from sim_hil.world import World

PRIORITY = 40  # SCHED_FIFO; below the control process
LONGEST_PAUSE_NS = 100_000_000  # of this process, that is made up for; more is lost time
KEYS = ("arm", "start_deg", "stand", "nasty", "faults")


class Arm:
    """The world as mechanics of a line, one tick at a time."""

    def __init__(self, world: World) -> None:
        self._world = world

    @property
    def q(self) -> npt.NDArray[np.float64]:
        return self._world.q

    @property
    def dq(self) -> npt.NDArray[np.float64]:
        return self._world.dq

    def step(self, torque: npt.NDArray[np.float64], braked: npt.NDArray[np.bool_], seconds: float) -> None:
        self._world.set_torque(torque)
        self._world.set_brakes(braked)
        self._world.step()
        self._world.publish(time.monotonic_ns())


class Server:
    """Serves `line` to clients that name `channel`. OSError: it is served already."""

    def __init__(self, line: Line, channel: str) -> None:
        self.line = line
        self._clients: dict[int, socket.socket] = {}
        self._next = 0
        self._door = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._door.setblocking(False)
        try:
            self._door.bind(address(channel))
        except OSError:
            self._door.close()
            raise
        self._door.listen()

    def serve(self, stop: list[int], script: list[Fault], take_fault: Callable[[], bytes | None]) -> None:
        """Until `stop` is not empty. Faults of the script are due from the first client on, others at once."""
        self.line.begin(time.monotonic_ns())
        began_ns = 0
        while not stop:
            wait = max(0, self.line.due_ns - time.monotonic_ns()) * 1e-9
            readable, _, _ = select.select([self._door, *self._clients.values()], [], [], wait)
            now_ns = time.monotonic_ns()
            began_ns = began_ns or (now_ns if self._clients else 0)
            for fault in due(script, (now_ns - began_ns) * 1e-9 if began_ns else -1.0):
                fault.strike(self.line)
            for fault in heard(take_fault):
                self._strike(fault)
            if now_ns - self.line.now_ns > LONGEST_PAUSE_NS:
                self.line.begin(now_ns - LONGEST_PAUSE_NS)
            self._take(self._heard(readable))
            self._tell(partial(self.line.advance, now_ns))
            self._tell(self.line.settle)

    def _strike(self, fault: Fault) -> None:
        """What came over the bus; a mistake in there is told, and ends nothing."""
        try:
            check_axes([fault], len(self.line.drives))
        except ValueError as wrong:
            print(wrong, file=sys.stderr, flush=True)
            return
        fault.strike(self.line)

    def close(self) -> None:
        for client in self._clients.values():
            client.close()
        self._door.close()

    def _heard(self, readable: list[socket.socket]) -> list[tuple[int, int, Frame]]:
        """(when, from whom, what) clients have sent, in the order of time."""
        if self._door in readable:
            self._admit()
        frames: list[tuple[int, int, Frame]] = []
        for node, client in list(self._clients.items()):
            if client in readable:
                frames += self._drain(node, client)
        return sorted(frames, key=lambda sent: sent[0])

    def _take(self, frames: list[tuple[int, int, Frame]]) -> None:
        """Each at its time, if that is not over yet."""
        for t_ns, node, frame in frames:
            self._tell(partial(self.line.advance, t_ns))
            if not self.line.bus.submit(node, frame, max(t_ns, self.line.now_ns)) and node in self._clients:
                self._send(node, t_ns, refusal())

    def _tell(self, following: Callable[[], Delivery | None]) -> None:
        while (delivery := following()) is not None:
            for node in self._clients:
                if is_for(delivery, node):
                    self._send(node, delivery.t_ns, delivery.frame)

    def _send(self, node: int, t_ns: int, frame: Frame) -> None:
        with suppress(OSError):  # a client that does not read loses frames, as on a wire
            self._clients[node].send(STAMP.pack(t_ns) + pack(frame))

    def _admit(self) -> None:
        client, _ = self._door.accept()
        client.setblocking(False)
        self._clients[self._next] = client
        self.line.bus.join(self._next)
        self._next += 1

    def _drain(self, node: int, client: socket.socket) -> list[tuple[int, int, Frame]]:
        frames: list[tuple[int, int, Frame]] = []
        while True:
            try:
                raw = client.recv(MAX_RECORD)
                if raw:
                    sent_ns = min(STAMP.unpack_from(raw)[0], time.monotonic_ns())
                    frames.append((sent_ns, node, unpack(raw[STAMP.size :])))
                    continue
            except BlockingIOError:
                return frames
            except ConnectionResetError:  # it left without reading all; told once, before its last frames
                continue
            except (OSError, ValueError, struct.error):
                pass
            client.close()  # gone, or it speaks another language
            del self._clients[node]
            self.line.bus.leave(node)
            return frames


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m sim_hil can", description=__doc__.splitlines()[0])
    parser.add_argument("cell", help="cell file or name of a cell")
    launch.add_overrides(parser)
    parser.add_argument("--faults", type=Path, metavar="FILE", help="TOML with [[faults]], added to the cell's")
    args = parser.parse_args(argv)
    stop = launch.told_to_end()
    with ExitStack() as stack:
        try:
            cell = load_cell(args.cell, args.set)
            table = _table(cell)
            script = parse_script(table.get("faults", []), "sim.can")
            script += read_script(args.faults) if args.faults else []
            check_axes(script, cell.params.n)
            server, world = _server(cell, table, stack)
        except (ConfigError, ValueError) as failed:
            return _fail(failed, 2)
        except BusError as failed:
            return _fail(f"{failed}; {failed.hint}", 1)
        for line in realtime.set_up(PRIORITY, None)["missing"]:
            print(f"can: less punctual, it lacks {line}", file=sys.stderr)
        print(f"ready can {cell.driver['channel']}", flush=True)
        server.serve(stop, sorted(script, key=lambda fault: fault.at_s), world.take_fault)
    return 0


def _table(cell: Cell) -> dict[str, Any]:
    """[sim.can]. ValueError: this cell's robot is not ours to simulate, or something is wrong in the table."""
    if cell.driver["name"] != "can" or cell.driver.get("interface") != "asc-sim":
        raise ValueError('the cell\'s driver is not `can` on interface "asc-sim"')
    table = cell.sim.get("can", {})
    if unknown := sorted(set(table) - set(KEYS)):
        raise ValueError(f"sim.can: unknown key {', '.join(unknown)}; known: {', '.join(KEYS)}")
    if table.get("arm") not in ARMS:
        raise ValueError(f"sim.can.arm: {table.get('arm')!r} is unknown; known: {', '.join(ARMS)}")
    start = table.get("start_deg")
    if not isinstance(start, list) or len(start) != cell.params.n:
        raise ValueError(f"sim.can.start_deg: {cell.params.n} angles are needed, not {start!r}")
    return table


def _server(cell: Cell, table: dict[str, Any], stack: ExitStack) -> tuple[Server, World]:
    """ValueError: the channel is served already. BusError: nobody routes the cell's bus."""
    ticking = replace(cell, params=replace(cell.params, period_ns=TICK_NS))
    world = World(ticking, "can", np.radians(table["start_deg"]))
    stack.callback(world.close)
    arm = ARMS[table["arm"]]
    bus = Bus(arm.bitrate, arm.data_bitrate or arm.bitrate)
    try:
        line = Line(arm.drives(bool(table.get("nasty", False))), Arm(world), bus)
        line.on_stand = bool(table.get("stand", False))
        server = Server(line, cell.driver["channel"])
    except OSError as failed:
        raise ValueError(
            f"cannot serve {cell.driver['channel']!r}: {failed.strerror}; is it running already?"
        ) from None
    stack.callback(server.close)
    return server, world


def _fail(failed: object, code: int) -> int:
    print(f"can: {failed}", file=sys.stderr)
    return code
