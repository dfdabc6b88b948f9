"""The simulated controller on its own, spoken to with its own codec: each rule of the session and its breach."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sim_hil.fanuc import wire
from sim_hil.fanuc.arm import KinematicPlant, to_wire
from sim_hil.fanuc.cabinet import COMMANDED, MOVING, READY, SERVO_ON
from sim_hil.fanuc.controller import Controller
from sim_hil.fanuc.settings import Settings

PC, OTHER = ("127.0.0.1", 40001), ("127.0.0.1", 40002)
START = np.radians([10.0, 20.0, -10.0, 40.0, -50.0, 60.0])


class Bench:
    def __init__(self, version: int = 3, **settings: Any) -> None:
        self.version = version
        self.plant = KinematicPlant(START, 0.008)
        self.controller = Controller(self.plant, Settings(**settings))
        self.status: wire.Packet | None = None

    def request(self, name: str, **values: Any) -> bytes:
        return wire.write_request(name, self.version, **values)

    def command(self, sequence: int, q: np.ndarray[Any, Any] = START, last: bool = False, style: int = 1) -> bytes:
        return self.request("command", sequence=sequence, last_data=last, data_style=style, position=to_wire(q))

    def cycle(self, *packets: bytes, peer: tuple[str, int] = PC) -> list[wire.Packet]:
        """One cycle with these packets; its replies."""
        replies = [wire.read_reply(data) for _, data in self.controller.cycle([(peer, data) for data in packets])]
        self.status = next((reply for reply in replies if reply.name == "status"), None)
        return replies

    def stream(self, cycles: int, speed: float = 0.0) -> None:
        """Start, then answer each status; from where the arm is, all joints at `speed` rad/s after ten commands."""
        origin = self.plant.q
        self.cycle(self.request("start"))
        for k in range(cycles):
            assert self.status is not None
            self.cycle(self.command(self.status["sequence"], origin + speed * 0.008 * max(0, k - 10)))

    @property
    def bits(self) -> int:
        assert self.status is not None
        return self.status["status"]

    @property
    def sequence(self) -> int:
        assert self.status is not None
        return self.status["sequence"]

    @property
    def alarms(self) -> list[str]:
        return [alarm.number for alarm in self.controller.alarms]

    @property
    def rules(self) -> list[str]:
        return [offence.rule for offence in self.controller.offences]


# --- session ---------------------------------------------------------------------------------------------------------


def test_it_never_speaks_first_and_counts_from_one() -> None:
    bench = Bench()
    assert bench.cycle() == []
    assert [reply["sequence"] for reply in bench.cycle(bench.request("start"))] == [1]
    assert [bench.cycle()[0]["sequence"] for _ in range(3)] == [2, 3, 4]
    assert bench.cycle(bench.request("stop")) == []
    assert bench.cycle() == []
    assert bench.cycle(bench.request("start"))[0]["sequence"] == 1


def test_status_tells_time_pose_and_joints_in_its_own_units() -> None:
    bench = Bench()
    for _ in range(3):
        bench.cycle()
    bench.cycle(bench.request("start"))
    assert bench.status is not None
    assert bench.status["time_stamp"] == 4 * 8
    np.testing.assert_allclose(bench.status.axes("joints"), [10, 20, -30, 40, -50, 60, 0, 0, 0], atol=1e-5)
    assert np.abs(bench.status.axes("pose")[:3]).max() > 100
    assert bench.bits == READY | SERVO_ON


@pytest.mark.parametrize("start_move", [1, 5, 9])
def test_motion_starts_when_the_buffer_holds_start_move_commands(start_move: int) -> None:
    bench = Bench(start_move=start_move)
    bench.cycle(bench.request("start"))
    far = START + 0.01
    for k in range(start_move):
        np.testing.assert_array_equal(bench.plant.q, START)
        bench.cycle(bench.command(k, START if k == 0 else far))
        assert bench.bits & COMMANDED
    assert bench.controller.depth == start_move - 1
    bench.cycle(bench.command(start_move, far))
    assert bench.controller.depth == start_move - 1
    assert bench.alarms == []


def test_a_stream_moves_the_arm() -> None:
    bench = Bench()
    bench.stream(100, speed=0.5)
    np.testing.assert_allclose(bench.plant.dq, 0.5, rtol=1e-3)
    assert bench.bits & MOVING
    assert bench.rules == []


def test_last_data_passes_ibgn_end_and_the_program_comes_back() -> None:
    bench = Bench(loop_cycles=10)
    bench.stream(20)
    bench.cycle(bench.command(bench.sequence, last=True))
    for _ in range(4):
        assert bench.bits & READY
        bench.cycle()
    assert not bench.bits & READY
    for _ in range(10):
        bench.cycle()
    assert bench.bits & READY
    assert not bench.bits & COMMANDED
    bench.cycle(bench.command(12345))  # a new origin
    assert bench.rules == []


def test_without_a_loop_the_program_ends() -> None:
    bench = Bench(program_loops=False)
    bench.stream(20)
    bench.cycle(bench.command(bench.sequence, last=True))
    for _ in range(60):
        bench.cycle()
    assert not bench.bits & READY
    bench.controller.run_program()
    bench.cycle()
    assert bench.bits & READY


def test_last_data_starts_a_buffer_that_is_not_full_enough() -> None:
    bench = Bench(start_move=5)
    bench.cycle(bench.request("start"))
    bench.cycle(bench.command(1), bench.command(2, last=True))
    bench.cycle()
    bench.cycle()
    assert not bench.bits & READY
    assert bench.rules == []


def test_version_request_is_answered_without_a_session() -> None:
    bench = Bench(version=2)
    assert [(reply.name, reply.version) for reply in bench.cycle(bench.request("version"))] == [("version", 3)]


def test_thresholds_are_told_and_not_while_waiting_if_so_set() -> None:
    ask = {"axis": 3, "kind": 0}
    reply = Bench().cycle(Bench().request("thresholds", **ask))[0]
    assert (reply["axis"], reply["kind"], reply.axes("full_payload")[-1]) == (3, 0, 520)
    bench = Bench(thresholds_while_waiting=False, program_starts=False)
    assert bench.cycle(bench.request("thresholds", **ask))
    bench.controller.run_program()
    assert not bench.cycle(bench.request("thresholds", **ask))


def test_the_commanded_position_is_told_ten_times_a_second() -> None:
    bench = Bench()
    bench.stream(60, speed=0.5)
    told = 0
    for k in range(50):
        q = START + 0.5 * 0.008 * (50 + k)
        replies = bench.cycle(bench.command(bench.sequence, q), bench.request("commanded"))
        told += sum(reply.name == "commanded" for reply in replies)
    assert told == 4  # in 0.4 s
    assert bench.rules == []


# --- breaches: each is an alarm by its number, latched, the arm brakes ------------------------------------------------


def break_rule(bench: Bench, kind: str) -> None:
    n = bench.sequence
    match kind:
        case "repeated number":
            bench.cycle(bench.command(n), bench.command(n))
        case "skipped number":
            bench.cycle(bench.command(n + 1))
        case "silence":
            for _ in range(5):
                bench.cycle()
        case "flood":
            bench.cycle(*(bench.command(n + k) for k in range(7)))
        case "stop in motion":
            bench.cycle(bench.request("stop"))
        case "start in motion":
            bench.cycle(bench.request("start"))
        case "newer version":
            bench.cycle(wire.write_request("start", 3 if bench.controller.settings.version < 3 else 4))


@pytest.mark.parametrize(
    ("kind", "alarm"),
    [
        ("repeated number", "MOTN-601"),
        ("skipped number", "MOTN-601"),
        ("silence", "MOTN-603"),
        ("flood", "OVERFLOW"),
        ("stop in motion", "MOTN-603"),
        ("start in motion", "MOTN-603"),
        ("newer version", "MOTN-607"),
    ],
)
@pytest.mark.parametrize("speed", [0.0, 0.5])
def test_a_breach_is_a_latched_alarm_and_the_arm_comes_to_rest(kind: str, alarm: str, speed: float) -> None:
    bench = Bench()
    bench.stream(60, speed)
    moving = bench.plant.dq.copy()
    break_rule(bench, kind)
    assert bench.alarms == [alarm]
    assert len(bench.rules) == 1 and bench.rules[0].startswith(alarm)
    if speed:
        assert np.all(bench.plant.dq > 0.1 * moving)  # quickly, not at once
    for _ in range(30):
        bench.cycle()
    np.testing.assert_array_equal(bench.plant.dq, 0)
    assert not bench.controller.ready
    bench.controller.run_program()
    assert not bench.controller.ready  # the alarm stays
    bench.controller.reset()
    assert not bench.controller.ready  # so does the program, where it stopped
    bench.controller.run_program()
    assert bench.controller.ready
    bench.stream(20)
    assert bench.alarms == []


def test_status_goes_on_in_an_alarm_without_the_ready_bit_and_commands_are_ignored() -> None:
    bench = Bench()
    bench.stream(30)
    break_rule(bench, "silence")
    n = bench.sequence
    bench.cycle(bench.command(n))
    assert bench.sequence == n + 1
    assert bench.bits == SERVO_ON
    assert bench.controller.ignored == 1
    assert len(bench.rules) == 1


def test_a_first_command_far_from_the_arm_is_refused() -> None:
    bench = Bench(start_threshold_deg=1.0)
    bench.cycle(bench.request("start"))
    bench.cycle(bench.command(1, START + np.radians(0.9)))
    assert bench.alarms == []
    bench = Bench(start_threshold_deg=1.0)
    bench.cycle(bench.request("start"))
    bench.cycle(bench.command(1, START + np.radians(1.1)))
    assert bench.alarms == ["MOTN-625"]
    np.testing.assert_array_equal(bench.plant.q, START)


def test_silence_is_tolerated_as_long_as_the_buffer_lasts() -> None:
    bench = Bench(start_move=5)
    bench.stream(30)
    for _ in range(4):
        bench.cycle()
        assert bench.alarms == []
    bench.cycle()
    assert bench.alarms == ["MOTN-603"]


def test_the_sequence_wraps() -> None:
    bench = Bench()
    bench.cycle(bench.request("start"))
    for k in range(20):
        bench.cycle(bench.command((2**32 - 10 + k) % 2**32))
    assert bench.alarms == []


# --- offences that change nothing ------------------------------------------------------------------------------------


def test_offences_keep_their_bytes_and_change_nothing() -> None:
    bench = Bench()
    bench.stream(30)
    n = bench.sequence
    bad = [
        (b"\0\0\0\7", "malformed packet: 4 bytes"),
        (bench.command(n, style=0), "malformed packet: Cartesian command in double precision"),
        (wire.write_request("command", 1, sequence=n, data_style=1), "version 1 in a session of version 3"),
    ]
    for data, rule in bad:
        bench.cycle(data, bench.command(n))
        n += 1
        assert bench.rules[-1].startswith(rule)
        assert bench.controller.offences[-1].data == data
    assert bench.alarms == []


def test_commands_of_another_pc_are_not_obeyed() -> None:
    bench = Bench()
    bench.stream(30)
    n, depth = bench.sequence, bench.controller.depth
    bench.cycle(bench.command(n, START + 0.5), peer=OTHER)
    assert bench.rules == ["command of another PC"]
    assert bench.controller.depth == depth - 1


def test_commands_nobody_waits_for_are_offences() -> None:
    bench = Bench(program_starts=False)
    bench.cycle(bench.command(1))
    bench.cycle(bench.request("start"))
    bench.cycle(bench.command(1))
    assert bench.rules == ["command without start", "command while no program waits for it"]
    bench = Bench()
    bench.stream(20)
    bench.cycle(bench.command(bench.sequence, last=True))
    bench.cycle(bench.command(bench.sequence))
    assert bench.rules == ["command after last_data"]
    assert bench.alarms == []


def test_a_last_command_in_motion_is_an_offence() -> None:
    bench = Bench()
    bench.stream(20)
    bench.cycle(bench.command(bench.sequence, START + 0.01, last=True))
    assert bench.rules == ["last_data while moving"]
