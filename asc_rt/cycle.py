"""The loop. Everything that a cycle does is in `run`; everything that it decides is in `step`."""

from __future__ import annotations

from typing import Protocol

from asc_rt.core.step import step
from asc_rt.core.system import System, initial
from asc_rt.core.types import CoreState, CycleInputs, CycleOutputs
from asc_rt.inputs import Mail, freeze
from asc_rt.pacing import Clock, Pacer
from asc_rt.record import Timings
from drivers.base import RobotDriver, WriteReceipt


class Recorder(Protocol):
    def put(
        self, before: CoreState, x: CycleInputs, out: CycleOutputs, sent: WriteReceipt | None, timings: Timings
    ) -> None:
        """Keep one cycle. Never blocks, never raises; counts what it drops."""


def run(system: System, driver: RobotDriver, mail: Mail, ring: Recorder, pacer: Pacer, clock: Clock) -> CoreState:
    """Read, freeze, decide, write, record, wait; the state that ended the session.

    Every way out, an exception too, ends in driver.stop(): at rest it takes leave of the robot, in motion it falls
    silent and the robot brakes by its own rule.
    """
    period_ns, state = system.params.period_ns, initial(system)
    try:
        while not state.mode.is_over:
            joint = driver.read(pacer.deadline_ns())  # the robot's next sample, or None: silence
            woke_ns = clock()
            x = freeze(state.tick, period_ns, joint, mail, clock, pacer)  # the only reads of clock and mailboxes
            before = state
            state, out = step(system, before, x)  # pure; the whole decision
            decided_ns = clock()
            sent = driver.write(out.command) if out.command else None
            ring.put(before, x, out, sent, Timings(woke_ns, x.t_ns, decided_ns, clock()))
            if out.stop:
                driver.stop(out.stop)  # the last cycle; recorded first, because taking leave may last a second
            pacer.wait()  # nothing to do when the robot paces us
        return state
    finally:
        driver.stop()  # idempotent, cannot raise
