"""What the ROS 2 wire can be asked for: how many commands are buffered, and forces."""

from __future__ import annotations

import numpy as np
import pytest
from fanuc_rig import B, Rig

from drivers.base import HandshakeError
from drivers.fanuc_stream_motion import codec_b
from drivers.fanuc_stream_motion.link_b import StreamMotionB
from sim_hil.fanuc import wire_b
from sim_hil.fanuc.controller_b import ControllerB


@pytest.mark.parametrize("commands", [0, 6, 9])
def test_the_robot_buffers_as_many_commands_as_the_cell_wants(commands: int) -> None:
    rig = Rig(B, {"start_move": commands})
    rig.begin()
    rig.moving = True
    before = rig.plant.q
    cycles = 0
    while np.abs(rig.plant.q - before).max() < 1e-7:
        rig.run(1)
        cycles += 1
    plain = Rig(B, {"start_move": 0})
    plain.begin()
    plain.moving = True
    while np.abs(plain.plant.q - before).max() < 1e-7:
        plain.run(1)
        cycles -= 1
    assert cycles == commands
    assert rig.offences == []


def test_a_robot_that_keeps_its_own_number_is_refused() -> None:
    rig = Rig(B, {"start_move": 6})
    rig.line.to_pc = lambda data: [data[:16] + b"\0\0\0\2" + data[20:] if data[3] == 8 else data]
    with pytest.raises(HandshakeError, match="start_move = 6"):
        rig.driver.configure()


@pytest.mark.parametrize("sensor", ["embedded", "external"])
def test_forces_arrive(sensor: str) -> None:
    rig = Rig(B, {"force_sensor": sensor}, version=4)
    assert isinstance(rig.robot, ControllerB) and isinstance(rig.driver, StreamMotionB)
    rig.begin()
    rig.robot.force[:] = [1, -2, 3, 0.5, 0, -0.25]
    rig.run(2)
    assert rig.driver.force is not None
    np.testing.assert_array_equal(rig.driver.force, [1, -2, 3, 0.5, 0, -0.25])
    assert rig.alarms == []


def test_without_a_sensor_there_is_no_force_and_no_number_that_looks_like_one() -> None:
    rig = Rig(B, version=4)
    assert isinstance(rig.robot, ControllerB) and isinstance(rig.driver, StreamMotionB)
    assert rig.driver.force is None
    rig.begin()
    rig.robot.force[:] = 1.0
    rig.run(2)
    assert rig.driver.force is None
    absent = wire_b.write_reply("status_force", 4, force=[1, 2, 3], force_sensor=0xFFFFFFFF)
    told = codec_b.decode(absent, 4)
    assert told.force is None  # type: ignore[union-attr]


def test_version_3_is_never_asked_for_forces() -> None:
    """It would take the packet for a system error, HOST-380."""
    rig = Rig(B, {"force_sensor": "embedded"})
    with pytest.raises(HandshakeError, match="version 3, which has no force data"):
        rig.driver.configure()
    assert rig.alarms == []


def test_golden_bytes() -> None:
    assert codec_b.encode_force_sensor(4, "external").hex(" ", 4) == "000000cd 00000004 00000000 00000002"
    data = codec_b.encode_start_move(3, 5)
    assert data.hex(" ", 4) == "00000008 00000003 00000001 00000000 00000005 00000000 00000000"
