"""The UDP transport on loopback: who may talk to us, and who may open the robot."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.base import LinkError, OwnershipError
from drivers.fanuc_stream_motion.link import StreamMotion
from drivers.fanuc_stream_motion.transport import UdpTransport


@pytest.fixture
def robot() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as robot:
        robot.bind(("127.0.0.1", 0))
        robot.settimeout(10.0)
        yield robot


@pytest.fixture
def link(robot: socket.socket, tmp_path: Path) -> Iterator[UdpTransport]:
    link = UdpTransport("localhost", robot.getsockname()[1], str(tmp_path))
    link.open()
    yield link
    link.close()


def soon(link: UdpTransport) -> int:
    return link.now_ns() + 10_000_000_000


def test_datagrams_go_both_ways_with_their_times(link: UdpTransport, robot: socket.socket) -> None:
    before = link.now_ns()
    t_tx = link.send(b"hello")
    data, pc = robot.recvfrom(100)
    assert data == b"hello" and pc[0] == "127.0.0.1"
    robot.sendto(b"answer", pc)
    packet = link.receive(soon(link))
    assert packet is not None and packet[1] == b"answer"
    assert before <= t_tx <= packet[0] <= link.now_ns()


def test_other_peers_are_counted_and_skipped(link: UdpTransport, robot: socket.socket) -> None:
    link.send(b"hello")
    pc = robot.recvfrom(100)[1]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        for _ in range(3):
            stranger.sendto(b"junk", pc)
    robot.sendto(b"answer", pc)
    packet = link.receive(soon(link))
    assert packet is not None and packet[1] == b"answer"
    assert link.foreign == 3


def test_after_the_deadline_only_what_is_already_here_comes(link: UdpTransport, robot: socket.socket) -> None:
    link.send(b"hello")
    pc = robot.recvfrom(100)[1]
    for data in (b"1", b"2"):
        robot.sendto(data, pc)
    assert [packet[1] for packet in (link.receive(0), link.receive(0)) if packet] == [b"1", b"2"]
    assert link.receive(0) is None


def test_an_absent_robot_is_silence(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as gone:
        gone.bind(("127.0.0.1", 0))
        port = gone.getsockname()[1]
    link = UdpTransport("127.0.0.1", port, str(tmp_path))
    link.open()
    for _ in range(3):
        link.send(b"anyone there?")
        assert link.receive(link.now_ns() + 1_000_000) is None
    link.close()


def test_one_robot_has_one_controller(robot: socket.socket, tmp_path: Path) -> None:
    port = robot.getsockname()[1]
    first = UdpTransport("localhost", port, str(tmp_path))
    first.open()
    second = StreamMotion({"host": "127.0.0.1", "port": port, "lock_dir": str(tmp_path)})
    with pytest.raises(OwnershipError) as caught:
        second.configure()
    assert caught.value.pid == os.getpid()
    robot.setblocking(False)
    with pytest.raises(BlockingIOError):
        robot.recvfrom(100)  # the second one has sent nothing
    first.close()
    with pytest.raises(LinkError, match="no answer"):
        second.configure()
    third = UdpTransport("127.0.0.1", port, str(tmp_path))
    third.open()  # a failed configure() keeps nothing
    third.close()


def test_a_host_that_does_not_exist_is_a_link_error(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def unknown(host: str) -> str:
        raise socket.gaierror(-2, "Name or service not known")

    monkeypatch.setattr(socket, "gethostbyname", unknown)
    with pytest.raises(LinkError, match="no way to robot") as caught:
        UdpTransport("robot", 60015, str(tmp_path)).open()
    assert "address" in caught.value.hint


def test_a_closed_link_says_so(tmp_path: Path) -> None:
    link = UdpTransport("127.0.0.1", 60015, str(tmp_path))
    link.close()
    for use in (lambda: link.send(b""), lambda: link.receive(0)):
        with pytest.raises(LinkError, match="closed"):
            use()
