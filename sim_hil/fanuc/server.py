"""The simulated controller as a process: UDP in and out, one cycle each period of the monotonic clock.

Exit code 0 after SIGTERM or SIGINT, 1 in strict mode with offences or without a bus, 2 for bad input.
"""

from __future__ import annotations

import argparse
import socket
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path

import numpy as np

from asc_rt import launch, realtime
from asc_rt.bus import BusError
from asc_rt.config import Cell, ConfigError, load_cell
from sim_hil.fanuc import wire, wire_b
from sim_hil.fanuc.arm import KinematicPlant, Plant
from sim_hil.fanuc.cabinet import Cabinet, Peer
from sim_hil.fanuc.controller import Controller
from sim_hil.fanuc.controller_b import ControllerB
from sim_hil.fanuc.faults import Fault, FaultyController, heard, parse_script, read_script
from sim_hil.fanuc.rmi_sockets import RmiSockets
from sim_hil.fanuc.settings import Settings
from sim_hil.world import World

PRIORITY = 40  # SCHED_FIFO; below the control process, whose deadlines this one must not disturb
MAX_DATAGRAM = 2048
MAX_PACKETS = 64  # of one cycle: a flood must not stop the controller's time

Publish = Callable[[int], None]
Poll = Callable[[], None]
TakeFault = Callable[[], bytes | None]


CLASSIC, ROS = "fanuc-j519", "fanuc-stream-motion-b"  # drivers whose robot is simulated here
VERSIONS = {CLASSIC: wire.USABLE_VERSIONS, ROS: wire_b.USABLE_VERSIONS}
RMI_PORT = 16001


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m sim_hil fanuc", description=__doc__.splitlines()[0])
    parser.add_argument("cell", help="cell file or name of a cell")
    launch.add_overrides(parser)
    parser.add_argument("--strict", action="store_true", help="exit code 1 if the PC broke the protocol")
    parser.add_argument("--faults", type=Path, metavar="FILE", help="TOML with [[faults]], added to the cell's")
    parser.add_argument(
        "--plant", choices=("mujoco", "kinematic"), default="mujoco", help="kinematic: no dynamics, no person, no bus"
    )
    args = parser.parse_args(argv)
    stop = launch.told_to_end()
    with ExitStack() as stack:
        try:
            cell = load_cell(args.cell, args.set)
            settings, script = _settings(cell)
            script += read_script(args.faults) if args.faults else []
            link = stack.enter_context(_bind(cell))
            plant, publish, take_fault = _plant(cell, settings, args.plant, stack)
            controller: Cabinet
            if cell.driver["name"] == ROS:
                controller = ControllerB(plant, settings)
                sockets = _rmi(cell, controller)
                stack.callback(sockets.close)
                poll = sockets.poll
            else:
                controller, poll = Controller(plant, settings), None
        except (ConfigError, ValueError) as error:
            return _fail(error, 2)
        except BusError as error:
            return _fail(f"{error}; {error.hint}", 1)
        device = FaultyController(controller, script)
        return _run(link, device, (_both(poll, device, take_fault), publish), stop, args.strict)


def _settings(cell: Cell) -> tuple[Settings, list[Fault]]:
    """ValueError: this cell's robot is not ours to simulate, or something is wrong in [sim.fanuc]."""
    name = cell.driver.get("name")
    if name not in VERSIONS:
        raise ValueError(f"the cell's driver is {name!r}, not one of {', '.join(map(repr, VERSIONS))}")
    table = {"period_ms": cell.params.period_ns * 1e-6, **cell.sim.get("fanuc", {})}
    script = parse_script(table.pop("faults", []), "sim.fanuc")
    return Settings.parse(table, VERSIONS[name]), script


def _bind(cell: Cell) -> socket.socket:
    """ValueError: somebody else listens there."""
    host, port = cell.driver["host"], cell.driver.get("port", 60015)
    link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    link.setblocking(False)
    try:
        link.bind((host, port))
    except OSError as error:
        link.close()
        raise ValueError(f"cannot listen on {host}:{port}: {error.strerror}; is it running already?") from None
    return link


def _rmi(cell: Cell, controller: ControllerB) -> RmiSockets:
    host, port = cell.driver["host"], cell.driver.get("rmi_port", RMI_PORT)
    try:
        return RmiSockets(controller, host, port)
    except OSError as error:
        raise ValueError(f"cannot listen on {host}:{port} and {port + 1}: {error.strerror}") from None


def _both(poll: Poll | None, device: FaultyController, take_fault: TakeFault | None) -> Poll:
    """Once in each cycle: the sockets of RMI, and the faults that come over the bus."""

    def both() -> None:
        if poll is not None:
            poll()
        for fault in heard(take_fault) if take_fault is not None else ():
            device.inject(fault.fault, fault.count, fault.value)

    return both


def _plant(
    cell: Cell, settings: Settings, kind: str, stack: ExitStack
) -> tuple[Plant, Publish | None, TakeFault | None]:
    q0 = np.radians(settings.start_deg)
    if kind == "kinematic":
        return KinematicPlant(q0, settings.period), None, None
    world = World(cell, "fanuc", q0)
    stack.callback(world.close)
    return world, world.publish, world.take_fault


def _run(
    link: socket.socket,
    device: FaultyController,
    others: tuple[Poll, Publish | None],
    stop: list[int],
    strict: bool,
) -> int:
    for line in realtime.set_up(PRIORITY, None)["missing"]:
        print(f"fanuc: less punctual, it lacks {line}", file=sys.stderr)
    print("ready fanuc {}:{}".format(*link.getsockname()), flush=True)
    cycles, skipped = serve(link, device, others, stop)
    controller = device.controller
    alarms = ", ".join(str(alarm) for alarm in controller.alarms) or "none"
    offences = len(controller.offences)
    print(f"fanuc: {cycles} cycles, {skipped} skipped, {offences} offences, alarms: {alarms}", flush=True)
    return 1 if strict and controller.offences else 0


def serve(
    link: socket.socket,
    device: FaultyController,
    others: tuple[Poll, Publish | None],
    stop: list[int],
) -> tuple[int, int]:
    """Run until `stop` is not empty; (cycles run, periods skipped). Missed periods are lost time, never a burst."""
    controller, (poll, publish) = device.controller, others
    period_ns = round(controller.settings.period_ms * 1e6)
    cycles = skipped = told = 0
    due_ns = time.monotonic_ns() + period_ns
    while not stop:
        time.sleep(max(0, due_ns - time.monotonic_ns()) * 1e-9)
        missed = (time.monotonic_ns() - due_ns) // period_ns
        if missed > 0:
            skipped += missed
            due_ns += missed * period_ns
        for peer, data in device.cycle(_drain(link)):
            with suppress(OSError):  # to a PC that went away or does not read it is lost, as on a cable
                link.sendto(data, peer)
        poll()
        if publish is not None:
            publish(time.monotonic_ns())
        for offence in controller.offences[told:]:
            print(f"fanuc: offence: {offence.rule}: {offence.data.hex() or 'no bytes'}", file=sys.stderr, flush=True)
        told = len(controller.offences)
        cycles += 1
        due_ns += period_ns
    return cycles, skipped


def _drain(link: socket.socket) -> list[tuple[Peer, bytes]]:
    packets: list[tuple[Peer, bytes]] = []
    while len(packets) < MAX_PACKETS:
        try:
            data, peer = link.recvfrom(MAX_DATAGRAM)
        except BlockingIOError:
            break
        packets.append((peer, data))
    return packets


def _fail(error: object, code: int) -> int:
    print(f"fanuc: {error}", file=sys.stderr)
    return code
