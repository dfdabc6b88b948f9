"""What every driver in the registry promises, tested against a peer in the same thread.

A new driver is one entry in `PEERS`: how to build it with a robot behind it, and how that robot falls silent.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from asc_rt.core.types import CommandKind, JointCommand, RobotFlag, StopReason, StopRequest, Vector, vector
from drivers import registry
from drivers.base import DriverError, HandshakeError, Pacing, RobotDriver, WireTap
from sim_hil.fanuc.arm import KinematicPlant
from sim_hil.fanuc.controller import Controller
from sim_hil.fanuc.controller_b import ControllerB
from sim_hil.fanuc.lockstep import Lockstep, RmiLine
from sim_hil.fanuc.rmi import RmiServer
from sim_hil.fanuc.settings import Settings

PERIOD_NS = 8_000_000


@dataclass
class Peer:
    driver: RobotDriver
    now_ns: Callable[[], int]
    silence: Callable[[], None]
    wait: Callable[[], None] = lambda: None  # until the next cycle of a robot that this PC paces
    resolution: float = 1e-6  # rad, of a position on the wire


def fanuc_j519(tap: WireTap | None) -> Peer:
    from drivers.fanuc_stream_motion.link import StreamMotion

    wire = Lockstep(Controller(KinematicPlant(np.zeros(6), PERIOD_NS * 1e-9)))
    driver = StreamMotion({"host": "127.0.0.1"}, tap, transport=wire)
    return Peer(driver, wire.now_ns, lambda: setattr(wire, "powered", False))


def fanuc_stream_motion_b(tap: WireTap | None) -> Peer:
    from drivers.fanuc_stream_motion.link_b import StreamMotionB

    controller = ControllerB(KinematicPlant(np.zeros(6), PERIOD_NS * 1e-9), Settings(start_move=2, arm="crx_10ia_l"))
    wire = Lockstep(controller)
    line = RmiLine(wire, RmiServer(controller, 16002))
    driver = StreamMotionB({"host": "127.0.0.1", "settle": 0.1}, tap, transport=wire, line=line)
    return Peer(driver, wire.now_ns, lambda: setattr(wire, "powered", False))


def can(tap: WireTap | None) -> Peer:
    from can_rig import Rig

    rig = Rig("openarm", tap, period_ms=PERIOD_NS * 1e-6)
    codes = 3.0 * rig.driver.resolution  # of position, speed and torque: each moves what the drive holds
    return Peer(rig.driver, rig.now_ns, rig.silence, rig.wait, codes)


def loopback(tap: WireTap | None) -> Peer:
    from drivers.loopback import Loopback

    driver = Loopback({}, tap)
    return Peer(driver, lambda: 0, lambda: setattr(driver, "_fault", "silence"))


PEERS: dict[str, Callable[[WireTap | None], Peer]] = {
    "can": can,
    "fanuc-j519": fanuc_j519,
    "fanuc-stream-motion-b": fanuc_stream_motion_b,
    "loopback": loopback,
}
OPTIONS: dict[str, dict[str, Any]] = {
    "can": {"interface": "asc-sim", "channel": "contract", "arm": "openarm"},
    "fanuc-j519": {"host": "127.0.0.1"},
    "fanuc-stream-motion-b": {"host": "127.0.0.1"},
    "loopback": {},
}


@pytest.fixture
def packets() -> list[tuple[str, int, bytes]]:
    return []


@pytest.fixture(params=sorted(registry.known()))
def peer(request: pytest.FixtureRequest, packets: list[tuple[str, int, bytes]]) -> Peer:
    return PEERS[request.param](lambda *packet: packets.append(packet))


def command(q: Vector, kind: CommandKind = CommandKind.POSITION, last: bool = False) -> JointCommand:
    zero = vector(np.zeros(len(q)))
    return JointCommand(0, kind, vector(q), zero, zero, last)


def deadline(peer: Peer) -> int:
    return peer.now_ns() + 3 * PERIOD_NS


@pytest.mark.parametrize("name", sorted(registry.known()))
def test_the_class_has_every_method_of_the_interface(name: str) -> None:
    for method, wanted in inspect.getmembers(RobotDriver, inspect.isfunction):
        if method != "__subclasshook__" and not method.startswith("_"):
            have = inspect.signature(getattr(registry.driver_class(name), method))
            assert list(have.parameters) == list(inspect.signature(wanted).parameters), method


@pytest.mark.parametrize("name", sorted(registry.known()))
def test_a_wrong_option_is_named(name: str) -> None:
    with pytest.raises(ValueError, match="no_such_option"):
        registry.driver_class(name)({**OPTIONS[name], "no_such_option": 1})


def test_a_session_holds_the_measured_pose(peer: Peer) -> None:
    caps = peer.driver.configure()
    assert caps.period_ns == PERIOD_NS and CommandKind.POSITION in caps.kinds and caps.identity
    joint = peer.driver.activate(PERIOD_NS)
    assert joint.q.shape == joint.dq.shape == joint.current.shape == (caps.dof,)
    assert RobotFlag.READY in joint.flags and RobotFlag.FAULTED not in joint.flags
    seed, seq = joint.q, joint.seq
    for _ in range(40):
        sample = peer.driver.read(deadline(peer))
        assert sample is not None and sample.seq > seq
        assert np.isfinite(sample.q).all() and not sample.q.flags.writeable
        np.testing.assert_allclose(sample.q, seed, atol=3 * peer.resolution)  # one code, and a creep within it
        receipt = peer.driver.write(command(seed))
        assert receipt.ok
        np.testing.assert_allclose(receipt.q, seed, atol=peer.resolution)
        seq = sample.seq
        peer.wait()
    assert peer.driver.write(command(seed)).ok is (caps.pacing is Pacing.HOST)  # a device asks once each sample


def test_a_robot_follows_and_the_next_sample_says_so(peer: Peer) -> None:
    peer.driver.configure()
    q = peer.driver.activate(PERIOD_NS).q
    goal = q + 0.01
    for k in range(100):
        sample = peer.driver.read(deadline(peer))
        assert sample is not None
        peer.driver.write(command(q + (goal - q) * min(1.0, k / 50)))
        peer.wait()
    last = peer.driver.read(deadline(peer))
    assert last is not None
    np.testing.assert_allclose(last.q, goal, atol=max(1e-4, 3 * peer.resolution))


def test_another_period_is_refused(peer: Peer) -> None:
    peer.driver.configure()
    with pytest.raises(HandshakeError) as caught:
        peer.driver.activate(PERIOD_NS // 2)
    assert caught.value.hint


def test_nothing_goes_without_a_session(peer: Peer) -> None:
    for leave in (lambda: None, peer.driver.configure, peer.driver.stop, peer.driver.close):
        leave()
        with pytest.raises(DriverError):
            peer.driver.read(deadline(peer))
        with pytest.raises(DriverError):
            peer.driver.write(command(np.zeros(6)))


def test_silence_is_none(peer: Peer) -> None:
    peer.driver.configure()
    q = peer.driver.activate(PERIOD_NS).q
    assert peer.driver.read(deadline(peer)) is not None
    peer.driver.write(command(q))
    peer.silence()
    assert peer.driver.read(deadline(peer)) is None


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_command_that_is_not_finite_never_leaves(peer: Peer, packets: list[Any], bad: float) -> None:
    peer.driver.configure()
    q = peer.driver.activate(PERIOD_NS).q.copy()
    q[2] = bad
    sent = [packet for packet in packets if packet[0] == "tx"]
    with pytest.raises(ValueError, match="finite"):
        peer.driver.write(command(q))
    assert [packet for packet in packets if packet[0] == "tx"] == sent


def test_only_the_kinds_it_names_are_taken(peer: Peer) -> None:
    kinds = peer.driver.configure().kinds
    q = peer.driver.activate(PERIOD_NS).q
    for kind in set(CommandKind) - kinds:
        with pytest.raises(ValueError, match="position"):
            peer.driver.write(command(q, kind))


def test_stop_and_close_are_idempotent_from_every_state(peer: Peer) -> None:
    request = StopRequest(StopReason.EXCEPTION)
    peer.driver.stop(request)
    peer.driver.configure()
    peer.driver.stop(request)
    peer.driver.activate(PERIOD_NS)
    for _ in range(2):
        peer.driver.stop(request)
    for _ in range(2):
        peer.driver.close()
    peer.driver.stop()
    peer.driver.configure()
    assert peer.driver.activate(PERIOD_NS) is not None


def test_stop_does_not_raise_when_the_robot_is_gone(peer: Peer) -> None:
    peer.driver.configure()
    q = peer.driver.activate(PERIOD_NS).q
    peer.driver.read(deadline(peer))
    peer.driver.write(command(q))
    peer.silence()
    peer.driver.stop(StopRequest(StopReason.ROBOT_SILENT))


def test_the_tap_sees_what_goes_and_comes(peer: Peer, packets: list[tuple[str, int, bytes]]) -> None:
    peer.driver.configure()
    q = peer.driver.activate(PERIOD_NS).q
    packets.clear()
    peer.driver.read(deadline(peer))
    peer.driver.write(command(q))
    directions = [direction for direction, _, data in packets if data]
    assert directions[-1] == "tx" and "rx" in directions
