"""At which figure each fault is seen, and at which it is not yet: by hand, without a bus."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from asc_rt.core.types import CommandKind
from drivers.can.arm import Feedback, Joint, Power, Target
from drivers.can.link import BusHealth
from drivers.can.reactions import RULES, Fault, Found, Reaction
from drivers.can.stopping import LEAST_S, StopPath
from drivers.can.watch import AxisState, Watch

MS = 1_000_000
PERIOD, STALE, BEAT = 4 * MS, 12 * MS, 50 * MS
JOINT = Joint(q_min=-1.0, q_max=2.0, dq_max=5.0, stop_ddq=8.0, has_brake=False, holds_on_silence=True)
NOW, SEQ = 10_000 * MS, 100
CALM = Feedback(Power.ENABLED, 0.0, 0.0, 0.0, 30.0, False, "enabled")
POSITION, VELOCITY, TORQUE = CommandKind.POSITION, CommandKind.VELOCITY, CommandKind.TORQUE


def watch(heartbeat_ns: int = 0) -> Watch:
    return Watch([JOINT, JOINT], PERIOD, STALE, heartbeat_ns)


def state(feedback: Feedback | None = CALM, age_ms: float = 0.0, seq: int = SEQ, **changes: object) -> AxisState:
    return dataclasses.replace(
        AxisState(feedback, t_rx_ns=NOW - round(age_ms * MS), seq=seq, beat_ns=NOW), **changes  # type: ignore[arg-type]
    )  # fmt: skip


def seen(axis: AxisState, expects_power: bool = True, heartbeat_ns: int = 0) -> list[Fault]:
    return [found.fault for found in watch(heartbeat_ns).axis(1, axis, SEQ, NOW, expects_power)]


@pytest.mark.parametrize(
    ("age_ms", "seq", "faults"),
    [
        (0.0, SEQ, []), (4.0, SEQ - 1, [Fault.MISSED]), (12.0, SEQ - 3, [Fault.MISSED]),
        (12.001, SEQ - 3, [Fault.STALE]), (24.0, SEQ - 6, [Fault.STALE]), (24.001, SEQ - 6, [Fault.LOST]),
    ],
)  # fmt: skip
def test_ages(age_ms: float, seq: int, faults: list[Fault]) -> None:
    assert seen(state(age_ms=age_ms, seq=seq)) == faults
    assert seen(state(None, age_ms, seq)) == faults  # who has never spoken ages from the first question on


def test_heartbeats_count_where_there_are_any_and_power_is_expected() -> None:
    late, just = state(beat_ns=NOW - 3 * BEAT - 1), state(beat_ns=NOW - 3 * BEAT)
    assert seen(late, heartbeat_ns=BEAT) == [Fault.HEARTBEAT] and seen(just, heartbeat_ns=BEAT) == []
    assert seen(late) == [] and seen(late, expects_power=False, heartbeat_ns=BEAT) == []


@pytest.mark.parametrize(
    ("power", "expected", "unasked"),
    [
        (Power.ENABLED, [], []),
        (Power.DISABLED, [Fault.DISABLED], []),
        (Power.NO_VOLTAGE, [Fault.NO_VOLTAGE], [Fault.NO_VOLTAGE]),
        (Power.FAULT, [Fault.AXIS_FAULT], [Fault.AXIS_FAULT]),
    ],
)
def test_power(power: Power, expected: list[Fault], unasked: list[Fault]) -> None:
    axis = state(dataclasses.replace(CALM, power=power))
    assert seen(axis) == expected and seen(axis, expects_power=False) == unasked
    assert seen(dataclasses.replace(axis, emergency="EMCY 7305h")) == [Fault.AXIS_FAULT]


def test_heat_is_told_slowed_down_for_and_stopped_at() -> None:
    axis, faults = state(), {}
    for celsius in (69, 70, 84, 85, 81, 80, 79, 84, 94, 95, 79):
        axis.feedback = dataclasses.replace(CALM, hottest_c=float(celsius))
        faults[celsius] = seen(axis)
        if celsius == 84:
            assert faults[84] == [Fault.WARM]
    assert faults[69] == [] and faults[70] == [Fault.WARM] and faults[85] == [Fault.HEATED]
    assert faults[81] == faults[80] == [Fault.HEATED] and faults[79] == [Fault.WARM]
    assert faults[94] == [Fault.HEATED] and faults[95] == [Fault.HOT, Fault.HEATED]
    warns = dataclasses.replace(CALM, hottest_c=None, warning=True)
    assert seen(state(warns)) == [Fault.HEATED] and seen(state(dataclasses.replace(warns, warning=False))) == []


def moved(before: Feedback | None, after: Feedback, ms: float = 4.0, slips: int = 0) -> list[Fault]:
    first = AxisState(before, dq=before.dq or 0.0 if before else 0.0, t_rx_ns=NOW, slips=slips)
    then = AxisState(after, t_rx_ns=NOW + round(ms * MS), slips=slips)
    return [found.fault for found in watch().moved(0, first, then, ms * 1e-3, SEQ)]


def at(q: float, dq: float | None = 0.0, power: Power = Power.ENABLED) -> Feedback:
    return dataclasses.replace(CALM, q=q, dq=dq, power=power)


def test_what_the_operator_is_told() -> None:
    def axis(told: AxisState, heartbeat_ns: int = 0) -> list[str]:
        return [str(found) for found in watch(heartbeat_ns).axis(1, told, SEQ, NOW, True)]

    assert axis(state(age_ms=8.0, seq=SEQ - 2)) == ["axis 2: missed answer (2 cycles)"]
    assert axis(state(age_ms=16.0)) == ["axis 2: stale feedback (no answer for 16 ms)"]
    assert axis(state(age_ms=30.0)) == ["axis 2: axis lost (no answer for 30 ms)"]
    assert axis(state(beat_ns=NOW - 160 * MS), BEAT) == ["axis 2: heartbeat lost (none for 160 ms)"]
    fault = state(dataclasses.replace(CALM, power=Power.FAULT, words="coil hot"))
    assert axis(fault) == ["axis 2: drive fault (coil hot)"]
    assert axis(dataclasses.replace(fault, emergency="EMCY 4310h")) == ["axis 2: drive fault (EMCY 4310h)"]
    w, then = watch(), AxisState(at(0.06, 0.0), t_rx_ns=NOW + PERIOD, slips=1)
    jump, slip = w.moved(0, AxisState(at(0.01, 0.5), t_rx_ns=NOW), then, 0.004, SEQ)
    assert jump.detail == "+50 mrad between two answers"
    assert slip.detail == "went +50.0 mrad, tells a speed for +1.0"
    for way in (1.0, -1.0):
        (behind,) = w.follows(0, Target(POSITION, way * 0.9, 0.0, 0.0), state(at(way * 0.7)), SEQ, False)
        assert behind.detail == "200 mrad behind"
    w.residual = [0.2, 0.3]
    (slow,) = w.follows(0, Target(VELOCITY, 0.0, 1.0, 0.0), state(), SEQ, False)
    (off,) = w.follows(1, Target(TORQUE, 0.0, 0.0, 0.0), state(surprise=0.1), SEQ, False)
    assert (slow.detail, off.detail) == ("202 mrad behind", "+0.37 rad/s off the commanded motion")
    w.residual = [-0.2, 0.0]
    (slow,) = w.follows(0, Target(VELOCITY, 0.0, -1.0, 0.0), state(), SEQ, False)
    assert slow.detail == "202 mrad behind"


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_jumps(way: float) -> None:
    """20 mrad and half as much again as the speed explains: the faster of the two that were told, or the fastest."""
    for dq, ms, most in ((None, 4.0, 0.05), (None, 8.0, 0.08), (None, 1.0, 0.05), (2.0, 4.0, 0.032), (0.0, 4.0, 0.02)):
        speed = None if dq is None else dq * way
        assert moved(at(0.1, speed), at(0.1 + way * (most - 1e-6), speed), ms) == []
        assert moved(at(0.1, speed), at(0.1 + way * (most + 1e-6), speed), ms) == [Fault.ENCODER]
    assert moved(at(0.1, 2.0 * way), at(0.1 + way * 0.0319, 0.0)) == []
    assert moved(at(0.1, 0.0), at(0.1 + way * 0.0319, 2.0 * way)) == []
    assert moved(None, at(1.9)) == [] and moved(at(0.0, power=Power.DISABLED), at(1.9)) == []


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_slips(way: float) -> None:
    """5 mrad and a quarter of the way off what the two speeds make of the time, twice in a row."""
    for first, second, ms in ((0.0, 0.0, 4.0), (1.0, 2.0, 4.0), (-1.0, -1.0, 8.0)):
        expected = way * 0.5 * (first + second) * ms * 1e-3
        margin = 0.005 + 0.25 * abs(expected)
        for side in (1.0, -1.0):
            near = (
                at(expected + side * (margin - 1e-6), way * second),
                at(expected + side * (margin + 1e-6), way * second),
            )
            assert moved(at(0.0, way * first), near[0], ms, slips=1) == []
            assert moved(at(0.0, way * first), near[1], ms, slips=1) == [Fault.ENCODER]
            assert moved(at(0.0, way * first), near[1], ms, slips=0) == []
    for before, after in ((None, None), (0.0, None), (None, 0.0)):
        assert moved(at(0.0, before), at(0.019, after), slips=1) == []


def test_slips_in_a_row_are_counted_and_one_that_fits_ends_the_row() -> None:
    w, axis = watch(), AxisState(at(0.0), t_rx_ns=NOW)
    counted = []
    for q in (0.006, 0.0061, 0.0122, 0.0183, 0.0184):
        before, axis.feedback = dataclasses.replace(axis), at(q)
        axis.t_rx_ns += PERIOD
        found = list(w.moved(0, before, axis, 0.004, SEQ))
        counted.append((axis.slips, len(found)))
    assert counted == [(1, 0), (0, 0), (1, 0), (2, 1), (0, 0)]


def test_where_no_axis_can_be() -> None:
    for edge, outwards in ((-1.1, -1.0), (2.1, 1.0)):
        assert moved(at(edge, None), at(edge - outwards * 1e-6, None)) == []
        assert moved(at(edge, None), at(edge + outwards * 1e-6, None)) == [Fault.ENCODER]


def follows(kind: CommandKind, asked: Target, axis: AxisState, cycles: int = 1, disturbed: bool = False) -> list[int]:
    """In which cycles it is seen that it does not follow."""
    w = watch()
    target = dataclasses.replace(asked, kind=kind)
    return [k for k in range(cycles) if list(w.follows(1, target, axis, SEQ, disturbed))]


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_following(way: float) -> None:
    asked = Target(POSITION, 0.0, 0.0, 0.0)
    assert follows(POSITION, dataclasses.replace(asked, q=way * 0.1499), state()) == []
    assert follows(POSITION, dataclasses.replace(asked, q=way * 0.1501), state()) == [0]
    assert follows(POSITION, dataclasses.replace(asked, q=way), state(at(way * 0.9))) == []
    assert follows(POSITION, dataclasses.replace(asked, q=way * 0.1501), state(), disturbed=True) == []
    assert follows(POSITION, dataclasses.replace(asked, q=way * 0.1501), state(None)) == []
    # by torque: 0.04 rad/s of surprise a cycle sum up to 0.04 (1 - 0.9^n) / 0.1 > 0.3 after 14 cycles, 0.0299 never
    assert follows(TORQUE, asked, state(surprise=way * 0.04), 40)[0] == 13
    assert follows(TORQUE, asked, state(surprise=way * 0.0299), 400) == []
    assert follows(TORQUE, asked, state(surprise=way * 0.4), disturbed=True) == []
    # by speed: 1 rad/s too little is 4 mrad a cycle, 0.4 (1 - 0.99^n) > 0.15 after 47 cycles; 0.374 rad/s never
    assert follows(VELOCITY, dataclasses.replace(asked, dq=way * 1.5), state(dq=way * 0.5), 60)[0] == 46
    assert follows(VELOCITY, dataclasses.replace(asked, dq=way * 0.374), state(), 2000) == []


def test_a_disturbed_cycle_begins_the_sum_anew() -> None:
    w, target = watch(), Target(TORQUE, 0.0, 0.0, 0.0)
    axis, other = state(surprise=0.04), state(surprise=0.0)
    seen_at = [k for k in range(40) if list(w.follows(1, target, axis, SEQ, disturbed=k == 10))]
    assert seen_at[0] == 24 and not list(w.follows(0, target, other, SEQ, False))


def test_the_bus() -> None:
    def told(**health: object) -> list[Found]:
        return list(watch().bus(BusHealth(**health), SEQ, NOW))  # type: ignore[arg-type]

    assert told() == []
    for field, value, fault in (
        ("gone", "unplugged", Fault.INTERFACE_GONE), ("off", True, Fault.BUS_OFF), ("backlog", True, Fault.BACKLOG),
        ("unacknowledged", True, Fault.NO_ACKNOWLEDGE), ("passive", True, Fault.BUS_PASSIVE),
    ):  # fmt: skip
        (found,) = told(**{field: value})
        assert found.fault is fault and found.axis is None and str(found).startswith(fault)


def test_strangers_are_forgotten_after_a_second() -> None:
    w = watch()
    w.strangers = [NOW - 1_000 * MS] * 50 + [NOW - 999 * MS] * 50
    assert list(w.bus(BusHealth(), SEQ, NOW)) == [] and len(w.strangers) == 50
    w.strangers.append(NOW)
    (found,) = w.bus(BusHealth(), SEQ, NOW)
    assert found.fault is Fault.FLOOD and "51 in a second" in found.detail


# --- what is known between two answers -------------------------------------------------------------------------------


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_differenced_speed_is_the_mean_and_half_of_what_the_torques_added(way: float) -> None:
    """0.4 rad/s in the mean, of which the torques made 0.1 on the way: 0.45 now, to 15 % of the mean either way."""
    for expected, speed in ((0.45, 0.45), (0.5, 0.5), (0.52, 0.51), (0.38, 0.39)):
        axis = AxisState(at(0.1, None), dq=way * (expected - 0.1))
        axis.take_speed(at(0.1 + way * 0.4 * 0.004, None), 0.004, way * 0.1)
        assert axis.dq == pytest.approx(way * speed) and axis.surprise == pytest.approx(way * (speed - expected))
    axis = AxisState()
    axis.take_speed(at(0.1, None), 0.004, 0.1)
    assert (axis.dq, axis.q_smooth) == (0.0, 0.1), "one answer alone has no speed"


def test_a_told_speed_is_kept_within_its_code_and_the_positions_say_where_in_there() -> None:
    step = 0.02
    first = dataclasses.replace(at(0.1, 0.5), dq_step=step)
    axis = AxisState()
    axis.take_speed(first, 0.004, 0.0)
    assert (axis.dq, axis.q_smooth) == (0.5, 0.1)
    axis.feedback = first
    axis.take_speed(dataclasses.replace(first, q=0.1021), 0.004, 0.0)  # 2.0 mrad expected, 0.1 mrad more came
    assert axis.q_smooth == pytest.approx(0.102 + 0.4 * 1e-4)
    assert axis.dq == pytest.approx(0.5 + 0.1 / 0.004 * 1e-4) and axis.surprise == pytest.approx(0.0)
    axis.dq, axis.q_smooth, axis.feedback = 0.6, 0.1, first
    axis.take_speed(dataclasses.replace(first, q=0.1024), 0.004, 0.0)
    assert axis.dq == pytest.approx(0.51) and axis.surprise == pytest.approx(-0.09)
    zero = dataclasses.replace(first, dq=0.0)
    axis.dq, axis.q_smooth, axis.feedback = 0.015, 0.1, zero
    axis.take_speed(dataclasses.replace(zero, q=0.1 + 0.015 * 0.004), 0.004, 0.0)
    assert axis.dq == pytest.approx(0.015), "the codes on both sides of zero are told as 0"
    axis.dq, axis.q_smooth = 0.05, 0.1
    axis.take_speed(dataclasses.replace(zero, q=0.1 + 0.05 * 0.004), 0.004, 0.0)
    assert axis.dq == pytest.approx(0.02), "and no farther"
    axis.dq, axis.q_smooth = 0.5, 0.1
    axis.take_speed(dataclasses.replace(first, q=0.1 + 0.55 * 0.004, dq=0.6), 0.004, 0.1)
    assert axis.dq == pytest.approx(0.6) and axis.q_smooth == pytest.approx(0.1022)


def test_what_the_torques_add_until_now() -> None:
    axis = AxisState(CALM, dq=0.5)
    axis.command(0.04)
    axis.command(0.02)
    assert axis.gained == pytest.approx(0.06)
    assert axis.speed(1.0) == pytest.approx(0.56) and axis.speed(2.5) == pytest.approx(0.59)
    # two cycles missed and the running one for a period and a half: 14 ms at the mean of 0.5 and 0.57 rad/s
    assert axis.carried(2, 1.5, 0.004) == round(0.5 * (0.5 + 0.57) * 3.5 * 0.004 * 1e6)


# --- the table and the stop ------------------------------------------------------------------------------------------


def test_every_fault_has_a_rule_that_tells_what_to_do() -> None:
    assert RULES.keys() == set(Fault) and all(rule.do for rule in RULES.values())
    reactions = {kind: {fault for fault, rule in RULES.items() if rule.reaction is kind} for kind in Reaction}
    assert reactions[Reaction.CUT] == {Fault.NO_ACKNOWLEDGE, Fault.BUS_OFF, Fault.INTERFACE_GONE}
    assert reactions[Reaction.SLOW] == {Fault.HEATED}
    assert reactions[Reaction.WARN] == {Fault.MISSED, Fault.SILENT, Fault.WARM, Fault.STRANGERS, Fault.LATE}
    fallen = {
        Fault.LOST,
        Fault.AXIS_FAULT,
        Fault.DISABLED,
        Fault.NO_VOLTAGE,
        Fault.ENCODER,
        Fault.FOLLOWING,
        Fault.BRAKE,
    }
    assert {fault for fault, rule in RULES.items() if rule.is_axis} == fallen
    order = [Reaction.WARN, Reaction.SLOW, Reaction.STOP, Reaction.CUT]
    assert sorted(Reaction, key=lambda kind: kind.value) == order, "the worst is blamed"


def test_the_stop_is_straight_and_as_long_as_the_joint_that_needs_longest() -> None:
    q, dq, ddq = np.array([0.1, -0.2, 0.3]), np.array([0.8, -1.6, 0.0]), np.array([8.0, 8.0, 2.0])
    path = StopPath.plan(q, dq, ddq)
    assert path.duration == pytest.approx(0.2)
    for t, share, left in ((0.0, 0.0, 1.0), (0.05, 0.4375, 0.75), (0.1, 0.75, 0.5), (0.2, 1.0, 0.0), (9.0, 1.0, 0.0)):
        at_t, speed, brake = path.at(t)
        np.testing.assert_allclose(at_t, q + share * dq * 0.1)
        np.testing.assert_allclose(speed, left * dq)
        np.testing.assert_allclose(brake, -dq / 0.2 * (t < 0.2))
    assert StopPath.plan(q, 0.0 * dq, ddq).duration == LEAST_S == 0.02
