"""The stream of a session: send all, then collect until the deadline, and see what is wrong. One thread, no policy.

Whatever happens the next cycle is sent: silence would let the watchdog of every drive act.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from asc_rt.core.types import CommandKind, Vector, vector
from drivers.base import ProtocolError, WireTap
from drivers.can.arm import ArmCodec, Brake, Emergency, Feedback, Heartbeat, Power, Target, Wish
from drivers.can.frame import Frame, bundle
from drivers.can.link import Link
from drivers.can.reactions import Fault, Found, Reaction
from drivers.can.watch import URAD, AxisState, Watch

SILENT = 2  # cycles without an answer of any axis: the bus is gone
LATE = 0.5  # periods that our own sending may be late without being told


@dataclass(slots=True)
class Counters:
    cycles: int = 0
    missed: int = 0  # answers that did not come in their cycle
    missed_by_us: int = 0  # of these: in cycles that we sent late, or that the interface did not take
    late: int = 0  # cycles that we sent late
    late_answers: int = 0  # that came in a later cycle than theirs
    unknown: int = 0  # frames of nobody, or without meaning
    worst_c: float = 0.0
    found: dict[str, int] = field(default_factory=dict)


class Stream:
    """`expects_power[i]` says which axes have to be enabled; `found` is what stops the arm, in the order of seeing."""

    def __init__(self, link: Link, codec: ArmCodec, period_ns: int, stale_ns: int, tap: WireTap | None) -> None:
        n = len(codec.joints)
        self.codec, self.link, self.period_ns = codec, link, period_ns
        self.axes = [AxisState() for _ in range(n)]
        self.expects_power = [False] * n
        self.counters = Counters()
        self.found: list[Found] = []
        self.asks_to_slow = False  # since the newest cycle was judged
        self.seq = 0
        self.t_rx_ns = 0  # key of the newest sample in the record
        self.targets: Sequence[Target] = ()
        self._watch = Watch(codec.joints, period_ns, stale_ns, codec.heartbeat_ns)
        self._stale_ns = stale_ns
        self._tap, self._tapped_ns = tap, 0
        self._newest: list[Frame | None] = [None] * n
        self._sent_ns = self._due_ns = 0
        self._running = 1.0  # periods that the newest command acts until the next one: more where we are late
        self._was_late = self._disturbed = False  # this cycle was sent late; the one before was irregular

    # --- send --------------------------------------------------------------------------------------------------------

    def send(self, targets: Sequence[Target]) -> tuple[int, list[Frame], bool]:
        """(when, what, whether the interface took it). ValueError: a target that no frame can tell; nothing is sent."""
        frames = self.codec.encode(self.seq + 1, targets, [axis.feedback for axis in self.axes])
        self.seq += 1
        now_ns = self._unique(self.link.now_ns())
        if self.seq == 1:  # nothing was asked before: ages begin here
            for axis in self.axes:
                axis.t_rx_ns = now_ns
        self._note_lateness(now_ns)
        if self._tap is not None:
            self._tap("tx", now_ns, bundle(self.seq, frames))
        taken = self.link.send(frames)
        self._expect(targets)
        self.targets, self._sent_ns, self._running = targets, now_ns, 1.0
        self._was_late |= taken < len(frames)
        self.counters.cycles += 1
        return now_ns, frames, taken == len(frames)

    def _expect(self, targets: Sequence[Target]) -> None:
        """A torque comes with the speed that it makes of the present one until the next cycle."""
        for axis, target in zip(self.axes, targets, strict=True):
            axis.command(target.dq - axis.speed(self._running) if target.kind is CommandKind.TORQUE else 0.0)

    def _note_lateness(self, now_ns: int) -> None:
        behind_ns = now_ns - self._due_ns if self._due_ns else 0
        self._due_ns = now_ns + self.period_ns
        self._was_late = behind_ns > LATE * self.period_ns
        if self._was_late:
            self.counters.late += 1
            fault = Fault.OVERRUN if behind_ns > self._stale_ns else Fault.LATE
            self._note(Found(fault, None, self.seq, f"sent {behind_ns * 1e-6:.1f} ms late"))

    def pause(self) -> None:
        """The next cycle may come when it wants: nothing is enabled yet."""
        self._due_ns = 0

    # --- collect -----------------------------------------------------------------------------------------------------

    def collect(self, deadline_ns: int, until_ns: int | None = None) -> None:
        """Take in answers until every axis has answered this cycle, at most until the deadline; then judge.

        With `until_ns` also what comes later, until then: a cycle of ours that has nothing else to do.
        """
        latest_ns = self._sent_ns + self.period_ns * 5 // 4  # what has not come by then is missing
        deadline_ns = min(max(deadline_ns, self._sent_ns + self.period_ns * 3 // 4), latest_ns)
        while not self._complete() and (frame := self.link.receive(deadline_ns)) is not None:
            self._hear(frame)
        while (frame := self.link.receive(until_ns or self.link.now_ns())) is not None:
            self._hear(frame)
        self._running = max(1.0, (self.link.now_ns() - self._sent_ns) / self.period_ns)
        self._judge()
        frames = [frame for frame in self._newest if frame is not None]
        if self._tap is not None and len(frames) == len(self.axes):
            self.t_rx_ns = self._unique(self.t_rx_ns)
            self._tap("rx", self.t_rx_ns, bundle(self.seq, frames, self.missed, self._carried()))

    def _complete(self) -> bool:
        return all(axis.seq == self.seq for axis in self.axes)

    def _hear(self, frame: Frame) -> None:
        now_ns = self.link.now_ns()
        try:
            heard = self.codec.decode(frame)
        except ProtocolError:
            heard = None
        if heard is None:
            self._strange(frame, now_ns)
            return
        i, what = heard
        match what:
            case Feedback():
                self._take(i, what, frame, now_ns)
            case Heartbeat():
                self.axes[i].beat_ns = now_ns
            case Brake():
                self.axes[i].brake_closed = self.axes[i].brake_closed if what.closed is None else what.closed
            case Emergency():
                self.axes[i].emergency = what.words or self.axes[i].emergency
                self._tap_alone(frame, now_ns)

    def _take(self, i: int, told: Feedback, frame: Frame, now_ns: int) -> None:
        axis, before = self.axes[i], replace(self.axes[i])
        if axis.seq == self.seq:  # two in one cycle: the first was to an earlier one
            self.counters.late_answers += 1
            axis.lost = max(0, axis.lost - 1)
        elapsed = self._elapsed(axis, frame, now_ns)
        whole = max(self.seq - axis.seq, 1) * self.period_ns * 1e-9  # a torque acts until the next one comes
        axis.take_speed(told, elapsed, (axis.gained - axis.gain) * elapsed / whole)
        axis.gained = axis.gain
        axis.feedback, axis.seq, axis.t_rx_ns = told, self.seq, now_ns
        axis.t_told_ns, axis.stamp = self._sent_ns, frame.stamp
        self._newest[i], self.t_rx_ns = frame, now_ns
        if told.hottest_c is not None:
            self.counters.worst_c = max(self.counters.worst_c, told.hottest_c)
        for found in self._watch.moved(i, before, axis, elapsed, self.seq):
            self._note(found)

    def _elapsed(self, axis: AxisState, frame: Frame, now_ns: int) -> float:
        """s between two answers, by the interface's stamps; by our sending where its clock was set meanwhile.

        Each answer was on the wire less than the stale time before we took it in, or it stops the arm. So what lies
        between two of them differs by less than that from what lies between their being taken in, also where several
        cycles' answers come late and at once.
        """
        period = self.period_ns * 1e-9
        stamped, received = frame.stamp - axis.stamp, (now_ns - axis.t_rx_ns) * 1e-9
        if stamped > 0.25 * period and abs(stamped - received) < self._stale_ns * 1e-9:
            return stamped
        return max((self._sent_ns - axis.t_told_ns) * 1e-9, 0.25 * period)

    def _strange(self, frame: Frame, now_ns: int) -> None:
        self.counters.unknown += 1
        self._watch.strangers.append(now_ns)
        self._note(Found(Fault.STRANGERS, None, self.seq, f"identifier {frame.id:03X}h"))
        self._tap_alone(frame, now_ns)

    def _judge(self) -> None:
        now_ns, self.asks_to_slow = self.link.now_ns(), False
        if (silent := min(self.missed)) >= SILENT:
            self._note(Found(Fault.SILENT, None, self.seq, f"{silent} cycles"))
        for found in self._watch.bus(self.link.health, self.seq, now_ns):
            self._note(found)
        for i, axis in enumerate(self.axes):
            if axis.seq < self.seq:
                self.counters.missed += 1
                self.counters.missed_by_us += self._was_late
                axis.lost += 1
            for found in self._watch.axis(i, axis, self.seq, now_ns, self.expects_power[i]):
                self._note(found)
            if self.expects_power[i]:
                disturbed = self._disturbed or self._was_late or self.seq > axis.seq
                for found in self._watch.follows(i, self.targets[i], axis, self.seq, disturbed):
                    self._note(found)
        self._disturbed = self._was_late or any(self.missed)

    def _note(self, found: Found) -> None:
        self.counters.found[found.fault] = self.counters.found.get(found.fault, 0) + 1
        self.asks_to_slow |= found.rule.reaction is Reaction.SLOW
        if found.rule.reaction in (Reaction.WARN, Reaction.SLOW):
            return
        if all((found.fault, found.axis) != (known.fault, known.axis) for known in self.found):
            self.found.append(found)
        if found.axis is not None and found.rule.is_axis:
            self.axes[found.axis].faults.add(found.fault)

    # --- what is known -----------------------------------------------------------------------------------------------

    @property
    def missed(self) -> list[int]:
        return [self.seq - axis.seq for axis in self.axes]

    @property
    def has_spoken(self) -> bool:
        """Every axis, at least once: before that there is no pose."""
        return all(axis.feedback is not None for axis in self.axes)

    @property
    def is_cut(self) -> bool:
        """Nothing can be said any more."""
        return any(found.rule.reaction is Reaction.CUT for found in self.found)

    def pose(self) -> tuple[Vector, Vector, Vector]:
        """q, dq, tau of every axis now: each goes on as it told last, and as it was driven since."""
        told = [axis.feedback for axis in self.axes]
        q = [f.q + URAD * on if f else np.nan for f, on in zip(told, self._carried(), strict=True)]
        dq = [axis.speed(self._running) for axis in self.axes]
        return vector(q), vector(dq), vector([f.tau if f else np.nan for f in told])

    def _carried(self) -> list[int]:
        period = self.period_ns * 1e-9
        return [
            axis.carried(missed, self._running, period) for axis, missed in zip(self.axes, self.missed, strict=True)
        ]

    def powers(self) -> list[Power | None]:
        return [axis.feedback.power if axis.feedback else None for axis in self.axes]

    def _unique(self, t_ns: int) -> int:
        """Packets of the record are known by their time."""
        self._tapped_ns = max(self._tapped_ns + 1, t_ns)
        return self._tapped_ns

    def _tap_alone(self, frame: Frame, now_ns: int) -> None:
        if self._tap is not None:
            self._tap("rx", self._unique(now_ns), bundle(0, [frame]))


def hold(q: Iterable[float], tau: Iterable[float], wish: Wish = Wish.KEEP) -> list[Target]:
    """Stand still at q with tau as feed-forward."""
    return [Target(CommandKind.POSITION, a, 0.0, t, wish) for a, t in zip(q, tau, strict=True)]


def move(q: Iterable[float], dq: Iterable[float], tau: Iterable[float]) -> list[Target]:
    """Go through q at dq, with tau as feed-forward."""
    return [Target(CommandKind.POSITION, a, b, t) for a, b, t in zip(q, dq, tau, strict=True)]


def look(n: int) -> list[Target]:
    """Ask every axis how it is, and nothing else of it."""
    return [Target(CommandKind.TORQUE, 0.0, 0.0, 0.0, Wish.LOOK)] * n
