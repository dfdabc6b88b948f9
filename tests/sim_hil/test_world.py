from __future__ import annotations

import dataclasses
import json
import math
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asc_rt import human_state_pb2 as pb
from asc_rt import topics
from asc_rt.bus import Bus, BusError, Latest, open_client, open_router
from asc_rt.core.params import Params
from sim_hil import human
from sim_hil.human import HumanOptions, HumanSource, Rhythm, body, clock_id, publish
from sim_hil.person import Capsules, Person
from sim_hil.plant import MujocoPlant
from sim_hil.world import LONGEST_EXTRAPOLATION, World, decode, extrapolate
from tests.ports import free_port

ROOT = Path(__file__).parents[2]
READY = np.radians([0, 20, 0, 0, -80, 0])


@dataclass
class Cell:
    params: Params
    bus_endpoint: str


@pytest.fixture
def endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture
def router(endpoint: str) -> Iterator[Bus]:
    with open_router(endpoint) as bus:
        yield bus


def wait_for(mail: Latest, wanted: Callable[[bytes], bool] = lambda _: True, say: Any = lambda: None) -> bytes:
    """The first wanted message; `say` is called again and again because a new subscriber misses what came before."""
    for _ in range(2000):
        say()
        data = mail.take()
        if data is not None and wanted(data):
            return data
        time.sleep(0.005)
    raise AssertionError("nothing arrived")


# --- what the person's process says ----------------------------------------------------------------------------------


def test_a_message_is_the_person_and_comes_back_whole() -> None:
    source = HumanSource(HumanOptions(seed=4), start_ns=1_000)
    t_ns, person = decode(source.truth(5_000_001_000)) or pytest.fail("not decoded")
    expected = Person(4).at(5.0)
    assert t_ns == 5_000_001_000
    assert person.labels == expected.labels
    for got, sent in zip(person[1:], expected[1:], strict=True):
        assert np.array_equal(got, sent)


def test_sensed_is_late_bounded_healthy_and_counted() -> None:
    options = HumanOptions(seed=4, latency_ms=25.0, position_bound_m=0.03, velocity_bound_m_s=0.4)
    source = HumanSource(options, start_ns=0)
    source.truth(1)
    first, second = (pb.HumanState.FromString(source.sensed(t) or b"") for t in (6_000_000_000, 6_016_000_000))
    assert (first.seq, second.seq) == (1, 2)
    assert first.t_publish_ns - first.t_capture_ns == 25_000_000
    assert first.session_uuid == second.session_uuid != ""
    assert first.clock_id == clock_id()
    assert first.method == pb.METHOD_SIMULATED and not first.safety_rated
    assert first.health == pb.HEALTH_OK and first.empty_certified and first.coverage == 1.0
    assert (first.schema_version, first.frame_id, first.calibration_hash) == (1, "robot_base", b"")
    capsules = first.bodies[0].capsules
    assert {(c.position_bound, c.velocity_bound) for c in capsules} == {(0.03, 0.4)}
    assert np.array([c.p1 for c in capsules]) == pytest.approx(Person(4).at(5.975).p1, abs=1e-12)


@pytest.mark.parametrize(
    ("table", "word"),
    [
        ({"sed": 1}, "sim.human.sed"),
        ({"seed": 1.5}, "integer"),
        ({"seed": True}, "integer"),
        ({"rate_hz": 0.5}, "1..1000"),
        ({"latency_ms": -1}, "sim.human.latency_ms"),
        ({"start_s": math.nan}, "sim.human.start_s"),
        ({"position_bound_m": "2 cm"}, "sim.human.position_bound_m"),
    ],
)
def test_wrong_options_are_named(table: dict[str, Any], word: str) -> None:
    with pytest.raises(ValueError, match=word):
        HumanOptions.of(table)


def test_every_wrong_option_at_once() -> None:
    with pytest.raises(ValueError) as caught:
        HumanOptions.of({"sed": 1, "latency_ms": -1, "rate_hz": 0.5})
    assert len(str(caught.value).splitlines()) == 3


def test_right_options() -> None:
    assert HumanOptions.of({"seed": 3, "rate_hz": 30}) == HumanOptions(seed=3, rate_hz=30)


@given(period=st.integers(1, 50), waits=st.lists(st.integers(0, 200), max_size=30))
def test_rhythm_skips_and_never_bursts(period: int, waits: list[int]) -> None:
    rhythm, now, taken = Rhythm(1000, period), 1000, []
    for wait in waits:
        now += wait
        due = rhythm.take(now)
        if due is not None:
            assert (due - 1000) % period == 0, "absolute: no drift"
            assert now - period < due <= now, "the newest one"
            taken.append(due)
        assert rhythm.take(now) is None, "each deadline once"
    assert taken == sorted(set(taken))


@pytest.mark.real_time
def test_the_process_publishes_until_it_is_told_to_stop(router: Bus, endpoint: str) -> None:
    sensed, truth, ready = (router.latest(t.key) for t in (topics.HUMAN, topics.PERSON_TRUTH, topics.ready("human")))
    stop: list[int] = []
    with open_client(endpoint) as client:
        process = threading.Thread(target=publish, args=(client, HumanOptions(), stop))
        process.start()
        try:
            first = pb.HumanState.FromString(wait_for(sensed))
            later = pb.HumanState.FromString(wait_for(sensed))
            exact = decode(wait_for(truth))
            assert json.loads(wait_for(ready))["device"] == "human"
        finally:
            stop.append(1)
            process.join(timeout=10)
    assert not process.is_alive()
    assert first.seq < later.seq and first.t_capture_ns < later.t_capture_ns
    assert exact is not None and len(exact[1].labels) == 10


@pytest.mark.real_time
def test_the_command_says_ready_and_ends_on_sigterm(router: Bus, endpoint: str) -> None:
    command = [sys.executable, "-m", "sim_hil", "human", "fanuc-sim-truth", "--set", f"bus.endpoint={endpoint}"]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("ready human")
        wait_for(router.latest(topics.human("person").key))
        process.terminate()
        _, errors = process.communicate(timeout=30)
    finally:
        process.kill()
    assert (process.returncode, errors) == (0, "")


@pytest.mark.parametrize("bad", [["--set", "sim.human.sed=1"], ["--set", "safety.d_min_m=-1"], ["--sed", "1"]])
def test_bad_input_is_one_line_and_exit_code_2(bad: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    try:
        code = human.main("fanuc-sim-truth", bad)
    except SystemExit as exit:  # argparse
        code = exit.code if isinstance(exit.code, int) else -1
    assert code == 2
    assert "Traceback" not in (errors := capsys.readouterr().err)
    assert bad[-1].split("=")[0].split(".")[-1] in errors


def test_without_a_bus_it_says_so(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def nobody(endpoint: str) -> Bus:
        raise BusError(f"nobody listens on bus.endpoint {endpoint}", "start it with `asc run`")

    monkeypatch.setattr(human, "open_client", nobody)
    monkeypatch.setattr("signal.signal", lambda *_: None)
    assert human.main("fanuc-sim-truth", []) == 1
    assert capsys.readouterr().err.count("\n") == 1


# --- the world -------------------------------------------------------------------------------------------------------


def test_extrapolation_moves_each_end_and_ends_soon() -> None:
    person = Person(2).at(5.0)
    moved = extrapolate(person, 0.01)
    assert moved.p0 == pytest.approx(person.p0 + 0.01 * person.v0)
    assert moved.p1 == pytest.approx(person.p1 + 0.01 * person.v1)
    assert np.array_equal(extrapolate(person, 9.0).p1, extrapolate(person, LONGEST_EXTRAPOLATION).p1)
    assert np.array_equal(extrapolate(person, -1.0).p1, person.p1), "a stamp in the future does not turn time back"


def message(**capsule: Any) -> bytes:
    whole = {"label": "x", "p0": [0, 0, 0], "p1": [0, 0, 0], "radius": 0.1, "v0": [0, 0, 0], "v1": [0, 0, 0]} | capsule
    return pb.HumanState(t_capture_ns=1, bodies=[pb.Body(capsules=[pb.Capsule(**whole)])]).SerializeToString()


@pytest.mark.parametrize(
    "data",
    [
        b"\xff\xff\xff",
        message(p0=[0.0, 0.0]),
        message(v1=[0.0] * 4),
        message(radius=math.nan),
        message(p1=[0.0, math.inf, 0.0]),
        pb.HumanState(
            bodies=[pb.Body(capsules=[pb.Capsule(p0=[0] * 3, p1=[0] * 3, v0=[0] * 3, v1=[0] * 3)] * 21)]
        ).SerializeToString(),
    ],
    ids=["no protobuf", "two coordinates", "four coordinates", "NaN", "infinite", "too many"],
)
def test_what_cannot_be_shown_is_not_decoded(data: bytes) -> None:
    assert decode(data) is None
    assert decode(message()) is not None


def test_the_world_shows_the_person_and_tells_the_truth(
    router: Bus, endpoint: str, arm_params: Callable[[str], Params]
) -> None:
    world = World(Cell(arm_params("drill"), endpoint), "fanuc", READY)
    mail, person_publisher = router.latest(topics.PLANT_TRUTH.key), router.publisher(topics.PERSON_TRUTH.key)
    try:
        alone = json.loads(wait_for(mail, say=lambda: (world.step(), world.publish(42))))
        assert alone["t_ns"] == 42 and alone["distance_m"] is None and alone["contact"] is False
        assert alone["q"] == pytest.approx(READY.tolist(), abs=1e-6) and len(alone["dq"]) == 6

        at = np.array([[0.45, 0.0, 0.45]])  # where the drill is
        still = Capsules(("left_hand",), at, at, np.array([0.1]), np.zeros((1, 3)), np.zeros((1, 3)))
        hit = pb.HumanState(t_capture_ns=time.monotonic_ns(), bodies=[body(still, 0.0, 0.0)]).SerializeToString()

        def period(data: bytes = hit, t_ns: int = 43) -> None:
            person_publisher.put(data)
            world.set_target(READY)
            world.step()
            world.publish(t_ns)

        touched = json.loads(wait_for(mail, lambda data: json.loads(data)["distance_m"] is not None, period))
        assert touched["contact"] is True and touched["distance_m"] < 0
        assert touched["person_part"] == "left_hand" and touched["robot_part"]
        assert np.isfinite(touched["approach_m_s"])
        assert world.q.shape == world.dq.shape == (6,)

        for t_ns in range(100, 120):  # a foreign message does not make the person vanish
            after = json.loads(
                wait_for(
                    mail,
                    lambda data, t_ns=t_ns: json.loads(data)["t_ns"] == t_ns,
                    lambda t_ns=t_ns: period(b"\xff\xff\xff", t_ns),
                )
            )
            assert after["person_part"] == "left_hand"
    finally:
        world.close()


def test_in_short_periods_the_truth_is_told_as_often_as_its_topic_says_and_no_contact_is_lost(
    router: Bus, endpoint: str, arm_params: Callable[[str], Params], monkeypatch: pytest.MonkeyPatch
) -> None:
    params = dataclasses.replace(arm_params("drill"), period_ns=2_000_000)
    world = World(Cell(params, endpoint), "fanuc", READY)
    told: list[dict[str, Any]] = []
    monkeypatch.setattr(world, "_truth", SimpleNamespace(put_json=told.append))
    monkeypatch.setattr(MujocoPlant, "contacts", property(lambda _: ("one",) if world._periods in (2, 12) else ()))
    try:
        for t_ns in range(12):
            world.set_target(READY)
            world.step()
            world.publish(t_ns)
    finally:
        world.close()
    assert [(truth["t_ns"], truth["contact"]) for truth in told] == [(3, True), (7, False), (11, True)]
