"""The session with a simulated controller in the same thread, in simulated time: every packet, no clock."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from asc_rt.core.types import CommandKind, JointCommand, JointState, RobotFlag, Vector, vector
from drivers.base import HandshakeError, LinkError, ProtocolError, RobotFaulted, WriteReceipt
from drivers.fanuc_stream_motion.link import StreamMotion
from drivers.fanuc_stream_motion.session import TOOL_UNKNOWN
from sim_hil.fanuc.arm import KinematicPlant
from sim_hil.fanuc.controller import Controller, Program
from sim_hil.fanuc.lockstep import Lockstep
from sim_hil.fanuc.settings import Settings

PERIOD_NS = 8_000_000
START = np.radians([10.0, 20.0, -10.0, 40.0, -50.0, 60.0])
MOVE = np.radians([20.0, -10.0, 15.0, 30.0, 10.0, -40.0])


class Rig:
    """A driver, its robot, and a core that follows a path and asks nothing."""

    def __init__(
        self, version: int = 3, options: dict[str, Any] | None = None, settings: Settings | None = None
    ) -> None:
        self.plant = KinematicPlant(START, 0.008)
        self.controller = Controller(self.plant, settings)
        self.wire = Lockstep(self.controller)
        self.sent: list[bytes] = []
        self.driver = StreamMotion(
            {"host": "robot", "version": version, **(options or {})}, tap=self._note, transport=self.wire
        )
        self.k = 0

    def _note(self, direction: str, t_ns: int, data: bytes) -> None:
        if direction == "tx":
            self.sent.append(data)

    def begin(self) -> JointState:
        self.driver.configure()
        return self.driver.activate(PERIOD_NS)

    def read(self) -> JointState | None:
        return self.driver.read(self.wire.now_ns() + 2 * PERIOD_NS)

    def write(self, q: Vector, last: bool = False) -> WriteReceipt:
        zero = vector(np.zeros(6))
        return self.driver.write(JointCommand(self.k, CommandKind.POSITION, vector(q), zero, zero, last))

    def cycle(self, path: Callable[[int], Vector] = lambda k: START) -> JointState | None:
        """One cycle as the shell runs it: no sample, no command."""
        joint = self.read()
        if joint is not None:
            self.write(path(self.k))
            self.k += 1
        return joint

    def run(self, cycles: int, path: Callable[[int], Vector] = lambda k: START) -> list[JointState]:
        return [joint for _ in range(cycles) if (joint := self.cycle(path)) is not None]

    def numbers(self) -> list[int]:
        return [int.from_bytes(data[8:12], "big") for data in self.sent if data[3] in (1, 5)]

    @property
    def offences(self) -> list[str]:
        return [offence.rule for offence in self.controller.offences]


def there(k: int) -> Vector:
    """To START + MOVE in a second, at rest at both ends."""
    t = min(1.0, max(0.0, (k - 10) / 125))
    return START + MOVE * float(t**3 * (10 - 15 * t + 6 * t**2))


STRICT = Settings(limits=True)
LIMITS = {"limits": True, "arm": "lrmate_200id"}


def slowly(k: int) -> Vector:
    """To START + MOVE in two seconds: inside the limit tables, both conventions of J3."""
    t = min(1.0, max(0.0, (k - 10) / 250))
    return START + MOVE * float(t**3 * (10 - 15 * t + 6 * t**2))


def ramp(k: int) -> Vector:
    return START + np.radians(10.0) * 0.008 * max(0, k - 10)


# --- a good session --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("version", [1, 2, 3])
def test_the_arm_goes_where_it_is_told(version: int) -> None:
    rig = Rig(version)
    np.testing.assert_allclose(rig.begin().q, START, atol=1e-6)
    rig.run(180, there)
    np.testing.assert_allclose(rig.plant.q, START + MOVE, atol=1e-5)
    rig.driver.stop()
    rig.driver.close()
    assert rig.offences == []
    assert {len(data) for data in rig.sent if data[3] in (1, 5)} == {64 if version == 1 else 104}


def test_each_command_carries_the_number_of_the_status_it_answers() -> None:
    rig = Rig()
    rig.begin()
    assert [joint.seq for joint in rig.run(20)] == rig.numbers()


def test_the_receipt_is_what_the_bytes_say() -> None:
    rig = Rig(version=1)
    rig.begin()
    rig.read()
    receipt = rig.write(START + 1e-3)
    assert receipt.ok and receipt.seq == rig.numbers()[-1]
    axes = np.frombuffer(rig.sent[-1], ">f4", 6, 28).astype(float)
    axes[2] += axes[1]
    np.testing.assert_allclose(receipt.q, np.radians(axes), rtol=0, atol=1e-15)
    assert np.all(receipt.q != START + 1e-3)  # float32 did round


def test_velocity_is_estimated_over_the_cycles_between_two_samples() -> None:
    rig = Rig()
    rig.begin()
    joints = rig.run(80, ramp)
    assert joints[-1].dq_is_estimated
    np.testing.assert_allclose(joints[-1].dq, np.radians(10.0), rtol=1e-2)
    rig.wire.to_pc = lambda data: []
    rig.read()
    rig.wire.to_pc = lambda data: [data]
    joint = rig.cycle(ramp)
    assert joint is not None
    np.testing.assert_allclose(joint.dq, np.radians(10.0), rtol=1e-2)


def test_set_points_reach_the_arm_after_about_60_ms() -> None:
    rig = Rig()
    rig.begin()
    rig.run(100, ramp)
    behind = (ramp(rig.k - 1) - rig.plant.q) / np.radians(10.0)
    assert np.all((behind > 0.05) & (behind < 0.07))


def test_before_the_first_command_only_the_newest_status_counts() -> None:
    rig = Rig()
    rig.begin()
    rig.wire.run(30)  # the control process gets ready
    joint = rig.cycle()
    assert joint is not None and joint.seq == rig.controller.sequence
    rig.run(30)
    assert rig.offences == []


def test_a_last_command_ends_the_program_and_the_session() -> None:
    rig = Rig()
    rig.begin()
    rig.run(30)
    rig.read()
    assert rig.write(START, last=True).ok
    rig.read()
    assert not rig.write(START).ok  # the session is over
    rig.driver.stop()
    assert rig.offences == []
    assert rig.sent[-1] == bytes.fromhex("0000000200000003")
    assert rig.sent[-2][12] == 1


def test_stop_at_rest_says_goodbye_and_a_new_session_can_begin() -> None:
    rig = Rig()
    rig.begin()
    rig.run(30)
    rig.driver.stop()
    assert [data[12] for data in rig.sent if data[3] == 5][-2:] == [0, 1]
    assert rig.driver.activate(PERIOD_NS).flags & RobotFlag.READY
    rig.run(30)
    rig.driver.stop()
    assert rig.offences == []


def test_what_an_earlier_session_left_in_the_socket_is_thrown_away() -> None:
    rig = Rig()
    rig.driver.configure()
    rig.wire._inbox.append((0, b"left over"))
    rig.driver.activate(PERIOD_NS)


@pytest.mark.parametrize("limits", [True, False])
@pytest.mark.parametrize("version", [1, 3])
def test_stop_in_motion_streams_a_jerk_limited_stop_and_says_goodbye(version: int, limits: bool) -> None:
    rig = Rig(version, {**LIMITS, "limits": limits}, STRICT)
    rig.begin()
    rig.run(100, slowly)
    assert np.abs(rig.plant.dq).max() > 0.1
    rig.driver.stop()
    rig.wire.run(20)
    assert rig.offences == []
    np.testing.assert_allclose(rig.plant.dq, 0, atol=1e-4)
    assert rig.sent[-1] == bytes.fromhex(f"000000020000000{version}")
    assert [data[12] for data in rig.sent if data[3] in (1, 5)][-2:] == [0, 1]


def test_stop_in_motion_with_the_answer_still_owed_answers_first() -> None:
    rig = Rig(options=LIMITS, settings=STRICT)
    rig.begin()
    rig.run(100, slowly)
    rig.read()  # and then the decision raised
    rig.driver.stop()
    assert rig.offences == []
    assert np.all(np.diff(rig.numbers()) == 1)


def test_stop_in_motion_is_silence_if_the_robot_left_the_session() -> None:
    rig = Rig()
    rig.begin()
    rig.run(80, there)
    rig.controller.press_emergency_stop()
    rig.run(8, there)
    before = len(rig.numbers())
    rig.driver.stop()
    assert len(rig.numbers()) == before
    assert rig.sent[-1] == bytes.fromhex("0000000200000003")


# --- time and packets lost -------------------------------------------------------------------------------------------


def test_a_backlog_is_answered_one_by_one() -> None:
    rig = Rig()
    rig.begin()
    rig.run(60, there)
    rig.wire.run(4)  # we slept
    before = rig.wire.now_ns()
    joints = rig.run(4, there)
    assert rig.wire.now_ns() == before
    assert np.diff([joint.seq for joint in joints]).tolist() == [1, 1, 1]
    rig.run(60, there)
    assert rig.offences == []
    assert rig.driver.counters.missing == 0


def test_a_stall_beyond_the_buffer_is_a_fault_that_stays() -> None:
    rig = Rig()
    rig.begin()
    rig.run(60, there)
    rig.wire.run(8)
    assert [alarm.number for alarm in rig.controller.alarms] == ["MOTN-603"]
    joints = rig.run(10, there)
    assert RobotFlag.FAULTED in joints[-1].flags and RobotFlag.READY not in joints[-1].flags
    assert not rig.write(START).ok
    rig.controller.reset()
    rig.controller.run_program()
    later = rig.run(10, there)[-1]
    assert RobotFlag.READY in later.flags and RobotFlag.FAULTED in later.flags


@pytest.mark.parametrize("lost", [1, 2, 4])
def test_lost_statuses_are_answered_too(lost: int) -> None:
    rig = Rig()
    rig.begin()
    rig.run(60, there)
    rig.wire.to_pc = lambda data: []
    rig.wire.run(lost)
    rig.wire.to_pc = lambda data: [data]
    seqs = [joint.seq for joint in rig.run(lost + 1, there)]
    assert seqs == [rig.controller.sequence] * (lost + 1)  # the newest sample, once for each number
    assert rig.driver.counters.missing == lost
    rig.run(60, there)
    assert rig.offences == []
    assert np.all(np.diff(rig.numbers()) == 1)


def test_repeated_and_late_statuses_are_not_answered_twice() -> None:
    rig = Rig()
    rig.begin()
    rig.run(20, there)
    rig.wire.to_pc = lambda data: [data, data]
    rig.run(20, there)
    assert rig.driver.counters.stale > 15
    kept: list[bytes] = []

    def late(data: bytes) -> list[bytes]:
        kept.append(data)
        return [] if len(kept) % 2 else [kept[-1], kept[-2]]  # pairs swapped

    rig.wire.to_pc = late
    rig.run(40, there)
    assert rig.offences == []
    assert np.all(np.diff(rig.numbers()) == 1)


def test_a_lost_command_is_the_robots_fault_to_tell() -> None:
    rig = Rig()
    rig.begin()
    rig.run(60, there)
    rig.wire.to_robot = lambda data: []
    rig.cycle(there)
    rig.wire.to_robot = lambda data: [data]
    joints = rig.run(10, there)
    assert [alarm.number for alarm in rig.controller.alarms] == ["MOTN-601"]
    assert RobotFlag.FAULTED in joints[-1].flags


def test_the_sequence_wraps() -> None:
    rig = Rig()
    rig.begin()
    rig.controller._sequence = 2**32 - 20
    rig.run(60, there)
    assert rig.numbers()[0] > 2**32 - 21 and rig.numbers()[-1] < 60
    assert rig.offences == []


def test_no_more_than_one_command_for_one_number() -> None:
    rig = Rig()
    rig.begin()
    rig.run(20)
    assert not rig.write(START).ok
    rig.run(20)
    assert rig.offences == []


# --- bad news --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "spoil",
    [
        lambda data: data[:100],
        lambda data: data + b"\0",
        lambda data: data[:60] + bytes.fromhex("7fc00000") + data[64:],
        lambda data: data[:7] + b"\x01" + data[8:],
    ],
    ids=["truncated", "too long", "NaN", "other version"],
)
def test_a_malformed_packet_of_the_robot_is_a_protocol_error(spoil: Callable[[bytes], bytes]) -> None:
    rig = Rig()
    rig.begin()
    rig.run(20)
    rig.wire.to_pc = lambda data: [spoil(data)]
    with pytest.raises(ProtocolError):
        rig.read()
    rig.driver.stop()  # deaf by now, and yet:
    assert rig.sent[-1] == bytes.fromhex("0000000200000003")


def test_a_robot_that_does_not_answer_is_a_link_error() -> None:
    rig = Rig()
    rig.wire.powered = False
    with pytest.raises(LinkError, match="no answer from robot:60015") as caught:
        rig.driver.configure()
    assert "cable" in caught.value.hint


def test_a_robot_that_answers_only_after_start_is_found() -> None:
    rig = Rig()
    rig.wire.to_pc = lambda data: [data] if rig.controller.sequence else []
    rig.begin()


def test_an_older_robot_is_refused_without_an_alarm_there() -> None:
    rig = Rig(version=3, settings=Settings(version=2))
    with pytest.raises(HandshakeError, match="up to version 2, not 3") as caught:
        rig.driver.configure()
    assert "version = 2" in caught.value.hint
    assert rig.offences == []


@pytest.mark.parametrize("period_ms", [2.0, 4.0, 16.0])
def test_a_robot_of_another_period_is_refused(period_ms: float) -> None:
    rig = Rig(settings=Settings(period_ms=period_ms))
    rig.driver.configure()
    with pytest.raises(HandshakeError, match=f"cycle is {period_ms:.2f} ms, the cell's 8 ms"):
        rig.driver.activate(PERIOD_NS)


def test_a_robot_without_a_running_program_is_not_ready() -> None:
    rig = Rig(options={"ready_timeout": 0.5}, settings=Settings(program_starts=False))
    rig.driver.configure()
    with pytest.raises(RobotFaulted) as caught:
        rig.driver.activate(PERIOD_NS)
    assert "TP program" in caught.value.hint
    rig.controller.run_program()
    rig.driver.activate(PERIOD_NS)


def test_a_robot_without_servo_power_says_so() -> None:
    rig = Rig(options={"ready_timeout": 0.1})
    rig.driver.configure()
    rig.wire.to_pc = lambda data: [data[:12] + b"\0" + data[13:]]
    with pytest.raises(RobotFaulted, match="servo power"):
        rig.driver.activate(PERIOD_NS)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({}, "host is missing"),
        ({"host": "robot", "port": 0}, "port must be"),
        ({"host": "robot", "port": True}, "port must be"),
        ({"host": "robot", "version": 4}, "version must be one of"),
        ({"host": "robot", "ready_timeout": -1.0}, "ready_timeout must be"),
        ({"host": 5, "prot": 1}, "unknown option 'prot'.*host must be"),
    ],
)
def test_wrong_options_are_named(options: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        StreamMotion(options)


# --- limits ----------------------------------------------------------------------------------------------------------


def test_the_robots_tables_become_joint_limits_with_room_for_both_conventions_of_j3() -> None:
    rig = Rig(options=LIMITS)
    limits = rig.driver.configure().limits
    assert limits is not None
    table = np.array([500.0, 500.0, 700.0, 1100.0, 1100.0, 2000.0]) * 0.98
    got = np.degrees(limits.ddq_max)
    np.testing.assert_allclose(got[[0, 3, 4, 5]], table[[0, 3, 4, 5]], rtol=1e-5)
    assert got[1] + got[2] == pytest.approx(table[2], rel=1e-5)
    assert got[1] / got[2] == pytest.approx(5 / 7)
    jerk = 0.98 * np.array([4000, 2000, 2000, 4000, 4000, 4000])
    np.testing.assert_allclose(np.degrees(limits.dddq_max), jerk, rtol=1e-5)
    assert rig.offences == [] and rig.controller.sequence == 0
    assert Rig().driver.configure().limits is None


def test_version_1_keeps_room_for_its_rounding() -> None:
    exact, rounded = (Rig(version, LIMITS).driver.configure().limits for version in (2, 1))
    assert exact is not None and rounded is not None
    jerk = np.degrees(exact.dddq_max - rounded.dddq_max)
    np.testing.assert_allclose(jerk[[0, 3, 4, 5]], 8 * 2.0**-16 / 0.008**3, rtol=1e-5)
    rig = Rig(1, LIMITS, Settings(period_ms=2.0))
    rig.driver.configure()
    with pytest.raises(HandshakeError, match="too coarsely"):
        rig.driver.activate(2_000_000)


def test_payload_and_flange_speed_choose_the_place_in_the_tables() -> None:
    def acceleration(**options: Any) -> float:
        limits = Rig(options={**LIMITS, **options}).driver.configure().limits
        assert limits is not None
        return float(np.degrees(limits.ddq_max[0])) / 0.98

    assert acceleration(flange_speed=0.1) == pytest.approx(625)
    assert acceleration(payload_share=0.0) == pytest.approx(650)
    assert acceleration(flange_speed=4.4) == pytest.approx(500 * (1 - 2 * 0.25 / 19))


@pytest.mark.parametrize("while_started", [True, False])
def test_a_robot_that_does_not_tell_its_tables_is_refused_if_they_are_asked_for(while_started: bool) -> None:
    rig = Rig(options=LIMITS, settings=Settings(thresholds_while_waiting=False))
    if while_started:  # some controllers answer only after Start
        rig.wire.to_pc = lambda data: [data] if data[3] != 3 or rig.controller.sequence else []
        rig.controller.program = Program.STOPPED
        assert rig.driver.configure().limits is not None
        return
    with pytest.raises(HandshakeError, match="does not tell its limit tables") as caught:
        rig.driver.configure()
    assert "driver.limits = false" in caught.value.hint


@pytest.mark.parametrize(("share", "refused"), [(0.98, False), (1.01, True)])
def test_a_set_point_beyond_the_tables_is_never_sent(share: float, refused: bool) -> None:
    rig = Rig(options=LIMITS, settings=STRICT)
    rig.begin()
    rig.run(30)
    before = len(rig.numbers())
    rig.read()
    q = START.copy()
    q[3] += share * np.radians(5000.0) * 0.008**3  # first stage: the flange rests
    if not refused:
        assert rig.write(q).ok
        return
    with pytest.raises(ProtocolError, match="MOTN-722.*J4 jerk 5050, the robot's limit is 4975 deg/s3 at a"):
        rig.write(q)
    assert len(rig.numbers()) == before
    rig.driver.stop()
    assert rig.offences == []


def test_a_first_set_point_away_from_the_arm_is_never_sent() -> None:
    rig = Rig()
    rig.begin()
    rig.read()
    with pytest.raises(ProtocolError, match="MOTN-625.*1 deg from where the arm is"):
        rig.write(START + np.radians(1.0))
    assert rig.numbers() == []


# --- what the robot tells --------------------------------------------------------------------------------------------


def test_the_commanded_position_can_be_asked_before_the_first_command() -> None:
    rig = Rig()
    rig.begin()
    q = rig.driver.commanded(rig.wire.now_ns() + 10 * PERIOD_NS)
    assert q is not None
    np.testing.assert_allclose(q, START, atol=1e-6)
    assert rig.driver.commanded(rig.wire.now_ns() + 2 * PERIOD_NS) is None  # too soon for this robot


def test_the_tool_is_read_from_its_signals() -> None:
    rig = Rig(options={"tool_input": "RI[3:6]"}, settings=Settings(tool=5))
    assert rig.begin().tool_id == TOOL_UNKNOWN == -1  # asked for by the first command
    assert rig.run(10)[-1].tool_id == 5
    rig.controller.signals.couple(9)
    assert rig.run(2)[-1].tool_id == 9


def test_motor_currents_arrive() -> None:
    rig = Rig()
    rig.plant.torque = np.full(6, 100.0)  # type: ignore[attr-defined]
    np.testing.assert_allclose(rig.begin().current, [0.8, 0.8, 2.0, 5.7, 10.0, 20.0], rtol=1e-6)


@pytest.mark.parametrize(
    ("happens", "says"),
    [
        (lambda rig: rig.controller.press_emergency_stop(), "servo power went off"),
        (lambda rig: rig.controller.enable_pendant(), "left the session"),
        (lambda rig: (rig.run(5), rig.wire.run(3), rig.run(1), rig.wire.run(8)), "probably MOTN-603"),
        (lambda rig: rig.controller.jump_sequence(1), "counts its statuses anew"),
    ],
)
def test_a_lost_session_says_why_and_what_to_do(happens: Callable[[Rig], None], says: str) -> None:
    rig = Rig()
    rig.begin()
    rig.run(30)
    assert rig.driver.fault is None
    happens(rig)
    assert RobotFlag.FAULTED in rig.run(20)[-1].flags
    assert says in str(rig.driver.fault) and rig.driver.fault and rig.driver.fault.hint


def test_thinned_statuses_are_not_missing() -> None:
    rig = Rig(settings=Settings(thinning=4, brake_deg_s2=100.0))
    rig.begin()
    rig.run(80, there)
    rig.wire.to_robot = lambda data: []
    rig.run(30, there)
    assert rig.controller.alarms and rig.driver.counters.missing <= 3  # before the first thinned one told so


@pytest.mark.parametrize("text", ["RI[3]", "RI[0:1]", "RI[4:3]", "RI[1:17]", "AI[1:2]"])
def test_a_wrong_row_of_signals_is_named(text: str) -> None:
    with pytest.raises(ValueError, match="tool_input must be a row of signals"):
        StreamMotion({"host": "robot", "tool_input": text})
