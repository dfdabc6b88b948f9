"""Every fault of a cell, at rest and in motion, on both wires, and the state that it has to end in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from fanuc_rig import MOVE, START, A, B, Rig

from asc_rt.core.types import RobotFlag
from drivers.base import HandshakeError, LinkError, ProtocolError, RobotFaulted
from sim_hil.fanuc.controller_b import ControllerB

Happen = Callable[[Rig], object]

GOES_ON = "goes on"  # nobody stops, every number is answered once
FAULTED = "faulted"  # the robot left the session; the driver says so and sends nothing more
SILENT = "silent"  # no status comes any more
REFUSED = "refused"  # the driver raises a ProtocolError; its stop brings the arm to rest


@dataclass(frozen=True)
class End:
    how: str
    alarm: str = ""  # at the robot, "": none
    offence: str = ""  # the robot complains about it, beside the alarm


def inject(fault: str, count: int = 1, value: int = 1) -> Happen:
    return lambda rig: rig.faulty.inject(fault, count, value)


def pause(cycles: int) -> Happen:
    return lambda rig: rig.line.run(cycles)


def forge_burst(rig: Rig) -> None:
    number = rig.numbers()[-1]
    rig.forge([number + k for k in range(1, 14)])


def dip(rig: Rig) -> None:
    seen: list[bytes] = []

    def clear_ready(data: bytes) -> list[bytes]:
        seen.append(data)
        return [data[:12] + bytes([data[12] & ~1]) + data[13:]] if len(seen) <= 3 else [data]

    rig.line.to_pc = clear_ready


ok = End(GOES_ON)

TABLE: dict[str, tuple[Happen, End, End]] = {
    **{f"{n} statuses lost": (inject("lose_status", n), ok, ok) for n in (1, 2, 3, 4)},
    # The command of the cycle is one of the START_MOVE: the simulated robot is the stricter of two readings.
    "5 statuses lost (START_MOVE)": (inject("lose_status", 5), End(FAULTED, "MOTN-603"), ok),
    "6 statuses lost": (inject("lose_status", 6), End(FAULTED, "MOTN-603"), ok),
    "8 statuses lost": (inject("lose_status", 8), End(FAULTED, "MOTN-603"), ok),
    "11 statuses lost": (inject("lose_status", 11), End(FAULTED, "MOTN-603"), End(FAULTED)),
    "30 statuses lost": (inject("lose_status", 30), End(FAULTED, "MOTN-603"), End(FAULTED)),
    "statuses reordered": (inject("reorder_status", 5), ok, ok),
    "statuses repeated": (inject("repeat_status", 5), ok, ok),
    "status delayed by 3 cycles": (inject("delay_status", 1, 3), ok, ok),
    "numbers begin anew": (inject("sequence", 1, 1), End(FAULTED, "MOTN-603"), End(FAULTED)),
    "command lost": (inject("lose_command"), End(FAULTED, "MOTN-601"), End(GOES_ON, "", "number left out")),
    "command repeated": (inject("repeat_command"), End(FAULTED, "MOTN-601"), End(GOES_ON, "", "number repeated")),
    "commands reordered": (inject("reorder_command"), End(FAULTED, "MOTN-601"), End(GOES_ON, "", "number left out")),
    **{
        f"we are {cycles} cycles late": (
            pause(cycles),
            End(FAULTED, "MOTN-603") if cycles > 5 else ok,
            End(FAULTED) if cycles > 10 else ok,
        )
        for cycles in range(1, 13)
    },
    "we are 30 cycles late": (pause(30), End(FAULTED, "MOTN-603"), End(FAULTED)),
    "burst overflows the buffer": (forge_burst, End(FAULTED, "OVERFLOW"), End(GOES_ON, "", "OVERFLOW")),
    "foreign stop": (inject("foreign_stop"), End(SILENT, "MOTN-603"), End(SILENT)),
    "foreign start": (inject("foreign_start"), End(SILENT, "MOTN-603"), End(FAULTED, "HOST-380")),
    "emergency stop": (inject("emergency_stop"), End(FAULTED, "SRVO-002"), End(FAULTED, "SRVO-002")),
    "pendant enabled": (inject("pendant_on"), End(FAULTED, "TP-ENABLED"), End(FAULTED, "TP-ENABLED")),
    "ready bit dips": (dip, End(FAULTED, "MOTN-603"), End(FAULTED)),
    "clock jumps": (inject("clock", 1, 3_600_000), ok, ok),
    "clock jumps back": (inject("clock", 1, -500), ok, ok),
    "NaN in a status": (inject("nan_status"), End(REFUSED), End(REFUSED)),
    "truncated status": (inject("truncate_status"), End(REFUSED), End(REFUSED)),
    "foreign packet from the robot's address": (inject("foreign_status"), End(REFUSED), End(REFUSED)),
    "NaN in a command": (inject("nan_command"), End(FAULTED, "MOTN-601"), End(GOES_ON, "", "malformed")),
    "truncated command": (inject("truncate_command"), End(FAULTED, "MOTN-601"), End(GOES_ON, "", "malformed")),
    "robot loses power": (inject("power_off"), End(SILENT), End(SILENT)),
}


@pytest.mark.parametrize("moving", [False, True], ids=["at rest", "in motion"])
@pytest.mark.parametrize("wire", [A, B])
@pytest.mark.parametrize("fault", TABLE)
def test_a_fault_ends_as_it_must(fault: str, wire: str, moving: bool) -> None:
    happen, end = TABLE[fault][0], TABLE[fault][1 if wire == A else 2]
    rig = Rig(wire)
    rig.begin()
    rig.moving = moving
    rig.run(200)
    assert bool(np.abs(rig.plant.dq).max() > 0.05) is moving
    assert rig.offences == []
    happen(rig)
    joints, error = rig.try_run(120)
    check_session(rig, end, joints, error)
    assert ((rig.alarms or [""])[0]) == (end.alarm if end.how is not SILENT or rig.line.powered else "")
    sent = len(rig.commands())
    rig.driver.stop()
    if end.how in (FAULTED, SILENT):
        assert len(rig.commands()) == sent  # nothing is said to a robot that left
    powered = rig.faulty._powered
    rig.line.run(150)
    if powered:
        assert np.abs(rig.plant.dq).max() < 1e-3
        rest = rig.plant.q
        rig.line.run(100)
        np.testing.assert_allclose(rig.plant.q, rest, atol=1e-4)
    ours = [rule for rule in rig.offences if not (end.alarm and rule.startswith(end.alarm))]
    if end.offence:
        assert ours and any(rule.startswith(end.offence) for rule in ours)
    elif not end.alarm:
        assert ours == []  # the stop, too, was inside every rule


def check_session(rig: Rig, end: End, joints: list[object], error: Exception | None) -> None:
    match end.how:
        case "goes on":
            assert error is None and rig.driver.fault is None
            assert 0 <= rig.robot.sequence - rig.numbers()[-1] <= 1
        case "faulted":
            assert error is None
            assert rig.driver.fault is not None and rig.driver.fault.hint
            if end.alarm == "MOTN-603" and rig.driver.counters.missing:
                assert "probably MOTN-603" in str(rig.driver.fault) or "not answered in time" in str(rig.driver.fault)
            last = joints[-1]
            assert last is not None and RobotFlag.FAULTED in last.flags  # type: ignore[attr-defined]
        case "silent":
            assert error is None and joints[-1] is None
        case _:
            assert isinstance(error, ProtocolError)


@pytest.mark.parametrize("moving", [False, True], ids=["at rest", "in motion"])
@pytest.mark.parametrize("wire", [A, B])
def test_the_sequence_wraps(wire: str, moving: bool) -> None:
    rig = Rig(wire)
    rig.begin()
    rig.moving = moving
    rig.robot.jump_sequence(2**32 - 100)
    rig.run(250)
    assert rig.numbers()[0] > 2**31 > rig.numbers()[-1]
    assert rig.offences == [] and rig.driver.fault is None


@pytest.mark.parametrize("moving", [False, True], ids=["at rest", "in motion"])
@pytest.mark.parametrize(("wire", "jerk"), [(A, 5000.0), (B, 1.25 * 1860.0)])
@pytest.mark.parametrize("share", [0.99, 1.01])
def test_99_percent_of_a_limit_is_sent_and_101_percent_is_not(
    share: float, wire: str, jerk: float, moving: bool
) -> None:
    """J4 at the jerk of the first stage: the wrist alone moves, slowly, and turns about its own axis."""
    rig = Rig(wire)
    rig.begin()
    step = np.radians(jerk) * rig.period_ns**3 * 1e-27
    along = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    rig.path = lambda k: START + along * 0.25 * step * max(0, k - 20) ** 2 * moving  # type: ignore[method-assign]
    rig.run(40)
    rig.read()
    ahead = rig.path(rig.k) + along * share * step * (0.9999 if share < 1 else 1.0)
    if share < 1:
        assert rig.write(ahead).ok
        rig.driver.stop()
        assert rig.alarms == [] and rig.offences == []
        return
    before = len(rig.commands())
    with pytest.raises(ProtocolError, match="MOTN-722.*J4 jerk"):
        rig.write(ahead)
    assert len(rig.commands()) == before
    rig.driver.stop()
    assert rig.alarms == [] and rig.offences == []


@pytest.mark.parametrize("wire", [A, B])
def test_a_first_set_point_away_from_the_arm_is_never_sent_and_would_be_an_alarm(wire: str) -> None:
    rig = Rig(wire)
    rig.begin()
    rig.read()
    with pytest.raises(ProtocolError, match="MOTN-625.*2 deg from where the arm is"):
        rig.write(START + np.radians(2.0))
    assert rig.commands() == []
    rig.run(1)
    rig.driver.stop()
    rig.driver.activate(rig.period_ns)
    rig.forge([rig.robot.sequence], ahead=2.0)
    rig.line.run(2)
    assert rig.alarms == ["MOTN-625"]


@pytest.mark.parametrize("wire", [A, B])
def test_a_last_command_in_motion_is_never_sent(wire: str) -> None:
    rig = Rig(wire)
    rig.begin()
    rig.moving = True
    rig.run(150)
    rig.read()
    with pytest.raises(ProtocolError, match="last one of a session, and the arm still moves"):
        rig.write(rig.path(rig.k), last=True)
    rig.driver.stop()
    assert rig.offences == []


@pytest.mark.parametrize(("wire", "rule"), [(A, "last_data while moving"), (B, "last command while moving")])
def test_a_last_command_in_motion_would_be_an_offence(wire: str, rule: str) -> None:
    rig = Rig(wire)
    rig.begin()
    rig.moving = True
    rig.run(200)
    rig.read()
    rig.forge([rig.numbers()[-1] + 1], last=True, ahead=0.02)
    rig.line.run(2)
    assert rule in rig.offences


def test_a_command_that_does_not_say_joints_is_an_offence_on_the_ros_wire() -> None:
    rig = Rig(B)
    rig.begin()
    rig.run(30)
    rig.forge([rig.numbers()[-1] + 1], word=0)
    rig.line.run(1)
    assert rig.offences[-1].startswith("word 0x0000 instead of 0xffff")
    assert all(data[14:16] == b"\xff\xff" for data in rig.commands())


def test_beyond_the_tables_the_ros_wire_smooths_and_does_not_alarm() -> None:
    rig = Rig(B, {"limits": False})
    rig.begin()
    rig.run(20)
    rig.last = START + np.radians(5.0)
    rig.path = lambda k: START + np.radians(5.0)  # type: ignore[method-assign]
    rig.run(100)
    assert isinstance(rig.robot, ControllerB) and rig.robot.over_limit > 0
    assert rig.offences == []


def test_silence_on_the_ros_wire_coasts_and_then_stops_hard() -> None:
    """121 ms at 15 deg/s ... 71 ms at 50 deg/s."""
    rig = Rig(B, start_move=0)
    rig.begin()
    rig.moving = True
    rig.run(10 + round(MOVE[3] and 0.5 * 4.0 / 0.008))
    target = rig.path(rig.k - 1)
    speed = np.degrees(np.abs(rig.path(rig.k) - target).max() / 0.008)
    cycles = 0
    while rig.robot.ready:  # type: ignore[attr-defined]
        rig.line.run(1)
        cycles += 1
    want = np.interp(speed, [15.3, 49.9], [0.121, 0.071])
    assert abs(cycles * 0.008 - want) <= 0.016
    assert rig.alarms == [] and rig.robot.silent_stops == 1  # type: ignore[attr-defined]


# --- what is refused before anything moves ---------------------------------------------------------------------------


def test_a_robot_without_the_ros_wire_is_refused() -> None:
    rig = Rig(B, version=2)
    with pytest.raises(HandshakeError, match="up to version 2 only") as caught:
        rig.driver.configure()
    assert "fanuc-j519" in caught.value.hint


def test_version_4_is_taken_where_there_is_one() -> None:
    rig = Rig(B, version=4)
    assert "v4" in rig.driver.configure().identity
    rig.driver.activate(rig.period_ns)
    rig.run(30)
    assert rig.offences == [] and rig.commands()[-1][7] == 4


@pytest.mark.parametrize("wire", [A, B])
def test_limits_that_are_not_told_are_a_handshake_error(wire: str) -> None:
    rig = Rig(wire)
    rig.line.to_pc = lambda data: [] if data[3] == 3 else [data]
    with pytest.raises(HandshakeError) as caught:
        rig.driver.configure()
    assert "driver.limits = false" in caught.value.hint


def test_a_signal_that_is_not_assigned() -> None:
    rig = Rig(A, {"tool_input": "RO[8:9]"})
    rig.begin()
    rig.run(10)
    assert rig.alarms == ["PRIO-023"] and rig.driver.fault is not None
    with pytest.raises(HandshakeError, match=r"does not tell the signals RO\[8:9\]"):
        Rig(B, {"tool_input": "RO[8:9]"}).driver.configure()


def test_the_tool_is_told_on_the_ros_wire_too() -> None:
    rig = Rig(B, {"tool_input": "RI[3:6]"}, tool=5)
    assert rig.begin().tool_id == 5
    rig.robot.signals.couple(9)
    joint = rig.run(3)[-1]
    assert joint is not None and joint.tool_id == 9


def test_the_robot_has_to_stay_ready_after_a_repeated_call() -> None:
    rig = Rig(B, {"settle": 2.0})
    rig.begin()
    rig.run(30)
    rig.driver.stop()
    began = rig.line.now_ns()
    rig.driver.activate(rig.period_ns)
    assert (rig.line.now_ns() - began) * 1e-9 > 1.0 + 0.6 + 2.0 - 0.2  # it dips at 1 s for 0.6 s
    rig.run(200)
    assert rig.driver.fault is None and rig.offences == []


@pytest.mark.parametrize(
    ("prepare", "error", "says"),
    [
        (lambda rig: rig.robot.enable_pendant(), RobotFaulted, "pendant is enabled"),
        (lambda rig: setattr(rig.rmi, "override", 30), HandshakeError, "override is 30 %"),
        (lambda rig: rig.robot.press_emergency_stop(), HandshakeError, "2556955"),
        (lambda rig: setattr(rig.robot, "contact_stop", 2), RobotFaulted, "contact stop"),
        (lambda rig: setattr(rig.line, "powered", False), LinkError, "RMI does not answer"),
    ],
)
def test_a_robot_that_cannot_start_says_why(prepare: Happen, error: type[Exception], says: str) -> None:
    rig = Rig(B, {"ready_timeout": 0.5})
    prepare(rig)
    with pytest.raises(error, match=says) as caught:
        rig.begin()
    assert caught.value.hint  # type: ignore[attr-defined]


def test_after_an_emergency_stop_the_alarm_is_named_and_a_person_can_begin_again() -> None:
    rig = Rig(B)
    rig.begin()
    rig.moving = True
    rig.run(150)
    rig.faulty.inject("emergency_stop")
    joints = [joint for joint in rig.run(100) if joint is not None]
    ready = [bool(joint.flags & RobotFlag.READY) for joint in joints]
    pressed = [bool(joint.flags & RobotFlag.EMERGENCY_STOP) for joint in joints]
    assert RobotFlag.FAULTED in joints[1].flags and ready[1]  # the error comes first
    assert 36 <= ready.index(False) <= 39 and 61 <= pressed.index(True) <= 64  # 0.3 s, 0.5 s
    rig.driver.stop()
    assert "SRVO-" in str(rig.driver.fault) and "release the emergency stop" in rig.driver.fault.hint  # type: ignore
    rig.faulty.inject("emergency_release")
    rig.moving = False
    joint = rig.driver.activate(rig.period_ns)
    assert RobotFlag.FAULTED not in joint.flags
    rig.path = lambda k: joint.q  # type: ignore[method-assign]
    rig.run(30)
    assert rig.driver.fault is None
