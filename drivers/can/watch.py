"""Sees the faults: from what the axes told, what they were asked for, and how the bus is. No I/O, no reaction.

Thresholds are ASSUMED unless they follow from the protocol.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from asc_rt.core.types import CommandKind
from drivers.can.arm import Feedback, Joint, Power, Target
from drivers.can.home import MARGIN
from drivers.can.link import BusHealth
from drivers.can.reactions import Fault, Found

URAD = 1e-6
LOST = 2  # stale times: an axis that has said nothing for so long is dead
JUMP = 0.02  # rad: more than this between two answers is no motion, beyond what the speed explains
# rad that position and told speed may disagree by between two answers, and a share of the way: jitter of the stamps. In
# 30 s beside a person the simulated arm came to 0.0004 beyond the share.
SLIP, SLIP_SHARE, SLIPS = 0.005, 0.25, 2
WARM_C, HEATED_C, HOT_C = 70.0, 85.0, 95.0  # told, slowed down, stopped: before the drive's own trip at 100 to 120 C
COOLED_C = 5.0  # so much cooler than HEATED_C it must be to go at full speed again
# rad that a position command may be ahead, or the way of a velocity command, of which LAG_FORGET a cycle counts no more
FOLLOWING_POSITION = 0.15
LAG_FORGET = 0.99
# rad/s of summed disagreement between expected and seen speed, forgotten by FORGET a cycle. In 30 s beside a person the
# simulated arms came to 0.02 (differenced) and 0.10 (told in steps). An axis that is held while it is asked for more
# than 12 rad/s2 comes to it in ten cycles of 4 ms; for less than 7.5, never.
FOLLOWING_SPEED = 0.3
FORGET = 0.9
STRANGERS_PER_SECOND = 50
ALPHA, BETA = 0.4, 0.1  # ASSUMED: about 10 ms at 4 ms a cycle
JITTER = (
    0.15  # ASSUMED share of a cycle by which the time between two answers is uncertain, where a speed is differenced
)
BEATS = 3  # heartbeats that may be missing


@dataclass(slots=True)
class AxisState:
    """What is known of one axis, with its age: nothing is assumed before it has spoken."""

    feedback: Feedback | None = None
    dq: float = 0.0  # rad/s at the newest answer: differenced, or as told and refined by the positions
    gain: float = 0.0  # rad/s that the torque of the running cycle adds
    gained: float = 0.0  # rad/s that all torques since the newest answer add until the next cycle begins
    surprise: float = 0.0  # rad/s by which the newest answer is off what the torques should have made of the one before
    q_smooth: float = 0.0  # rad, of that estimate
    t_rx_ns: int = 0  # of the newest answer; before the first, of the first question
    t_told_ns: int = 0  # when we sent what it answers
    stamp: float = 0.0  # s, of the interface's own clock
    seq: int = 0  # of our cycle that it answers
    beat_ns: int = 0  # of the newest heartbeat; 0: none yet
    emergency: str = ""
    brake_closed: bool | None = None  # as its contact told since it was asked
    is_heated: bool = False  # it asks for rest
    slips: int = 0  # answers in a row whose position and speed disagree
    lost: int = 0  # answers that never came, in all
    faults: set[Fault] = field(default_factory=set)

    def take_speed(self, told: Feedback, elapsed: float, gained: float) -> None:
        """The speed that goes with a new answer, `elapsed` s after the one before, in which the torques should have
        added `gained` rad/s.

        A coarse code says within half a step how fast; where in there, the torques and the positions say (alpha-beta
        filter): an arm that creeps inside one step of the code would never be seen to. A difference of positions is the
        mean speed between them, older by half the time, and as uncertain as the moments of the answers.
        """
        expected = self.dq + gained
        if self.feedback is None:
            self.dq, self.q_smooth = told.dq or 0.0, told.q
        elif told.dq is None:
            mean = (told.q - self.feedback.q) / elapsed
            now, half = mean + 0.5 * gained, JITTER * abs(mean)
            self.dq = min(max(expected, now - half), now + half)
            self.surprise = self.dq - expected
        else:
            ahead = self.q_smooth + (self.dq + 0.5 * gained) * elapsed
            off = told.q - ahead
            half = told.dq_step * (0.5 if told.dq else 1.0)  # the codes on both sides of zero are told as 0
            self.q_smooth = ahead + ALPHA * off
            self.dq = min(max(expected + BETA / elapsed * off, told.dq - half), told.dq + half)
            self.surprise = min(max(expected, told.dq - half), told.dq + half) - expected

    def command(self, gain: float) -> None:
        """A cycle begins whose torque adds `gain` rad/s."""
        self.gain = gain
        self.gained += gain

    def speed(self, running: float) -> float:
        """rad/s, once the torque of the running cycle has acted for so many periods."""
        return self.dq + self.gained + (running - 1.0) * self.gain

    def carried(self, missed: int, running: float, period: float) -> int:
        """urad that it has gone on since it told: it was asked `missed` cycles and the running one ago. In whole
        numbers for the record, so that its packets decode to the same position."""
        return round(0.5 * (self.dq + self.speed(running)) * (missed + running) * period / URAD)


@dataclass(slots=True)
class Watch:
    """One look a cycle; what was found stays found."""

    joints: Sequence[Joint]
    period_ns: int
    stale_ns: int
    heartbeat_ns: int
    residual: list[float] = field(default_factory=list)
    strangers: list[int] = field(default_factory=list)  # when frames of nobody came, within the last second

    def __post_init__(self) -> None:
        self.residual = [0.0] * len(self.joints)

    def bus(self, health: BusHealth, seq: int, now_ns: int) -> Iterator[Found]:
        for fault, detail in (
            (Fault.INTERFACE_GONE, health.gone),
            (Fault.BUS_OFF, "told by the controller" if health.off else ""),
            (Fault.NO_ACKNOWLEDGE, "told by the controller" if health.unacknowledged else ""),
            (Fault.BUS_PASSIVE, "told by the controller" if health.passive else ""),
            (Fault.BACKLOG, "more than the transmit queue holds" if health.backlog else ""),
        ):
            if detail:
                yield Found(fault, None, seq, detail)
        self.strangers = [t for t in self.strangers if now_ns - t < 1_000_000_000]
        if len(self.strangers) > STRANGERS_PER_SECOND:
            yield Found(Fault.FLOOD, None, seq, f"{len(self.strangers)} in a second")

    def axis(self, i: int, state: AxisState, seq: int, now_ns: int, expects_power: bool) -> Iterator[Found]:
        """Silence, power state, temperature and heartbeat of one axis."""
        age_ns = now_ns - state.t_rx_ns
        if age_ns > LOST * self.stale_ns:
            yield Found(Fault.LOST, i, seq, f"no answer for {age_ns * 1e-6:.0f} ms")
        elif age_ns > self.stale_ns:
            yield Found(Fault.STALE, i, seq, f"no answer for {age_ns * 1e-6:.0f} ms")
        elif state.seq < seq:
            yield Found(Fault.MISSED, i, seq, f"{seq - state.seq} cycles")
        if expects_power and self.heartbeat_ns and now_ns - state.beat_ns > BEATS * self.heartbeat_ns:
            yield Found(Fault.HEARTBEAT, i, seq, f"none for {(now_ns - state.beat_ns) * 1e-6:.0f} ms")
        told = state.feedback
        if told is None:
            return
        if told.power is Power.FAULT or state.emergency:
            yield Found(Fault.AXIS_FAULT, i, seq, state.emergency or told.words)
        elif told.power is Power.NO_VOLTAGE:
            yield Found(Fault.NO_VOLTAGE, i, seq, told.words)
        elif expects_power and told.power is Power.DISABLED:
            yield Found(Fault.DISABLED, i, seq, told.words)
        yield from self._temperature(i, state, told, seq)

    def _temperature(self, i: int, state: AxisState, told: Feedback, seq: int) -> Iterator[Found]:
        """By its figure, or by the warning of a drive that tells none in the cycle: which comes before its trip."""
        if told.hottest_c is None:
            if told.warning:
                yield Found(Fault.HEATED, i, seq, "the drive warns")
            return
        state.is_heated = told.hottest_c >= HEATED_C - (COOLED_C if state.is_heated else 0.0)
        detail = f"{told.hottest_c:.0f} C"
        if told.hottest_c >= HOT_C:
            yield Found(Fault.HOT, i, seq, detail)
        if state.is_heated:
            yield Found(Fault.HEATED, i, seq, detail)
        elif told.hottest_c >= WARM_C:
            yield Found(Fault.WARM, i, seq, detail)

    def moved(self, i: int, before: AxisState, after: AxisState, apart: float, seq: int) -> Iterator[Found]:
        """Two answers of one axis, `apart` s: is what lies between them a motion, and can the axis be there?"""
        if before.feedback is None or after.feedback is None or before.feedback.power is not Power.ENABLED:
            return
        joint, q = self.joints[i], after.feedback.q
        if not joint.q_min - MARGIN <= q <= joint.q_max + MARGIN:
            yield Found(Fault.ENCODER, i, seq, f"{q:.2f} rad is outside its range")
        elapsed = max(after.t_rx_ns - before.t_rx_ns, self.period_ns) * 1e-9
        step = after.feedback.q - before.feedback.q
        told = after.feedback.dq
        fastest = self.joints[i].dq_max if told is None else max(abs(before.dq), abs(told))
        if abs(step) > JUMP + 1.5 * fastest * elapsed:
            yield Found(Fault.ENCODER, i, seq, f"{step * 1e3:+.0f} mrad between two answers")
        if told is not None and before.feedback.dq is not None:
            way = 0.5 * (before.feedback.dq + told) * apart
            after.slips = after.slips + 1 if abs(step - way) > SLIP + SLIP_SHARE * abs(way) else 0
            if after.slips >= SLIPS:
                yield Found(Fault.ENCODER, i, seq, f"went {step * 1e3:+.1f} mrad, tells a speed for {way * 1e3:+.1f}")

    def follows(self, i: int, target: Target, state: AxisState, seq: int, disturbed: bool) -> Iterator[Found]:
        """Does the axis do what it was asked for a cycle ago? An irregular cycle says nothing about it."""
        told = state.feedback
        if told is None or disturbed:
            self.residual[i] = 0.0
            return
        if target.kind is CommandKind.POSITION and abs(target.q - told.q) > FOLLOWING_POSITION:
            yield Found(Fault.FOLLOWING, i, seq, f"{abs(target.q - told.q) * 1e3:.0f} mrad behind")
        if target.kind is CommandKind.VELOCITY:
            ahead = (target.dq - state.dq) * self.period_ns * 1e-9
            self.residual[i] = LAG_FORGET * self.residual[i] + ahead
            if abs(self.residual[i]) > FOLLOWING_POSITION:
                yield Found(Fault.FOLLOWING, i, seq, f"{abs(self.residual[i]) * 1e3:.0f} mrad behind")
        if target.kind is CommandKind.TORQUE:
            self.residual[i] = FORGET * self.residual[i] + state.surprise
            if abs(self.residual[i]) > FOLLOWING_SPEED:
                yield Found(Fault.FOLLOWING, i, seq, f"{self.residual[i]:+.2f} rad/s off the commanded motion")
