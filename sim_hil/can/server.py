"""The simulated bus as a process: clients on a Unix socket, drives and arm inside, one bit clock for all.

Frames are stamped with the bus time at which they would have ended and passed on at once: sleeping for 100 us is
nothing that this operating system can do. What the wire cannot carry in time is refused to its sender by an error
frame.
Exit code 0 after SIGTERM or SIGINT, 1 without a bus of the cell, 2 for bad input.
"""

from __future__ import annotations

import argparse
import select
import socket
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from asc_rt import launch, realtime
from asc_rt.bus import BusError
from asc_rt.config import Cell, ConfigError, load_cell
from sim_hil.can.arms import ARMS
from sim_hil.can.bus import Bus
from sim_hil.can.faults import Fault, due, heard, parse_script, read_script
from sim_hil.can.frames import pack, unpack
from sim_hil.can.line import TICK_NS, Line
from sim_hil.can.plugin import MAX_RECORD, STAMP, address, is_for, refusal
from sim_hil.world import World

PRIORITY = 40  # SCHED_FIFO; below the control process
LONGEST_STEP = 20  # ticks that are made up for; a longer pause of this process is lost time
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
        """Until `stop` is not empty. Faults of the script are due from the first client on, others at once.

        Ticks have the time at which they were due and come before anybody is heard: late or not, a drive tells where
        the arm is by the clock of the bus.
        """
        due_ns = time.monotonic_ns()
        began_ns = 0
        while not stop:
            wait = max(0, due_ns - time.monotonic_ns()) * 1e-9
            readable, _, _ = select.select([self._door, *self._clients.values()], [], [], wait)
            now_ns = time.monotonic_ns()
            began_ns = began_ns or (now_ns if self._clients else 0)
            for fault in due(script, (now_ns - began_ns) * 1e-9 if began_ns else -1.0):
                fault.strike(self.line)
            for fault in heard(take_fault):
                fault.strike(self.line)
            behind = max(0, (now_ns - due_ns) // TICK_NS + 1)
            due_ns += behind * TICK_NS
            for past in range(min(behind, LONGEST_STEP), 0, -1):
                self.line.tick(due_ns - past * TICK_NS)
            self._hear(readable)

    def close(self) -> None:
        for client in self._clients.values():
            client.close()
        self._door.close()

    def _hear(self, readable: list[socket.socket]) -> None:
        now_ns = time.monotonic_ns()
        if self._door in readable:
            self._admit()
        for node, client in list(self._clients.items()):
            if client in readable:
                self._drain(node, client, now_ns)
        self._pass_on()

    def _pass_on(self) -> None:
        while (delivery := self.line.next()) is not None:
            record = STAMP.pack(delivery.t_ns) + pack(delivery.frame)
            for node, client in self._clients.items():
                if is_for(delivery, node):
                    with suppress(OSError):  # a client that does not read loses frames, as on a wire
                        client.send(record)

    def _admit(self) -> None:
        client, _ = self._door.accept()
        client.setblocking(False)
        self._clients[self._next] = client
        self.line.bus.join(self._next)
        self._next += 1

    def _drain(self, node: int, client: socket.socket, now_ns: int) -> None:
        while True:
            try:
                raw = client.recv(MAX_RECORD)
                frame = unpack(raw[STAMP.size :]) if raw else None
            except BlockingIOError:
                return
            except ConnectionResetError:  # it left without reading all; told once, before its last frames
                continue
            except (OSError, ValueError):
                frame = None
            if frame is None:  # gone, or it speaks another language
                client.close()
                del self._clients[node]
                self.line.bus.leave(node)
                return
            if not self.line.bus.submit(node, frame, now_ns):
                with suppress(OSError):
                    client.send(STAMP.pack(now_ns) + pack(refusal()))


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
