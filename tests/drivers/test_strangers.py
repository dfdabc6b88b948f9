"""Clients and controllers of other people: each side follows the documented wire, not the other.

The strangers here know neither our codec nor the simulated robot's (`stranger_wire`), and keep habits that were seen in
other people's programs: numbers from a prefill, a status bit that is always set, replies longer than need be.
"""

from __future__ import annotations

import json
import math
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
import stranger_wire as w

from asc_rt.core.types import CommandKind, JointCommand, vector
from drivers.fanuc_stream_motion.link import StreamMotion
from drivers.fanuc_stream_motion.link_b import StreamMotionB
from sim_hil.fanuc.arm import KinematicPlant
from sim_hil.fanuc.cabinet import Cabinet
from sim_hil.fanuc.controller import Controller
from sim_hil.fanuc.controller_b import ControllerB
from sim_hil.fanuc.faults import FaultyController
from sim_hil.fanuc.rmi_sockets import RmiSockets
from sim_hil.fanuc.server import serve
from sim_hil.fanuc.settings import Settings

pytestmark = pytest.mark.real_time

T = 0.008
HOME = [30.0, 20.0, -10.0, 40.0, -50.0, 60.0]  # URDF; on the classic wire J3 is -30
PENDANT_HOME = [30.0, 20.0, -30.0, 40.0, -50.0, 60.0]
TURN = 6.0  # deg that J1 turns


def way(seconds: float = 1.6, angle: float = TURN) -> list[float]:
    """From rest to rest: 10 s^3 - 15 s^4 + 6 s^5."""
    share = np.linspace(0, 1, round(seconds / T) + 1)
    return (angle * share**3 * (10 - 15 * share + 6 * share**2)).tolist()


# --- their client, our simulated robot -------------------------------------------------------------------------------


@contextmanager
def robot(ros: bool = False, home: Any = HOME, **settings: Any) -> Iterator[tuple[Cabinet, tuple[str, int], int]]:
    """A simulated robot on UDP; (it, where, RMI port)."""
    plant = KinematicPlant(np.radians(home), T)
    controller: Cabinet
    rmi_port, sockets = 0, None

    def poll() -> None:
        if sockets is not None:
            sockets.poll()

    if ros:
        controller = ros_controller = ControllerB(plant, Settings(arm="crx_10ia_l", limits=True, **settings))
        rmi_port = free_pair()
        sockets = RmiSockets(ros_controller, "127.0.0.1", rmi_port)
    else:
        controller = Controller(plant, Settings(limits=True, **{"capacity": 10, "start_move": 9, **settings}))
    stop: list[int] = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.bind(("127.0.0.1", 0))
        link.setblocking(False)
        thread = threading.Thread(target=serve, args=(link, FaultyController(controller), (poll, None), stop))
        thread.start()
        try:
            yield controller, link.getsockname(), rmi_port
        finally:
            stop.append(1)
            thread.join()
            if sockets is not None:
                sockets.close()


def free_pair() -> int:
    """A TCP port, the one after it free as well."""
    while True:
        with socket.socket() as one, socket.socket() as two:
            one.bind(("127.0.0.1", 0))
            port = int(one.getsockname()[1])
            try:
                two.bind(("127.0.0.1", port + 1))
            except OSError:
                continue
            return port


class Client:
    """Of the classic wire. Like the manufacturer's sample: one thread, blocking receive."""

    def __init__(self, where: tuple[str, int], version: int) -> None:
        self.version = version
        self.where = where
        self.link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.link.settimeout(30.0)

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.link.close()

    def say(self, record: w.Record) -> None:
        self.link.sendto(bytes(record), self.where)

    def hear(self, kind: type[w.Record]) -> Any:
        while True:
            data = self.link.recv(2048)
            if len(data) == w.SIZES[kind]:
                return kind.of(data)

    def command(self, seq: int, axes: list[float], last: bool = False, style: int = 1, **more: int) -> None:
        single = self.version == 1 or style == 0
        record = w.Single(1, self.version) if single else w.Double(5, self.version)
        if not single:
            record.unused[:] = [0xFFFF, 0x3333, 0x3333]
        record.seq, record.last, record.style = seq % 2**32, last, style
        record.axes[: len(axes)] = axes
        for name, value in more.items():
            setattr(record, name, value)
        self.say(record)

    def follow(self, points: list[list[float]], ahead: int = 0, style: int = 1) -> None:
        """One command for each status, the last one at rest; then wait until the program is past IBGN end."""
        for point in points:
            self.command(self.hear(w.Status).seq + ahead, point, style=style)
        self.command(self.hear(w.Status).seq + ahead, points[-1], last=True, style=style)
        while self.hear(w.Status).status & 1:
            pass
        self.say(w.Head(2, self.version))


def clean(controller: Cabinet) -> None:
    assert [str(offence.rule) for offence in controller.offences] == []
    assert controller.alarms == []


@pytest.mark.parametrize("version", [1, 2, 3])
def test_their_client_moves_our_robot(version: int) -> None:
    with robot() as (controller, where, _), Client(where, version) as pc:
        pc.say(w.Head(0, version))
        first = pc.hear(w.Status)
        assert (first.seq, first.version, first.status & 5) == (1, version, 5)
        np.testing.assert_allclose(list(first.joints)[:6], PENDANT_HOME, atol=1e-4)
        pc.follow([[PENDANT_HOME[0] + turn, *PENDANT_HOME[1:]] for turn in way()])
        clean(controller)
        np.testing.assert_allclose(np.degrees(controller._plant.q), [HOME[0] + TURN, *HOME[1:]], atol=2e-3)


def test_their_client_asks_version_and_tables_and_reads_and_writes_signals() -> None:
    """Start, then the version request, both with version 3; the tables after it."""
    with robot(version=2, tool=5) as (controller, where, _), Client(where, 2) as pc:
        pc.say(w.Head(6, 3))
        assert pc.hear(w.Head).version == 2
        pc.say(w.Head(0, 2))
        for kind, limit in ((0, 450), (1, 500), (2, 4000)):
            pc.say(w.ThresholdRequest(3, 2, 1, kind))
            reply = pc.hear(w.ThresholdReply)
            assert (reply.axis, reply.kind, reply.vmax, reply.full[19]) == (1, kind, 4000, limit)
        pc.say(w.Head(4, 2))
        np.testing.assert_allclose(list(pc.hear(w.Commanded).joints)[:6], PENDANT_HOME, atol=1e-4)
        read = {"r_type": 8, "r_index": 1, "r_mask": 0x3F}
        for _ in range(12):
            pc.command(pc.hear(w.Status).seq, PENDANT_HOME, **read)
        for _ in range(3):
            pc.command(pc.hear(w.Status).seq, PENDANT_HOME, w_type=9, w_index=1, w_mask=1, w_value=1, **read)
        told = pc.hear(w.Status)
        assert (told.io_type, told.io_index, told.io_mask, told.io_value) == (8, 1, 0x3F, 0)  # the changer let go
        pc.command(told.seq, PENDANT_HOME, last=True)
        clean(controller)


def test_a_prefill_numbered_from_the_first_status_is_consecutive() -> None:
    """n copies of the present position numbered 0 to n - 1, then each status' number + n - 1."""
    with robot() as (controller, where, _), Client(where, 3) as pc:
        pc.say(w.Head(0, 3))
        assert pc.hear(w.Status).seq == 1
        for number in range(3):
            pc.command(number, PENDANT_HOME)
        pc.command(3, PENDANT_HOME)  # for the first status
        pc.follow([[PENDANT_HOME[0] + turn, *PENDANT_HOME[1:]] for turn in way()], ahead=2)
        clean(controller)


@pytest.mark.parametrize("lenient", [True, False])
def test_a_prefill_in_a_later_session_jumps_and_needs_a_lenient_robot(lenient: bool) -> None:
    with robot(lenient=lenient) as (controller, where, _), Client(where, 3) as pc:
        pc.say(w.Head(0, 3))
        while pc.hear(w.Status).seq < 20:
            pass
        for number in range(3):
            pc.command(number, PENDANT_HOME)
        if lenient:
            pc.follow([[PENDANT_HOME[0] + turn, *PENDANT_HOME[1:]] for turn in way()], ahead=2)
            clean(controller)
            return
        pc.command(pc.hear(w.Status).seq + 2, PENDANT_HOME)
        while pc.hear(w.Status).status & 1:
            pass
        assert controller.alarms[0].number == "MOTN-601"


def test_their_client_sends_poses() -> None:
    """A straight line of the face plate, 40 mm along x; the arm keeps its configuration."""
    with robot() as (controller, where, _), Client(where, 3) as pc:
        pc.say(w.Head(0, 3))
        pose = list(pc.hear(w.Status).pose)
        np.testing.assert_allclose(pose[:6], [445.3873, 211.6582, 106.5416, 159.1520, 27.4119, 108.5336], atol=1e-3)
        pc.follow([[pose[0] - x, *pose[1:6]] for x in way(2.4, 40.0)], style=0)
        clean(controller)
        there = controller.arm.pose(controller._plant.q)
        np.testing.assert_allclose(there[:6], [pose[0] - 40, *pose[1:6]], atol=1e-2)


def test_a_pose_out_of_reach_is_an_alarm() -> None:
    with robot() as (controller, where, _), Client(where, 3) as pc:
        pc.say(w.Head(0, 3))
        pose = list(pc.hear(w.Status).pose)
        pc.command(pc.hear(w.Status).seq, [pose[0] + 2000, *pose[1:6]], style=0)
        while pc.hear(w.Status).status & 1:
            pass
        assert controller.alarms[0].number == "MOTN-018"


@pytest.mark.parametrize("until", [-1.0, 3.0])
def test_poses_that_turn_the_wrist_over_are_an_alarm(until: float) -> None:
    """J5 from -3 deg on: beyond 0 the same line needs the other configuration of the wrist."""
    with robot(home=(0.0, 10.0, 10.0, 0.0, -3.0, 0.0)) as (controller, where, _), Client(where, 3) as pc:
        pc.say(w.Head(0, 3))
        q = controller._plant.q.copy()
        turned = [np.append(q[:4], [np.radians(-3.0 + a), q[5]]) for a in way(0.6, 3.0 + until)]
        pc.follow([list(controller.arm.pose(q)[:6]) for q in turned], style=0)
        assert [alarm.number for alarm in controller.alarms][:1] == ([] if until < 0 else ["MOTN-156"])


def test_joints_and_poses_in_one_session_are_an_alarm() -> None:
    with robot() as (controller, where, _), Client(where, 3) as pc:
        pc.say(w.Head(0, 3))
        pose = list(pc.hear(w.Status).pose)
        pc.command(pc.hear(w.Status).seq, PENDANT_HOME)
        pc.command(pc.hear(w.Status).seq, pose[:6], style=0)
        while pc.hear(w.Status).status & 1:
            pass
        assert controller.alarms[0].number == "MOTN-720" and "joints and poses" in controller.alarms[0].text


class RmiLink:
    """JSON lines over TCP: ask at the door, talk at the port that it names."""

    def __init__(self, port: int) -> None:
        door = socket.create_connection(("127.0.0.1", port), 30.0)
        door.sendall(b'{"Communication": "FRC_Connect_STMO"}\r\n')
        room = json.loads(self._line(door))["PortNumber"]
        door.close()
        self.link = socket.create_connection(("127.0.0.1", room), 30.0)

    def ask(self, kind: str, name: str, **more: object) -> dict[str, Any]:
        self.link.sendall(json.dumps({kind: name, **more}).encode() + b"\r\n")
        reply: dict[str, Any] = json.loads(self._line(self.link))
        assert reply["ErrorID"] == 0, reply
        return reply

    @staticmethod
    def _line(link: socket.socket) -> bytes:
        data = b""
        while not data.endswith(b"\r\n"):
            data += link.recv(1000)
        return data


def test_their_client_moves_our_robot_on_the_ros_wire() -> None:
    with robot(ros=True, start_move=2, tool=9) as (controller, where, rmi_port), Client(where, 3) as pc:
        rmi = RmiLink(rmi_port)
        pc.say(w.Head(2, 3))
        pc.say(w.Capability(7, 3, 1, 0, 0, 0, 0))
        told = pc.hear(w.Capability)
        assert (told.sampling, told.start_move, told.available) == (8, 2, 3)
        pc.say(w.ThresholdRequest(3, 3, 1, 2))
        assert pc.hear(w.ThresholdReply).full[19] == 1240
        gpio = w.Gpio(203, 3)
        gpio.slots[0] = w.Slot(2, 3, 3, 4)  # state of RI[3] to RI[6]
        pc.say(gpio)
        assert pc.hear(w.GpioResult).result == 0
        status = rmi.ask("Command", "FRC_GetStatus")
        rmi.ask("Command", "FRC_Abort")
        rmi.ask("Command", "FRC_Reset")
        rmi.ask("Command", "FRC_Initialize", GroupMask=1)
        rmi.ask("Instruction", "FRC_Call", SequenceID=status["NextSequenceID"], ProgramName="STREAM_MOTN")
        j3 = rmi.ask("Command", "FRC_ReadJointAngles")["JointAngle"]["J3"]
        pc.say(w.Head(200, 3))
        while not (state := pc.hear(w.RosStatus)).status & 1:
            pass
        assert state.io[0] == 9
        assert abs(j3 - (state.joints[2] - state.joints[1])) < 2e-3  # RMI tells the pendant's J3, the stream URDF's
        for k, turn in enumerate([0.0] * 10 + way(3.0)):
            state = pc.hear(w.RosStatus)
            record = w.RosCommand(201, 3, state.seq, 0, k >= 5, 0xFFFF)  # at first signals only, no motion
            record.axes[:6] = [HOME[0] + turn, *HOME[1:]]
            pc.say(record)
        record.seq, record.last = pc.hear(w.RosStatus).seq, 1
        pc.say(record)
        deadline = time.monotonic() + 30
        while pc.hear(w.RosStatus).status & 8 and time.monotonic() < deadline:
            pass
        rmi.ask("Command", "FRC_Abort")
        pc.say(w.Head(2, 3))
        clean(controller)
        assert isinstance(controller, ControllerB) and controller.over_limit == 0 == controller.silent_stops
        np.testing.assert_allclose(np.degrees(controller._plant.q), [HOME[0] + TURN, *HOME[1:]], atol=1e-2)


# --- our driver, their controller ------------------------------------------------------------------------------------


class Emulator(threading.Thread):
    """A controller that takes positions as soon as it is asked. `wrong`: what it holds against the PC.

    It says that a command was received whether one was or not, and its version reply is longer than its header.
    """

    ROS = False

    def __init__(self, version: int, first: int = 1) -> None:
        super().__init__(daemon=True)
        self.version, self.first = version, first
        self.link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.link.bind(("127.0.0.1", 0))
        self.wrong: list[str] = []
        self.axes = list(PENDANT_HOME)
        self.sent: list[int] = []
        self.finished = self.ended = False
        self._peer: Any = None
        self._seq = 0

    @property
    def port(self) -> int:
        return int(self.link.getsockname()[1])

    def run(self) -> None:
        due = time.monotonic() + T
        while not self.ended:
            self.link.settimeout(max(1e-4, due - time.monotonic()))
            try:
                data, peer = self.link.recvfrom(2048)
            except (TimeoutError, BlockingIOError):
                data, peer = b"", None
            if data:
                self._take(data, peer)
            if time.monotonic() >= due:
                due += T
                if self._peer is not None:
                    self.link.sendto(bytes(self._status()), self._peer)
                    self._seq = (self._seq + 1) % 2**32
        self.link.close()

    def _take(self, data: bytes, peer: Any) -> None:
        head = w.Head.of(data[:8])
        match head.type, len(data):
            case 0, 8:
                self._peer, self._seq = peer, self.first
            case 2, 8:
                self._peer = None
            case 3, 16:
                asked = w.ThresholdRequest.of(data)
                self.link.sendto(bytes(self._table(asked)), peer)
            case 6, 8:
                self.link.sendto(bytes(w.Head(6, self.version)) + bytes(4), peer)
            case (1, 64) | (5, 104):
                self._command(w.Single.of(data) if head.type == 1 else w.Double.of(data), head)
            case _:
                self.wrong.append(f"type {head.type}, {len(data)} bytes")

    def _table(self, asked: Any) -> w.Record:
        reply = w.ThresholdReply(3, asked.version, asked.axis, asked.kind, 4000, 8)
        reply.empty[:] = reply.full[:] = [(300, 600, 5000)[asked.kind]] * 20
        return reply

    def _command(self, command: Any, head: Any) -> None:
        if self.sent and command.seq != (self.sent[-1] + 1) % 2**32:
            self.wrong.append(f"number {command.seq} after {self.sent[-1]}")
        if command.style != 1 or head.version != self.version or (head.type == 1) != (self.version == 1):
            self.wrong.append(f"style {command.style}, type {head.type}, version {head.version}")
        if not self.sent and max(abs(a - b) for a, b in zip(command.axes, self.axes, strict=False)) > 0.01:
            self.wrong.append("the first position is not where the arm is")
        self.sent.append(command.seq)
        self.axes = list(command.axes)[:6]
        self.finished |= bool(command.last)

    def _status(self) -> w.Record:
        bits = 2 | 4 | (0 if self.finished else 1)
        record = w.Status(0, self.version, self._seq, bits, 0, 0, 0, 0, int(time.monotonic() * 500) * 2 % 2**32)
        record.joints[:6] = self.axes
        return record


class RosEmulator(Emulator):
    def __init__(self) -> None:
        super().__init__(3)
        self.axes = list(HOME)
        self.port_tcp = free_pair()
        self.called = False
        for port in (self.port_tcp, self.port_tcp + 1):
            threading.Thread(
                target=self._answer, args=(socket.create_server(("127.0.0.1", port)),), daemon=True
            ).start()

    def _answer(self, door: socket.socket) -> None:
        """One client after the other."""
        while not self.ended:
            link, _ = door.accept()
            lines = link.makefile("rb")
            for line in lines:
                request = json.loads(line)
                kind = next(key for key in ("Communication", "Command", "Instruction") if key in request)
                reply = {kind: request[kind], "ErrorID": 0}
                match request[kind]:
                    case "FRC_Connect_STMO":
                        reply |= {"PortNumber": self.port_tcp + 1, "MajorVersion": 1, "MinorVersion": 0}
                    case "FRC_GetStatus":
                        reply |= {"ServoReady": 1, "TPMode": 0, "RMIMotionStatus": 0, "ProgramStatus": 2}
                        reply |= {"SingleStepMode": 0, "NextSequenceID": 7, "Override": 100}
                    case "FRC_Call":
                        self.called = request["SequenceID"] == 7 and request["ProgramName"] == "STREAM_MOTN"
                        continue  # nobody answers to this one
                    case "FRC_Abort":
                        self.called = False
                link.sendall(json.dumps(reply).encode() + b"\r\n")

    def _take(self, data: bytes, peer: Any) -> None:
        head = w.Head.of(data[:8])
        match head.type, len(data):
            case 200, 8:
                self.wrong += [] if self.called else ["Start before the call"]
                self._peer, self._seq = peer, self.first
            case 2, 8:
                self._peer = None
            case 3, 16:
                self.link.sendto(bytes(self._table(w.ThresholdRequest.of(data))), peer)
            case 7, 28:
                self.link.sendto(bytes(w.Capability(7, 3, 1, 8, 2, 3, 0)), peer)
            case 203, 520:
                self.link.sendto(bytes(w.GpioResult(203, 0, 1)), peer)
            case 201, 344:
                command = w.RosCommand.of(data)
                command_word, motion = command.word, command.motion
                if (command_word, motion) != (0xFFFF, 1):
                    self.wrong.append(f"word {command_word:#x}, motion {motion}")
                if self.sent and command.seq != self.sent[-1] + 1:
                    self.wrong.append(f"number {command.seq} after {self.sent[-1]}")
                self.sent.append(command.seq)
                self.axes = list(command.axes)[:6]
                self.finished |= bool(command.last)
            case _:
                self.wrong.append(f"type {head.type}, {len(data)} bytes")

    def _status(self) -> w.Record:
        record = w.RosStatus(202, 3, self._seq, 5 if self.called else 4)
        record.joints[:6] = self.axes
        record.scale = 1.0
        record.io[0] = 11  # signals 1, 2 and 4 of the window
        return record


def drive(driver: StreamMotion | StreamMotionB, emulator: Emulator) -> None:
    """A session of ours: hold, move, end at rest."""
    zero = vector(np.zeros(6))
    driver.configure()
    joint = driver.activate(8_000_000)
    np.testing.assert_allclose(np.degrees(joint.q), HOME, atol=1e-4)
    points = [0.0] * 10 + way()
    for k, turn in enumerate(points):
        while driver.read(time.monotonic_ns() + 2_000_000_000) is None:
            raise AssertionError("silence")
        q = vector(np.radians([HOME[0] + turn, *HOME[1:]]))
        assert driver.write(JointCommand(k, CommandKind.POSITION, q, zero, zero, k == len(points) - 1)).ok
    driver.close()
    emulator.ended = True
    emulator.join(30)
    assert emulator.wrong == [] and emulator.finished
    assert math.isclose(emulator.axes[0], HOME[0] + TURN, abs_tol=1e-4)
    assert len(emulator.sent) == len(points)


@pytest.mark.parametrize(("version", "first"), [(1, 1), (2, 1), (3, 1), (3, 2**32 - 100)])
def test_our_driver_moves_their_robot(version: int, first: int, tmp_path: Any) -> None:
    emulator = Emulator(version, first)
    emulator.start()
    options = {"host": "127.0.0.1", "port": emulator.port, "version": version, "lock_dir": str(tmp_path)}
    drive(StreamMotion(options), emulator)


def test_our_driver_reads_their_tables(tmp_path: Any) -> None:
    emulator = Emulator(3)
    emulator.start()
    options = {"host": "127.0.0.1", "port": emulator.port, "arm": "lrmate_200id", "limits": True}
    driver = StreamMotion({**options, "lock_dir": str(tmp_path)})
    limits = driver.configure().limits
    assert limits is not None
    np.testing.assert_allclose(np.degrees(limits.ddq_max), 0.98 * np.array([600, 300, 300, 600, 600, 600]), rtol=1e-6)
    driver.close()
    emulator.ended = True
    emulator.join(30)


def test_our_driver_moves_their_robot_on_the_ros_wire(tmp_path: Any) -> None:
    emulator = RosEmulator()
    emulator.start()
    options = {"host": "127.0.0.1", "port": emulator.port, "rmi_port": emulator.port_tcp, "lock_dir": str(tmp_path)}
    driver = StreamMotionB({**options, "settle": 0.1, "tool_input": "DI[1:4]"})
    drive(driver, emulator)
    assert driver._joint is not None and driver._joint.tool_id == 11
