"""The Remote Motion Interface: the rules of its server, and the whole ROS 2 wire over real sockets as a process."""

from __future__ import annotations

import json
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asc_rt.config import CELLS
from drivers.base import LinkError
from drivers.fanuc_stream_motion.link_b import StreamMotionB
from drivers.fanuc_stream_motion.rmi import Rmi, TcpLine
from sim_hil.fanuc.arm import KinematicPlant
from sim_hil.fanuc.controller_b import ControllerB
from sim_hil.fanuc.rmi import RmiServer
from sim_hil.fanuc.settings import Settings

START = np.radians([10.0, 20.0, -10.0, 40.0, -50.0, 60.0])


@pytest.fixture
def rmi() -> RmiServer:
    return RmiServer(ControllerB(KinematicPlant(START, 0.008), Settings(arm="crx_10ia_l")), 16002)


def ask(rmi: RmiServer, kind: str, name: str, **fields: Any) -> dict[str, Any]:
    (reply,) = rmi.handle(json.dumps({kind: name, **fields}).encode())
    return dict(json.loads(reply))


def test_a_session_is_sent_to_another_port(rmi: RmiServer) -> None:
    assert ask(rmi, "Communication", "FRC_Connect_STMO")["PortNumber"] == 16002


def test_a_program_runs_only_after_initialise_and_with_the_next_number(rmi: RmiServer) -> None:
    call = {"ProgramName": "STREAM_MOTN"}
    assert ask(rmi, "Instruction", "FRC_Call", SequenceID=1, **call)["ErrorID"] == 2556943
    assert ask(rmi, "Command", "FRC_Initialize", GroupMask=1)["ErrorID"] == 0
    stale = json.dumps({"Instruction": "FRC_Call", "SequenceID": 1, **call}).encode()
    assert rmi.handle(stale) == []  # dropped without a word
    assert ask(rmi, "Command", "FRC_GetStatus")["NextSequenceID"] == 2
    assert ask(rmi, "Instruction", "FRC_Call", SequenceID=2, ProgramName="OTHER")["ErrorID"] == 2556934
    assert ask(rmi, "Instruction", "FRC_Call", SequenceID=3, **call)["ErrorID"] == 0
    assert ask(rmi, "Command", "FRC_GetStatus")["ProgramStatus"] == 0
    assert ask(rmi, "Command", "FRC_Initialize")["ErrorID"] == 2556943
    assert ask(rmi, "Command", "FRC_Abort")["ErrorID"] == 0
    assert ask(rmi, "Command", "FRC_GetStatus")["ProgramStatus"] == 2


def test_joints_are_the_pendants_on_this_channel(rmi: RmiServer) -> None:
    angles = ask(rmi, "Command", "FRC_ReadJointAngles")["JointAngle"]
    assert [angles[f"J{i}"] for i in range(1, 7)] == [10.0, 20.0, -30.0, 40.0, -50.0, 60.0]
    assert set(ask(rmi, "Command", "FRC_ReadCartesianPosition")["Position"]) >= {"X", "W"}


def test_alarms_are_told_newest_first(rmi: RmiServer) -> None:
    assert "ErrorData" not in ask(rmi, "Command", "FRC_ReadError", Count=5)
    rmi.controller.press_emergency_stop()
    told = ask(rmi, "Command", "FRC_ReadError", Count=5)
    assert told["ErrorData"].startswith("SRVO-289") and told["ErrorData2"].startswith("SRVO-002")
    assert ask(rmi, "Command", "FRC_Initialize")["ErrorID"] == 2556955


@pytest.mark.parametrize("line", [b"", b"{", b"[]", b"7", b"{}", b'{"Command": "FRC_Dance"}', b"\xff\xfe"])
def test_a_line_that_is_no_request_is_an_error_reply(rmi: RmiServer, line: bytes) -> None:
    (reply,) = rmi.handle(line)
    assert json.loads(reply)["ErrorID"] == 2556941


# --- over sockets ----------------------------------------------------------------------------------------------------


def free_port(kind: socket.SocketKind, count: int = 1) -> int:
    while True:
        with socket.socket(socket.AF_INET, kind) as first, socket.socket(socket.AF_INET, kind) as second:
            first.bind(("127.0.0.1", 0))
            port = int(first.getsockname()[1])
            try:
                if count > 1:
                    second.bind(("127.0.0.1", port + 1))
            except OSError:
                continue
            return port


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[tuple[int, int, subprocess.Popen[str]]]:
    udp, tcp = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_STREAM, 2)
    text = (CELLS / "crx-sim.toml").read_text()
    text = re.sub(r"(?m)^port = \d+", f"port = {udp}", text)
    text = re.sub(r"(?m)^rmi_port = \d+", f"rmi_port = {tcp}", text)
    text = text.replace("[sim.fanuc]\n", '[sim.fanuc]\nfaults = [{at_s = 600, fault = "emergency_stop"}]\n')
    cell = tmp_path / "cell.toml"
    cell.write_text(text)
    process = subprocess.Popen(
        [sys.executable, "-m", "sim_hil", "fanuc", str(cell), "--plant", "kinematic", "--strict"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout is not None and process.stdout.readline().startswith(f"ready fanuc 127.0.0.1:{udp}")
    yield udp, tcp, process
    process.kill()
    process.communicate()


@pytest.mark.real_time
def test_a_session_over_udp_and_tcp(robot: tuple[int, int, subprocess.Popen[str]], tmp_path: Path) -> None:
    udp, tcp, process = robot
    options = {"host": "127.0.0.1", "port": udp, "rmi_port": tcp, "settle": 0.1, "limits": True, "arm": "crx_10ia_l"}
    driver = StreamMotionB({**options, "lock_dir": str(tmp_path)})
    limits = driver.configure().limits
    assert limits is not None and np.degrees(limits.ddq_max[0]) == pytest.approx(265 * 0.98, rel=1e-5)
    joint = driver.activate(8_000_000)
    np.testing.assert_allclose(joint.q, np.radians([0, -15, 0, 0, -90, 0]), atol=1e-6)
    second = Rmi(TcpLine("127.0.0.1"), tcp)
    second.connect()  # let in, sent on ...
    with pytest.raises(LinkError, match="does not answer"):
        second.status()  # ... and left alone
    second.close()
    driver.close()
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    assert "0 offences, alarms: none" in out


def test_a_robot_without_rmi_is_a_link_error(tmp_path: Path) -> None:
    driver = StreamMotionB({"host": "127.0.0.1", "rmi_port": free_port(socket.SOCK_STREAM), "lock_dir": str(tmp_path)})
    with pytest.raises(LinkError, match="no RMI connection") as caught:
        driver.configure()
    assert "R912" in caught.value.hint
