"""The simulated bus: bit time, arbitration, backlog, errors; and the drives on it, as a stranger's client sees them."""

from __future__ import annotations

import can
import numpy as np
import pytest

from sim_hil.can.arms import ARMS
from sim_hil.can.bus import Bus, Delivery
from sim_hil.can.cia402_drive import ENABLED, POSITION, Cia402Drive, Data
from sim_hil.can.frames import ERROR_ACK, ERROR_BUS_OFF, NUMBER, Frame, pack, unpack
from sim_hil.can.line import Line
from sim_hil.can.mechanics import Joints
from sim_hil.can.plugin import SimulatedBus

EIGHT = bytes(8)


def two(bitrate: float = 1e6, data_bitrate: float = 5e6) -> Bus:
    bus = Bus(bitrate, data_bitrate)
    bus.join(0)
    bus.join(1)
    return bus


def command(number: int, data: bytes) -> can.Message:
    return can.Message(arbitration_id=number, data=data, is_fd=True, bitrate_switch=True, is_extended_id=False)


def passed(bus: Bus) -> list[Delivery]:
    found = []
    while (delivery := bus.next()) is not None:
        found.append(delivery)
    return found


@pytest.mark.parametrize(
    ("frame", "us"),
    [
        (Frame(1, EIGHT), 135.0),
        (Frame(1, b""), 55.0),
        (Frame(1, bytes(4)), 95.0),
        (Frame(1 | 1 << 31, EIGHT), 160.0),
        (Frame(1, EIGHT, True, True), 56.6),
        (Frame(1, EIGHT, True, False), 147.0),
    ],
)
def test_a_frame_takes_as_long_as_its_bits_in_the_worst_case(frame: Frame, us: float) -> None:
    assert two().duration_ns(frame) == pytest.approx(us * 1e3)


def test_the_lowest_identifier_wins_and_a_frame_under_way_is_never_interrupted() -> None:
    bus = two()
    bus.submit(0, Frame(0x300, EIGHT), 0)
    bus.submit(0, Frame(0x200, EIGHT), 1000)
    bus.submit(1, Frame(0x100, EIGHT), 2000)
    assert [d.frame.id for d in passed(bus)] == [0x300, 0x100, 0x200]


def test_a_standard_identifier_wins_over_an_extended_one_with_the_same_bits() -> None:
    bus = two()
    bus.submit(0, Frame(0x123 << 18 | 1 << 31, EIGHT), 0)
    bus.submit(1, Frame(0x123, EIGHT), 0)
    assert [bool(d.frame.id >> 31) for d in passed(bus)] == [False, True]


def test_more_than_the_queue_holds_is_refused() -> None:
    bus = two()
    taken = [bus.submit(0, Frame(1, EIGHT), 0) for _ in range(200)]
    assert taken.index(False) == 149  # 20 ms of 135 us


def test_what_a_node_asked_to_send_before_it_left_is_still_sent() -> None:
    bus = Bus()
    for node in range(3):
        bus.join(node)
    for _ in range(3):
        assert bus.submit(0, Frame(0x7FF, bytes(8)), 0)
    bus.leave(0)
    assert [passed.sender for _ in range(3) if (passed := bus.next())] == [0, 0, 0]
    assert bus.next() is None
    bus.leave(2)
    assert bus.submit(1, Frame(0x7FF, bytes(8)), 0)
    told = bus.next()
    assert told is not None and told.to == 1  # nobody is left who acknowledges


def test_destroyed_frames_are_sent_again_until_their_sender_is_off_the_bus() -> None:
    bus = two()
    bus.corrupt[0] = 1
    bus.submit(0, Frame(1, EIGHT), 0)
    (once,) = passed(bus)
    assert once.t_ns == 2 * 135_000 + 31_000 and bus.errors[0] == 7
    bus.corrupt[0] = 100
    bus.submit(0, Frame(1, EIGHT), 0)
    told = [d.frame.id & NUMBER for d in passed(bus)]
    assert told[-1] == ERROR_BUS_OFF and not bus.submit(0, Frame(1, EIGHT), 0)
    bus.reset(0)
    assert bus.submit(0, Frame(1, EIGHT), 0)


def test_alone_on_the_wire_nobody_acknowledges() -> None:
    bus = Bus()
    bus.join(0)
    for _ in range(100):
        bus.submit(0, Frame(1, EIGHT), 0)
        passed(bus)
    assert 0 not in bus.off
    bus.submit(0, Frame(1, EIGHT), 0)
    assert [d.frame.id & ERROR_ACK for d in passed(bus)] == [ERROR_ACK]


def test_frames_survive_the_socket() -> None:
    for frame in (Frame(0x7FF, b"abc"), Frame(1, bytes(64), True, True), Frame(1 << 31 | 5, EIGHT)):
        assert unpack(pack(frame)) == frame
    with pytest.raises(ValueError, match="17 bytes"):
        unpack(bytes(17))


def test_seven_axes_on_can_fd_take_as_long_as_the_fact_sheet_says() -> None:
    line = Line(ARMS["openarm"].drives(False), Joints.arm(), Bus(1e6, 5e6))
    client = can.Bus(interface="asc-sim", channel="test", line=line)  # found by its entry point
    for i in range(7):
        client.send(
            can.Message(arbitration_id=1 + i, data=EIGHT, is_fd=True, bitrate_switch=True, is_extended_id=False)
        )
    answers = []
    while (message := client.recv(0.004)) is not None:
        answers.append(message)
    client.shutdown()
    assert [m.arbitration_id for m in answers] == [0x11 + i for i in range(7)]
    assert line.bus.busy_ns == pytest.approx(792_000, abs=1000) and answers[-1].timestamp < 0.0009


def test_a_drive_follows_a_set_point_and_holds_when_nobody_talks_to_it() -> None:
    line = Line(ARMS["openarm"].drives(False), Joints.arm(), Bus(1e6, 5e6))
    client = SimulatedBus("test", line=line)

    def say(data: bytes, seconds: float) -> None:
        client.send(command(1, data))
        while client.recv(seconds) is not None:
            pass

    client.send(can.Message(arbitration_id=0x7FF, data=bytes([1, 0, 0x55, 9, 200, 0, 0, 0]), is_extended_id=False))
    say(b"\xff" * 7 + b"\xfc", 0.004)
    p, kp, kd = round((0.5 / 12.5 + 1) / 2 * 65535), round(150 / 500 * 4095), 4095  # by hand: 0.5 rad
    point = (p << 48 | 0x800 << 36 | kp << 24 | kd << 12 | 0x800).to_bytes(8, "big")
    for _ in range(400):
        say(point, 0.004)
    assert line.mechanics.q[0] == pytest.approx(0.5, abs=2e-3) and np.all(line.mechanics.q[1:] == 0.0)
    client.recv(0.5)
    assert not line.drives[0].is_enabled
    assert line.mechanics.q[0] == pytest.approx(0.5, abs=5e-3) and abs(line.mechanics.dq[0]) < 1e-3
    client.shutdown()


@pytest.mark.parametrize(("target_deg", "held_deg"), [(20.0, 10.0), (-20.0, -10.0), (5.0, 5.0)])
def test_a_drive_goes_no_farther_than_its_position_limits(target_deg: float, held_deg: float) -> None:
    drive = Cia402Drive(1, Data(rated=87.0, kp=100.0, kd=0.0, limits_deg=(-10.0, 10.0)))
    drive.state = ENABLED
    drive._od[0x6060, 0], drive._od[0x607A, 0] = POSITION, round(target_deg / 360 * 131072 * 100)
    torque = drive.tick(0.0, 0.0, 1_000_000)
    assert torque == pytest.approx(100.0 * np.radians(held_deg), abs=1e-3)
