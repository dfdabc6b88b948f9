"""Out of motion and out of the session: coordinated stop, hold, brakes. The stream never pauses on the way.

An axis that has fallen out is told to stay where it is measured, so that a later reset cannot jump. An arm without
brakes is left with its power on: its drives hold by themselves once nobody talks to them (`Joint.holds_on_silence`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from asc_rt.core.types import Vector
from drivers.base import Dynamics
from drivers.can.arm import Power, Target, Wish
from drivers.can.reactions import Fault, Found
from drivers.can.stopping import StopPath
from drivers.can.stream import Stream, hold, move

SETTLE_S = 0.25  # after the path's end
REST_SPEED = 0.05  # rad/s
LONGEST_REST_S = 2.0
DEAF = 3  # cycles: who has not answered for so long is not asked any more
BRAKE_S = 0.3  # 0.2 for a brake to move, the rest for its contact to be asked in turn
SHUTDOWN_S = 1.0  # for brakes to close and power to go off
SAG = 0.02  # rad that a braked axis may give way without power, in the time that it is looked at
SAG_S = 0.1


def come_to_rest(stream: Stream, dynamics: Dynamics) -> None:
    """Every axis that listens stops on the common path; returns once they stand still."""
    q, dq, _ = stream.pose()
    held = {i: float(q[i]) for i, axis in enumerate(stream.axes) if axis.faults}
    able = np.array([0.0 if i in held else 1.0 for i in range(len(q))])
    path = stop_path(stream, q, dq * able)
    begin_ns = stream.link.now_ns()
    end_s = path.duration + SETTLE_S
    for _ in range(round((end_s + LONGEST_REST_S) * 1e9 / stream.period_ns)):
        t = (stream.link.now_ns() - begin_ns) * 1e-9
        wanted, speed, ddq = path.at(t)
        targets = move(wanted, speed, dynamics(wanted, speed, ddq))
        if not cycle(stream, [_fallen(stream, i, target, held) for i, target in enumerate(targets)]):
            return
        if t > end_s and _stands(stream):
            return


def stop_path(stream: Stream, q: Vector, dq: Vector) -> StopPath:
    return StopPath.plan(q, dq, np.array([joint.stop_ddq for joint in stream.codec.joints]))


def _fallen(stream: Stream, i: int, target: Target, held: dict[int, float]) -> Target:
    """An axis with a fault: where it was when it was seen while it has power, where it is once it has none."""
    axis = stream.axes[i]
    if not axis.faults or axis.feedback is None:
        return target
    if axis.feedback.power is not Power.ENABLED:
        return replace(target, q=axis.feedback.q, dq=0.0)
    return replace(target, q=held.setdefault(i, axis.feedback.q), dq=0.0)


def _stands(stream: Stream) -> bool:
    return all(abs(axis.dq) < REST_SPEED for axis in stream.axes if not axis.faults)


def leave(stream: Stream, dynamics: Dynamics) -> None:
    """Brakes first, then power, and only where a brake tells that it is closed; then say so on the bus."""
    q = np.array([target.q for target in stream.targets])
    targets = hold(q, _weight(dynamics, q))
    braked = _close_brakes(stream, targets)
    stream.expects_power = [on and not brake for on, brake in zip(stream.expects_power, braked, strict=True)]
    looks = round(SAG_S * 1e9 / stream.period_ns) if any(braked) else 0
    for _ in range(round(SHUTDOWN_S * 1e9 / stream.period_ns)):
        looks -= not any(_has_power(stream, i) for i, brake in enumerate(braked) if brake)
        if looks < 0:
            break
        if not cycle(stream, _wishing(targets, braked, Wish.DISABLE)):
            return
    down = stream.pose()[0] - q  # of who speaks: where a silent one is nobody knows
    sagged = [i for i, brake in enumerate(braked) if brake and _speaks(stream, i) and abs(down[i]) > SAG]
    stream.found += [Found(Fault.BRAKE, i, stream.seq, "gives way without power") for i in sagged]
    stream.link.send(stream.codec.leave())
    heard_ns = stream.link.now_ns() + stream.period_ns
    while stream.link.receive(heard_ns) is not None:  # so that it is on the wire before the link is closed
        pass


def _close_brakes(stream: Stream, targets: list[Target]) -> list[bool]:
    """Which axes their brakes hold. One whose brake does not say so within BRAKE_S keeps its power, and holds by it."""
    braked = [joint.has_brake for joint in stream.codec.joints]
    if not stream.codec.tells_brakes:
        return braked
    asked = [brake and _speaks(stream, i) for i, brake in enumerate(braked)]
    for axis in stream.axes:
        axis.brake_closed = None
    for _ in range(round(BRAKE_S * 1e9 / stream.period_ns)):
        if not _open(stream, asked):
            break
        if not cycle(stream, _wishing(targets, asked, Wish.BRAKE)):
            return braked
    still = _open(stream, asked)
    stream.found += [Found(Fault.BRAKE, i, stream.seq, "does not tell that it has closed") for i in still]
    return [brake and i not in still for i, brake in enumerate(braked)]


def _open(stream: Stream, asked: list[bool]) -> list[int]:
    """Axes that have power, and whose brake has not said that it is closed."""
    return [i for i, a in enumerate(asked) if a and _has_power(stream, i) and not stream.axes[i].brake_closed]


def _wishing(targets: list[Target], which: list[bool], wish: Wish) -> list[Target]:
    return [replace(target, wish=wish) if these else target for target, these in zip(targets, which, strict=True)]


def _speaks(stream: Stream, i: int) -> bool:
    return stream.missed[i] < DEAF


def _has_power(stream: Stream, i: int) -> bool:
    told = stream.axes[i].feedback
    return told is not None and told.power is Power.ENABLED


def _weight(dynamics: Dynamics, q: Vector) -> Vector:
    zero = np.zeros_like(q)
    return dynamics(q, zero, zero)


def cycle(stream: Stream, targets: list[Target]) -> bool:
    """One whole period; False: nobody can be told anything any more."""
    due_ns = stream.link.now_ns() + stream.period_ns
    stream.send(targets)
    stream.collect(due_ns, due_ns)
    return not stream.is_cut
