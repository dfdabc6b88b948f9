"""Every row of the fault table, at rest and at speed, on both kinds of drives.

Asked of each: how many cycles until it is seen, what the axes do in the end, and how far the healthy ones leave the
straight way of the coordinated stop. Gravity pulls on every joint. The same through the simulated bus alone, through
python-can's `virtual`, and through SocketCAN where the kernel has a vcan0.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from can_rig import Rig, position, torque
from can_through import has_vcan

from asc_rt.core.types import CommandKind, JointCommand, JointState, RobotFlag, Vector, vector
from drivers.base import RobotFaulted
from drivers.can import arms, leave
from drivers.can.arm import Power
from drivers.can.frame import Frame
from drivers.can.reactions import RULES, Fault, Reaction
from drivers.can.watch import AxisState

ARMS = ("openarm", "panda")
INTERFACES = ("asc-sim", "virtual", "socketcan")
SPEED = 0.8  # rad/s of every joint
SICK = 2  # the axis that has the fault, counted from 0
STRAIGHT = 0.04  # rad that a healthy axis may leave its way
AT_REST = 0.02  # rad/s


@dataclass
class Row:
    fault: Fault
    strike: Callable[[Rig], None]
    cycles: int  # at most until it is seen
    arms: tuple[str, ...] = ARMS
    only_moving: bool = False  # an arm that stands still does not show it
    sick: tuple[int, ...] = (SICK,)  # axes that nobody can command any more, or whose pose is a lie


def once(name: str, value: float = 1.0, axis: int = SICK + 1) -> Callable[[Rig], None]:
    return lambda rig: rig.strike(name, axis, value)


ROWS = {
    "stale": Row(Fault.STALE, once("silence"), 4),
    "lost": Row(Fault.LOST, once("power_cut"), 8),
    "passive": Row(Fault.BUS_PASSIVE, once("corrupt", 17), 2, sick=()),
    "bus off": Row(Fault.BUS_OFF, once("corrupt", 40), 2, sick=()),
    "unplugged": Row(Fault.NO_ACKNOWLEDGE, once("unplug"), 2, sick=()),
    "gone": Row(Fault.INTERFACE_GONE, lambda rig: setattr(rig.line, "gone", True), 2, sick=()),
    "backlog": Row(Fault.BACKLOG, lambda rig: setattr(rig.line, "full", 3), 2, sick=()),
    "drive fault": Row(Fault.AXIS_FAULT, once("trip"), 2),
    "emergency": Row(Fault.AXIS_FAULT, once("emergency", 0x7305), 2, arms=("panda",)),
    "stops by itself": Row(Fault.AXIS_FAULT, once("stops"), 2, arms=("panda",)),
    "deaf": Row(Fault.DISABLED, once("deaf"), 2, arms=("panda",)),
    "wrong length": Row(Fault.STALE, once("short"), 4),
    "disabled": Row(Fault.DISABLED, once("disable"), 2),
    "safe torque off": Row(Fault.NO_VOLTAGE, once("safe_torque_off", axis=0), 2, sick=tuple(range(7))),
    "encoder": Row(Fault.ENCODER, once("encoder", 0.2), 2),
    "slip": Row(Fault.ENCODER, once("drift", 2.5), 4, arms=("openarm",)),  # the other tells no speed to compare with
    "blocked": Row(Fault.FOLLOWING, once("block"), 60, only_moving=True),
    "brake closes": Row(Fault.FOLLOWING, once("brake"), 60, only_moving=True, arms=("panda",)),
    "heartbeat": Row(Fault.HEARTBEAT, once("heartbeat"), 52, sick=(), arms=("panda",)),
    "hot": Row(Fault.HOT, once("hot", 96.0), 2, sick=(), arms=("openarm",)),
    "flood": Row(Fault.FLOOD, once("babble", 0x55), 16, sick=()),
    "overrun": Row(Fault.OVERRUN, lambda rig: rig.run(20_000_000), 2, sick=()),
}


@pytest.fixture(scope="module", params=INTERFACES)
def enabled(request: pytest.FixtureRequest) -> dict[str, Rig]:
    """Rigs that hold their arm; tests take copies."""
    if request.param == "socketcan" and not has_vcan():
        pytest.skip("this kernel has no vcan0")
    made = {}
    for arm in ARMS:
        rig = Rig(arm, interface=request.param, watchdog_ms=40.0)
        m = rig.line.mechanics
        m.load = 3.0 * m.inertia / m.inertia[0]
        rig.driver.dynamics = lambda q, dq, ddq, m=m: vector(m.load + m.friction * dq + m.inertia * ddq)
        rig.line.on_stand = True
        rig.driver.configure()
        rig.driver.activate(rig.period_ns)
        made[arm] = rig
    return made


def run_up(rig: Rig, speed: float) -> Callable[[], Vector]:
    """Bring the arm to that speed; what to command next."""
    q0 = rig.driver.read(rig.now_ns()).q.copy()
    t = [0.0]

    def wanted() -> Vector:
        t[0] += rig.period_ns * 1e-9
        return vector(q0 + speed * (t[0] ** 2 / 0.2 if t[0] < 0.1 else t[0] - 0.05))

    for _ in range(50):
        sample = step(rig, wanted(), speed)
        assert sample is not None and RobotFlag.READY in sample.flags
    return wanted


def step(rig: Rig, q: Vector, speed: float) -> object:
    command = position(q, np.full(len(q), speed))
    tau = rig.driver.dynamics(q, command.dq, np.zeros(len(q)))
    return rig.cycle(dataclasses.replace(command, tau=tau))


def strike_and_stop(rig: Rig, row: Row, speed: float) -> tuple[int, int, np.ndarray]:
    """(cycles until the arm is stopped, until the row's fault was seen, true way of every joint from the strike on)."""
    wanted = run_up(rig, speed)
    way: list[np.ndarray] = []
    tick = rig.line.tick
    rig.line.tick = lambda t_ns: (tick(t_ns), way.append(rig.line.mechanics.q.copy()))[0]
    struck = rig.driver._stream.seq
    row.strike(rig)
    for _ in range(row.cycles + 4):
        try:
            sample = step(rig, wanted(), speed)
        except RobotFaulted:
            break
        if sample is not None and RobotFlag.FAULTED in sample.flags:
            break
    stopped = rig.driver._stream.seq - struck
    rig.driver.stop()
    rig.run(1_000_000_000 if RULES[row.fault].reaction is Reaction.CUT else 200_000_000)
    seen = [found.seq for found in rig.driver._stream.found if found.fault is row.fault]
    assert seen, f"{row.fault} was not seen: {[str(f) for f in rig.driver._stream.found]}"
    return stopped, seen[0] - struck, np.array(way)


@pytest.mark.parametrize("speed", [0.0, SPEED], ids=["at rest", "at speed"])
@pytest.mark.parametrize("name", ROWS)
@pytest.mark.parametrize("arm", ARMS)
def test_a_fault_stops_the_arm_and_lets_nothing_fall(
    enabled: dict[str, Rig], arm: str, name: str, speed: float
) -> None:
    row = ROWS[name]
    if arm not in row.arms or (row.only_moving and not speed):
        pytest.skip("this drive, or an arm at rest, does not show it")
    rig = copy.deepcopy(enabled[arm])
    stopped, seen, way = strike_and_stop(rig, row, speed)
    assert seen <= row.cycles and stopped <= row.cycles + 1
    assert rig.driver.fault is not None and rig.driver.fault.hint
    assert row.fault is Fault.BRAKE or not any(f.fault is Fault.BRAKE for f in rig.driver._stream.found)
    healthy = [i for i in range(len(rig.line.drives)) if i not in row.sick]
    dq, q = rig.line.mechanics.dq[healthy], way[:, healthy]
    assert np.all(np.abs(dq) < AT_REST), "the healthy axes are at rest"
    if healthy:
        off = straightness(q, np.full(len(healthy), speed))
        limit = STRAIGHT * (2 if RULES[row.fault].reaction is Reaction.CUT else 1)  # each drive stops by itself
        assert off < limit, f"{off * 1e3:.1f} mrad off the way"
        assert np.all(np.abs(q[-1] - q[-100]) < 0.01), "and hold"
    if RULES[row.fault].reaction is Reaction.STOP and row.fault is not Fault.NO_VOLTAGE:
        powers = [drive.is_enabled or drive.brake_closed for drive in rig.line.drives]
        assert all(powers[i] for i in healthy), "no axis without brake was let go"


def straightness(q: np.ndarray, direction: np.ndarray) -> float:
    """Farthest distance from the straight way that began at q[0], rad."""
    gone = q - q[0]
    if not direction.any():
        return float(np.abs(gone).max())
    along = gone @ direction / (direction @ direction)
    return float(np.abs(gone - along[:, None] * direction).max())


@pytest.mark.parametrize("arm", ARMS)
def test_one_lost_answer_is_bridged(enabled: dict[str, Rig], arm: str) -> None:
    rig = copy.deepcopy(enabled[arm])
    wanted = run_up(rig, SPEED)
    for _ in range(4):  # past the heartbeat: the next frame of the axis is its answer
        step(rig, wanted(), SPEED)
    rig.strike("lose", SICK + 1, 1)
    sample = step(rig, wanted(), SPEED)
    assert sample is not None and RobotFlag.READY in sample.flags
    assert rig.driver._stream.counters.missed == 1 and rig.driver._stream.missed[SICK] == 1
    assert sample.q[SICK] == pytest.approx(rig.line.mechanics.q[SICK], abs=0.006)
    assert step(rig, wanted(), SPEED) is not None and rig.driver._stream.missed[SICK] == 0


@pytest.mark.parametrize(("name", "value", "fault"), [("hot", 75.0, Fault.WARM), ("late", 3.0, Fault.MISSED)])
def test_what_is_only_a_warning_moves_on(enabled: dict[str, Rig], name: str, value: float, fault: Fault) -> None:
    rig = copy.deepcopy(enabled["openarm"])
    wanted = run_up(rig, SPEED)
    if name == "late":
        rig.line.late[SICK] = 0
        rig.strike("lose", SICK + 1, 2)
    else:
        rig.strike(name, SICK + 1, value)
    for _ in range(10):
        sample = step(rig, wanted(), SPEED)
        assert sample is not None and RobotFlag.READY in sample.flags
    assert rig.driver.report()["found"][fault] > 0


@pytest.mark.parametrize("speed", [0.0, SPEED], ids=["at rest", "at speed"])
@pytest.mark.parametrize("arm", ARMS)
def test_a_drive_that_needs_rest_slows_the_arm_until_it_has_cooled(
    enabled: dict[str, Rig], arm: str, speed: float
) -> None:
    """Seen in two cycles by its figure or its warning, and no stop; 5 K of hysteresis where there is a figure."""
    rig = copy.deepcopy(enabled[arm])
    wanted = run_up(rig, speed)
    tells_figure = arm == "openarm"
    for celsius, asks in ((84.0, False), (85.0, True), (81.0, tells_figure), (79.0, False), (84.0, False)):
        rig.strike("hot", SICK + 1, celsius)
        for _ in range(2):
            sample = step(rig, wanted(), speed)
        assert sample is not None and RobotFlag.READY in sample.flags
        assert (RobotFlag.WARM in sample.flags) is asks, f"at {celsius:g} C"
    assert rig.driver.report()["found"][Fault.HEATED] > 0 and rig.driver.fault is None


def test_nothing_is_enabled_or_reset_by_itself(enabled: dict[str, Rig]) -> None:
    rig = copy.deepcopy(enabled["openarm"])
    run_up(rig, 0.0)
    rig.strike("disable", SICK + 1)
    special: list[bytes] = []
    rig.line.listeners.append(lambda d: special.append(d.frame.data) if d.frame.data[:7] == b"\xff" * 7 else None)
    rig.driver.read(rig.now_ns())
    rig.driver.stop()
    assert not special and rig.driver._stream.powers()[SICK] is Power.DISABLED


@pytest.mark.parametrize("speed", [0.0, SPEED], ids=["at rest", "at speed"])
@pytest.mark.parametrize("jammed", ["brake", "contact"])
def test_an_axis_whose_brake_does_not_tell_that_it_has_closed_keeps_its_power(
    enabled: dict[str, Rig], jammed: str, speed: float
) -> None:
    """Told once the arm is at rest; the others are braked and switched off, and nothing gives way."""
    rig = copy.deepcopy(enabled["panda"])
    run_up(rig, speed)
    rig.strike(jammed, SICK + 1, 0.0)
    for axis in rig.driver._stream.axes:
        axis.brake_closed = True  # what it told before it was asked to close is no answer
    rig.driver.stop()
    rest, drives = rig.line.mechanics.q.copy(), rig.line.drives
    rig.run(1_000_000_000)
    np.testing.assert_allclose(rig.line.mechanics.q, rest, atol=1e-3)
    assert [drive.is_enabled for drive in drives] == [i == SICK for i in range(7)]
    assert all(drive.brake_closed for i, drive in enumerate(drives) if i != SICK)
    (found,) = rig.driver._stream.found
    assert (found.fault, found.axis) == (Fault.BRAKE, SICK) and "support the arm" in rig.driver.fault.hint


def test_who_still_moves_at_the_end_of_the_stop_is_waited_for(
    enabled: dict[str, Rig], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Brakes that close on a moving arm wear; two seconds later they close all the same."""
    for still, least, most in ((100, 0.27 + 0.4, 0.27 + 0.6), (10_000, 0.27 + 2.0, 0.27 + 2.2)):
        rig, asked = copy.deepcopy(enabled["panda"]), []
        run_up(rig, 0.0)
        monkeypatch.setattr(leave, "_stands", lambda stream, a=asked, n=still: a.append(1) or len(a) > n)
        begin = rig.now_ns()
        leave.come_to_rest(rig.driver._stream, rig.driver.dynamics)
        assert least <= (rig.now_ns() - begin) * 1e-9 <= most


@pytest.mark.parametrize("arm", ARMS)
def test_an_axis_without_power_is_told_where_it_is_until_the_end(enabled: dict[str, Rig], arm: str) -> None:
    """So that it does not jump when a person resets it: the way of the stop is another one."""
    rig = copy.deepcopy(enabled[arm])
    wanted = run_up(rig, SPEED)
    rig.strike("disable", SICK + 1)
    rig.line.drives[SICK].jam_brake(closed=False, contact=False)
    step(rig, wanted(), SPEED)
    stream = rig.driver._stream
    begin = stream.axes[SICK].feedback.q
    leave.come_to_rest(stream, rig.driver.dynamics)
    is_at = stream.axes[SICK].feedback.q
    assert abs(is_at - begin) > 0.03 and stream.targets[SICK].q == pytest.approx(is_at, abs=0.02)


def test_the_arm_stands_when_every_axis_does_that_has_no_fault() -> None:
    def stands(*axes: AxisState) -> bool:
        return leave._stands(cast(Any, SimpleNamespace(axes=axes)))

    fallen = AxisState(dq=1.0, faults={Fault.AXIS_FAULT})
    assert stands(AxisState(dq=0.049), AxisState(dq=-0.049), fallen)
    for dq in (0.051, -0.051):
        assert not stands(AxisState(), AxisState(dq=dq), fallen)


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_an_axis_that_gives_way_once_its_power_is_off_is_told(enabled: dict[str, Rig], way: float) -> None:
    """Its brake tells that it is closed, and slips: 20 mrad and more."""
    rig = copy.deepcopy(enabled["panda"])
    run_up(rig, 0.0)
    rig.strike("brake", SICK + 1, 0.0)
    rig.strike("contact", SICK + 1, 1.0)
    rig.line.mechanics.load[SICK] = -way * 20.0
    rig.driver.dynamics = lambda q, dq, ddq, m=rig.line.mechanics: vector(m.load)
    for _ in range(50):
        rig.driver.read(rig.now_ns())
        step(rig, vector(rig.line.mechanics.q), 0.0)
    rig.driver.stop()
    (found,) = rig.driver._stream.found
    assert (found.fault, found.axis, found.detail) == (Fault.BRAKE, SICK, "gives way without power")


def test_brakes_are_closed_before_the_power_goes(enabled: dict[str, Rig]) -> None:
    rig = copy.deepcopy(enabled["panda"])
    run_up(rig, SPEED)
    tick, unbraked = rig.line.tick, []
    rig.line.tick = lambda t_ns: (
        tick(t_ns), unbraked.extend(d.node for d in rig.line.drives if not d.is_enabled and not d._contact)
    )[0]  # fmt: skip
    rig.driver.stop()
    assert not unbraked and rig.driver.fault is None
    assert not any(drive.is_enabled for drive in rig.line.drives)


def test_without_contacts_the_drives_close_their_brakes_themselves(monkeypatch: pytest.MonkeyPatch) -> None:
    without = dataclasses.replace(arms.ARMS["panda"], brake_contact=None)  # type: ignore[type-var]
    monkeypatch.setitem(arms.ARMS, "panda", without)
    rig = Rig("panda")
    asked: list[int] = []
    rig.driver.configure()
    rig.line.listeners.append(
        lambda d: asked.append(d.frame.id) if d.frame.data[1:3] in (b"\xfd\x60", b"\xfe\x60") else None
    )
    rig.driver.activate(rig.period_ns)
    rig.driver.stop()
    assert rig.driver.fault is None and not asked
    assert all(drive.brake_closed and not drive.is_enabled for drive in rig.line.drives)


@pytest.mark.parametrize("arm", ARMS)
def test_a_velocity_is_followed(enabled: dict[str, Rig], arm: str) -> None:
    rig = copy.deepcopy(enabled[arm])
    run_up(rig, 0.0)
    q = rig.driver.read(rig.now_ns()).q
    for _ in range(60):
        dq = np.full(7, 0.3)
        tau = rig.driver.dynamics(q, dq, np.zeros(7))
        sample = rig.cycle(JointCommand(0, CommandKind.VELOCITY, vector(q), vector(dq), tau, False))
        assert sample is not None and RobotFlag.READY in sample.flags
    np.testing.assert_allclose(rig.line.mechanics.dq, 0.3, atol=0.03)


@pytest.mark.parametrize("arm", ARMS)
def test_an_axis_that_is_held_is_seen_when_a_velocity_is_commanded(enabled: dict[str, Rig], arm: str) -> None:
    rig = copy.deepcopy(enabled[arm])
    run_up(rig, 0.0)
    q, dq = rig.driver.read(rig.now_ns()).q, vector(np.full(7, SPEED))
    command = JointCommand(0, CommandKind.VELOCITY, q, dq, rig.driver.dynamics(q, dq, np.zeros(7)), False)
    for _ in range(60):
        sample = rig.cycle(command)
        assert sample is not None and RobotFlag.READY in sample.flags
    rig.strike("block", SICK + 1)
    struck = rig.driver._stream.seq
    while not rig.driver._stream.found:
        rig.cycle(command)
        assert rig.driver._stream.seq < struck + 80
    assert {(found.fault, found.axis) for found in rig.driver._stream.found} == {(Fault.FOLLOWING, SICK)}


@pytest.mark.parametrize("arm", ARMS)
def test_an_axis_where_no_axis_can_be_is_not_believed(enabled: dict[str, Rig], arm: str) -> None:
    """The zero of the encoder goes away, in steps that are neither a jump nor a slip, and the target goes with it."""
    rig = copy.deepcopy(enabled[arm])
    wanted, joint = run_up(rig, 0.0), rig.driver._codec.joints[3]
    rig.strike("block", 4)
    step_by, edge = (-0.004, joint.q_min - 0.1) if arm == "openarm" else (0.015, joint.q_max + 0.1)
    while not rig.driver._stream.found:
        rig.strike("encoder", 4, step_by)
        told = rig.driver.read(rig.now_ns()).q
        assert (told[3] - edge) * np.sign(step_by) < 0.05
        step(rig, vector(np.where(np.arange(7) == 3, told, wanted())), 0.0)
    (found,) = rig.driver._stream.found
    assert found.fault is Fault.ENCODER and found.axis == 3 and "outside its range" in found.detail
    assert (rig.driver._stream.axes[3].feedback.q - edge) * np.sign(step_by) > 0.0


@pytest.mark.parametrize("arm", ARMS)
def test_an_arm_that_went_on_while_we_were_held_up_is_not_told_where_it_was(arm: str) -> None:
    """The last torque goes on acting: 20 ms without us are 13 mrad of way and 0.06 rad/s here."""
    rig = Rig(arm, stale_ms=50.0)
    m = rig.line.mechanics
    rig.driver.dynamics = lambda q, dq, ddq: vector(m.friction * dq + m.inertia * ddq)
    rig.driver.configure()
    sample: JointState | None = rig.driver.activate(rig.period_ns)
    for k in range(61):
        assert sample is not None
        ddq = np.full(7, 4.0)
        tau = rig.driver.dynamics(sample.q, sample.dq, ddq)
        rig.driver.write(torque(sample.q, sample.dq + rig.period_ns * 1e-9 * ddq, tau))
        rig.run(rig.period_ns if k < 60 else 20_000_000)
        sample = rig.driver.read(rig.now_ns())
    assert sample is not None and RobotFlag.READY in sample.flags
    np.testing.assert_allclose(sample.q, m.q, atol=4e-3)
    np.testing.assert_allclose(sample.dq, m.dq, atol=0.03)


@pytest.mark.parametrize("hour", [3600.0, -3600.0])
def test_a_clock_that_is_set_while_the_arm_moves_changes_nothing(hour: float) -> None:
    """That of the interface, by which the time between two answers is told; together with an answer that is lost. These
    drives tell no speed: it is the difference of positions."""
    rig = Rig("panda", stale_ms=50.0)
    m, heard, ahead = rig.line.mechanics, rig.driver._link.receive, [0.0]
    rig.driver.dynamics = lambda q, dq, ddq: vector(m.friction * dq + m.inertia * ddq)

    def receive(deadline_ns: int) -> Frame | None:
        frame = heard(deadline_ns)
        return frame and dataclasses.replace(frame, stamp=frame.stamp + ahead[0])

    rig.driver._link.receive = receive  # type: ignore[method-assign]
    rig.driver.configure()
    sample: JointState | None = rig.driver.activate(rig.period_ns)
    for k in range(80):
        assert sample is not None and RobotFlag.READY in sample.flags
        ddq = 8.0 * (SPEED - sample.dq)
        tau = rig.driver.dynamics(sample.q, sample.dq, ddq)
        if k == 60:
            rig.strike("lose", SICK + 1, 1)
            ahead[0] = hour
        sample = rig.cycle(torque(sample.q, sample.dq + rig.period_ns * 1e-9 * ddq, tau))
        assert sample is not None
        np.testing.assert_allclose(sample.dq, m.dq, atol=0.03)
        np.testing.assert_allclose(sample.q, m.q, atol=3e-3)


@pytest.mark.parametrize("arm", ARMS)
def test_a_bus_on_which_nobody_answers_is_told_after_two_cycles(enabled: dict[str, Rig], arm: str) -> None:
    rig = copy.deepcopy(enabled[arm])
    wanted = run_up(rig, 0.0)
    rig.silence()
    told = []
    for _ in range(2):
        assert step(rig, wanted(), 0.0) is None
        told.append(rig.driver.report()["found"].get(Fault.SILENT, 0))
    assert told == [0, 1]


def test_an_interface_that_becomes_slow_shows_no_speed_that_is_not_there() -> None:
    """Some cycles pass without an answer, then each brings one that is as old: 4 ms lie in it, not the 16 ms between
    our cycles. These drives tell no speed: it is the difference of positions."""
    rig = Rig("panda", stale_ms=50.0)
    m = rig.line.mechanics
    rig.driver.dynamics = lambda q, dq, ddq: vector(m.friction * dq + m.inertia * ddq)
    rig.driver.configure()
    sample: JointState | None = rig.driver.activate(rig.period_ns)
    for k in range(100):
        if k == 60:
            deliver_late(rig, 14_000_000)
        if sample is not None:
            ddq = 8.0 * (SPEED - sample.dq)
            tau = rig.driver.dynamics(sample.q, sample.dq, ddq)
            rig.driver.write(torque(sample.q, sample.dq + rig.period_ns * 1e-9 * ddq, tau))
        rig.wait()
        sample = rig.driver.read(rig.now_ns() + rig.period_ns // 4)
        assert sample is not None or 60 <= k < 70
        if sample is not None:
            assert RobotFlag.READY in sample.flags
            np.testing.assert_allclose(sample.dq, m.dq, atol=0.25)
    assert rig.driver.report()["late_answers"] > 0


def deliver_late(rig: Rig, ns: int) -> None:
    """From now on what the interface hears it hands over so much later."""
    line, heard = rig.line, rig.driver._link._bus._peer

    def receive(timeout: float | None) -> tuple[int, object] | None:
        until_ns = line.now_ns + round((timeout or 0.0) * 1e9)
        while True:
            next_ns = heard._kept[0].t_ns + ns if heard._kept else until_ns
            if heard._kept and next_ns <= line.now_ns:
                delivery = heard._kept.popleft()
                return delivery.t_ns, delivery.frame
            if line.advance(min(next_ns, until_ns)) is None and line.now_ns >= until_ns:
                return None

    heard.receive = receive
