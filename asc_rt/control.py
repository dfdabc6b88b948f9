"""The control process: `python -m asc_rt.control CELL --ring PATH [--set key=value]`.

Exit code 0: the session ended as asked; 1: it ended for a fault; 2: it did not begin. Errors: one line each on stderr.
"""

from __future__ import annotations

from asc_rt import footprint, launch, realtime

if __name__ == "__main__":
    realtime.one_blas_thread()  # before anything below imports numpy
    footprint.lean_start()

import argparse
import math
import os
import signal
import sys
import time
import traceback
from typing import Any

import numpy as np

from asc_rt import pacing, topics
from asc_rt.bus import Bus, BusError, open_client
from asc_rt.certified import covered, require
from asc_rt.config import Cell, ConfigError, load_cell
from asc_rt.core import torque
from asc_rt.core.levels import LEVELS
from asc_rt.core.system import System
from asc_rt.core.types import CoreState, CycleInputs, CycleOutputs, Mode, StopReason, vector
from asc_rt.core.warm import warm_up
from asc_rt.cycle import run
from asc_rt.inputs import Mail
from asc_rt.packing import RecordError
from asc_rt.record import RecordLayout, Timings
from asc_rt.ring import RingError, RingWriter, wire_path, wire_tap
from asc_rt.robot_limits import within
from drivers import registry
from drivers.base import (
    DriverCaps,
    DriverError,
    HandshakeError,
    Reporting,
    RobotDriver,
    RobotFaulted,
    Weighted,
    WriteReceipt,
)

COMPLETED, FAILED, NOT_BEGUN = 0, 1, 2
REACH_TOLERANCE = 1e-4  # rad: rounding of degrees in files and of counts in drives


class RingRecorder:
    """Packs each cycle into its slot of the ring. `unrecorded` counts the cycles that did not fit the record."""

    def __init__(self, ring: RingWriter, layout: RecordLayout) -> None:
        self.unrecorded = 0
        self._ring, self._layout = ring, layout

    def put(
        self, before: CoreState, x: CycleInputs, out: CycleOutputs, sent: WriteReceipt | None, timings: Timings
    ) -> None:
        ring, layout = self._ring, self._layout
        at = ring.begin(layout.size)
        try:
            layout.pack(ring.memory, before, x, out, sent, timings, at)
        except RecordError:
            self.unrecorded += 1
            return
        ring.end()


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m asc_rt.control", description="The control process of a cell.")
    parser.add_argument("cell", help="cell file or name of a cell")
    parser.add_argument("--ring", required=True, help="ring of the session in shared memory, made by the supervisor")
    launch.add_overrides(parser)
    args = parser.parse_args(argv)
    try:
        cell = load_cell(args.cell, args.set)
    except ConfigError as error:
        for line in error.lines:
            print(f"error: {line}", file=sys.stderr)
        return NOT_BEGUN
    try:
        with footprint.anew_if_compiled():
            system = ready(cell)
        with (
            open_client(cell.bus_endpoint) as bus,
            RingWriter(args.ring) as ring,
            RingWriter(wire_path(args.ring)) as wire,
        ):
            recorder = RingRecorder(ring, RecordLayout(system.n))
            driver = registry.driver_class(cell.driver["name"])(cell.driver_options, wire_tap(wire))
            return _session(cell, system, driver, bus, recorder)
    except (BusError, RingError) as error:
        _complain(error)
        return NOT_BEGUN
    except KeyboardInterrupt:
        return FAILED


def ready(cell: Cell) -> System:
    """All that needs no robot, done."""
    system = System(cell.params)
    footprint.release()
    warm_up(system)
    return system


def _session(cell: Cell, system: System, driver: RobotDriver, bus: Bus, recorder: RingRecorder) -> int:
    """From opening the robot's link to releasing it; start, end and errors are told on the bus."""
    tell = bus.event_publisher(topics.CONTROL.key).put_json
    people = {sensor.id: bus.latest(topics.human(sensor.name).key) for sensor in cell.params.human.sensors}
    reach = system.bounds.q_min, system.bounds.q_max
    mail = Mail(people, bus.queue(topics.OPERATOR.key), bus.latest(topics.GOAL.key), joints=system.n, reach=reach)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: setattr(mail, "end_requested", True))
    end: dict[str, Any]
    code, end = NOT_BEGUN, {"mode": Mode.IDLE.name, "reason": StopReason.EXCEPTION.name}
    try:
        caps = driver.configure()
        _check(caps, system)
        # the smaller of the profile's and the robot's own limits; every tool that may come, before anything moves
        params, uncovered = covered(cell, within(cell.params, caps.limits))
        for reason in uncovered:
            print(f"not to be moved with: {reason}", file=sys.stderr, flush=True)
        system = System(params)
        _certified(cell, system)
        warm_up(system)
        report = realtime.set_up(cell.realtime.priority, cell.realtime.cpu)
        if isinstance(driver, Weighted):
            # Read-only, as in the core: other arrays would compile the kernels anew, in the middle of the stream.
            driver.dynamics = lambda q, dq, ddq: torque.set_point(system, vector(q), vector(dq), vector(ddq)).tau
            driver.dynamics(system.zero, system.zero, system.zero)  # called once: loaded before there is a stream
        footprint.release()  # locked with all the rest; after the last kernel: loading one brings LLVM back
        driver.activate(cell.params.period_ns)
        decided_with = system.params.canonical().decode()
        tell(
            {
                "event": "start",
                "pid": os.getpid(),
                "robot": caps.identity,
                "realtime": report,
                "params": decided_with,
            }
        )
        code = FAILED
        pacer = pacing.make(caps.pacing, cell.params.period_ns)
        state = run(system, driver, mail, recorder, pacer, time.monotonic_ns)
        end = {"mode": state.mode.name, "reason": state.reason.name}
        if (fault := driver.fault) is not None:
            _complain(fault)
            end |= {"error": str(fault), "hint": fault.hint}
        code = COMPLETED if state.mode is Mode.ENDED else FAILED
    except DriverError as error:
        _complain(error)
        faulted = isinstance(error, RobotFaulted)
        end["reason"] = StopReason.ROBOT_FAULTED.name if faulted else StopReason.EXCEPTION.name
        end |= {"error": str(error), "hint": error.hint}
    except Exception as error:  # the robot is stopped (cycle.run); what is left is to tell
        _complain(error)
        end |= {"error": f"{type(error).__name__}: {error}", "trace": traceback.format_exc()}
    finally:
        driver.close()
    if isinstance(driver, Reporting):
        end["driver"] = driver.report()
    tell({"event": "end", "code": code, "unrecorded": recorder.unrecorded, "refused": list(mail.faults), **end})
    return code


def _check(caps: DriverCaps, system: System) -> None:
    if caps.dof != system.n:
        raise HandshakeError(
            f"the robot ({caps.identity}) has {caps.dof} joints, the cell's robot {system.n}",
            hint="let the cell's `robot` be the one that is connected",
        )
    wanted = LEVELS[system.params.control].kind
    if wanted not in caps.kinds:
        told = " and ".join(sorted(kind.name.lower() for kind in caps.kinds))
        raise HandshakeError(
            f"the cell commands {wanted.name.lower()}, the robot ({caps.identity}) takes {told}",
            hint="set control.level of the cell as the robot can, or use another driver",
        )
    _check_reach(caps, system)
    if caps.tells_tool != system.params.changer.told_by_robot:
        says = "tells the number of its tool" if caps.tells_tool else "tells no tool"
        raise HandshakeError(
            f"the robot {says}, the cell says otherwise",
            hint='let [tools] told_by be "robot" if the driver hears the changer (driver.tool_input), else "operator"',
        )


def _check_reach(caps: DriverCaps, system: System) -> None:
    """A cell that may go farther than the robot lets it would be stopped there by the robot, however fast it is."""
    if caps.reach is None:
        return
    (low, high), least, greatest = caps.reach, system.bounds.q_min, system.bounds.q_max
    inside = (low - REACH_TOLERANCE <= least) & (greatest <= high + REACH_TOLERANCE)
    beyond = [
        f"joint {i + 1}: {_degrees(least[i], greatest[i])} in the cell, {_degrees(low[i], high[i])} in the robot"
        for i in np.flatnonzero(~inside)
    ]
    if beyond:
        raise HandshakeError(
            f"the cell's robot goes farther than the robot ({caps.identity}) lets it: {'; '.join(beyond)}",
            hint="narrow position_deg of the robot's profile.toml, or widen the limits in the drives and in the driver",
        )


def _degrees(low: float, high: float) -> str:
    return f"{math.degrees(low):.4f} to {math.degrees(high):.4f} deg"


def _certified(cell: Cell, system: System) -> None:
    try:
        require(cell, system.params)
    except ConfigError as error:
        hint = "certify with the limits that this robot tells: asc certify --cell CELL --limits-from LOG"
        raise HandshakeError("; ".join(error.lines), hint=hint) from error


def _complain(error: Exception) -> None:
    hint: Any = getattr(error, "hint", "")
    text = str(error) if hint else f"{type(error).__name__}: {error}"
    print(f"error: {text}" + (f" | do: {hint}" if hint else ""), file=sys.stderr, flush=True)


if __name__ == "__main__":
    exit_code = main()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(exit_code)  # some libraries print about themselves when the interpreter is torn down
