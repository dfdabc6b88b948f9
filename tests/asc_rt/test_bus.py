"""Who may speak on the bus: this machine on loopback, other machines by certificate, each name by its keys."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from asc_rt import bus_keys, clock_sync, topics
from asc_rt.bus import Bus, BusError, Keys, Latest, Remote, open_client, open_router
from asc_rt.human_codec import clock_id
from tests import other_machine as other
from tests.other_machine import HERE
from tests.ports import free_port

pytestmark = pytest.mark.real_time

AHEAD_S = 5_000  # of the other machine's clock
SENSOR = "side"


def heard(box: Latest, seconds: float = 5.0) -> bytes | None:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if (data := box.take()) is not None:
            return data
        time.sleep(0.01)
    return None


@pytest.fixture(scope="module")
def other_machine() -> Iterator[str]:
    with other.made() as name:
        yield name


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("keys")
    bus_keys.make(folder, HERE, [SENSOR, "stranger"])
    return folder


@pytest.fixture
def cell(other_machine: str, keys: Path) -> Iterator[tuple[Bus, str, str]]:
    """(a local process's bus, the local endpoint, the endpoint for others) of a running cell."""
    local, remote = f"tcp/127.0.0.1:{free_port()}", f"tls/{HERE}:{free_port(HERE)}"
    rights = {SENSOR: topics.rights(SENSOR)}
    with open_router(local, Remote(remote, Keys.of(keys, bus_keys.CELL), rights)) as router:
        router.answer(topics.CLOCK.key, clock_sync.answer)
        with open_client(local) as client:
            yield client, local, remote


PEER = """
import json, sys, time
from pathlib import Path
from asc_rt import clock_sync
from asc_rt.bus import BusError, Keys, open_client
endpoint, folder, name, timeout = sys.argv[1:5]
keys = Keys.of(Path(folder), name) if name else None
try:
    bus = open_client(endpoint, float(timeout), keys)
except BusError as error:
    print(json.dumps({"refused": str(error)}), flush=True)
    sys.exit(3)
clock = clock_sync.CellClock(bus)
publishers = {key: bus.publisher(key) for key in sys.argv[5:]}
ears = {key: bus.latest(key) for key in ("cell/human/*", "cell/operator", "cell/**")}
for number in range(1, 16):
    for key, publisher in publishers.items():
        publisher.put_json({"id": number, "kind": "ARM"})
    time.sleep(0.1)
    if clock.convert(time.monotonic_ns()) is not None and number > 5:
        break
t_ns = time.monotonic_ns()
print(json.dumps({"t_ns": t_ns, "cell": clock.convert(t_ns), "id": clock.id,
                  "heard": [key for key, ear in ears.items() if ear.take() is not None]}), flush=True)
"""


def there(
    machine: str, endpoint: str, keys: Path, name: str, *says: str, timeout: float = 5.0, ahead_s: int = 0
) -> subprocess.Popen[str]:
    """A process of another machine that says the same at each key; its clock is ahead of ours."""
    command = [sys.executable, "-c", PEER, endpoint, str(keys), name, str(timeout), *says]
    return subprocess.Popen([*other.there(machine, ahead_s), *command], stdout=subprocess.PIPE, text=True)


def told(process: subprocess.Popen[str]) -> dict[str, object]:
    out, _ = process.communicate(timeout=60)
    found: dict[str, object] = json.loads(out.strip().splitlines()[-1])
    return found


def test_a_certified_sensor_says_whom_it_sees_and_nothing_else(
    cell: tuple[Bus, str, str], other_machine: str, keys: Path
) -> None:
    """Not the STOP and not the ARM of an operator, no goal, no other sensor's people, no truth."""
    client, _, remote = cell
    own = client.latest(topics.human(SENSOR).key)
    others = {
        key: client.latest(key)
        for key in ("cell/human/person", topics.OPERATOR.key, topics.GOAL.key, topics.CONTROL.key, "sim/truth")
    }
    told(there(other_machine, remote, keys, SENSOR, topics.human(SENSOR).key, *others))
    assert heard(own) is not None
    assert {key: box.take() for key, box in others.items()} == dict.fromkeys(others)


def test_a_certified_sensor_hears_nothing_of_the_cell(
    cell: tuple[Bus, str, str], other_machine: str, keys: Path
) -> None:
    client, _, remote = cell
    process = there(other_machine, remote, keys, SENSOR)
    publishers = [client.publisher(key) for key in (topics.human("person").key, topics.OPERATOR.key)]
    while process.poll() is None:
        for publisher in publishers:
            publisher.put(b"secret")
        time.sleep(0.02)
    assert told(process)["heard"] == []


def test_a_certificate_without_rights_says_nothing(cell: tuple[Bus, str, str], other_machine: str, keys: Path) -> None:
    client, _, remote = cell
    box = client.latest("cell/**")
    said = told(there(other_machine, remote, keys, "stranger", topics.human(SENSOR).key, topics.OPERATOR.key))
    assert "refused" not in said and said["cell"] is None
    assert box.take() is None


@pytest.mark.parametrize("who", ["of another authority", "without a certificate"])
def test_a_stranger_does_not_get_in(cell: tuple[Bus, str, str], other_machine: str, tmp_path: Path, who: str) -> None:
    client, _, remote = cell
    box = client.latest("cell/**")
    bus_keys.make(tmp_path, HERE, [SENSOR])
    name = SENSOR if who == "of another authority" else ""
    said = told(there(other_machine, remote, tmp_path, name, topics.human(SENSOR).key, timeout=1.0))
    assert "refused" in said
    assert box.take() is None


def test_the_loopback_endpoint_is_not_there_for_other_machines(
    cell: tuple[Bus, str, str], other_machine: str, keys: Path
) -> None:
    _, local, _ = cell
    port = local.rpartition(":")[2]
    assert "refused" in told(there(other_machine, f"tcp/{HERE}:{port}", keys, "", timeout=1.0))


def test_the_other_machine_knows_our_clock_within_its_bounds(
    cell: tuple[Bus, str, str], other_machine: str, keys: Path
) -> None:
    """Its monotonic clock is 5000 s ahead; both are the same oscillator here, so that the truth is known."""
    _, _, remote = cell
    with contextlib.suppress(FileNotFoundError):
        if subprocess.run(["unshare", "--time", "true"], capture_output=True).returncode != 0:
            pytest.skip("time namespaces cannot be made here")
    said = told(there(other_machine, remote, keys, SENSOR, ahead_s=AHEAD_S))
    stamp, sigma = said["cell"]  # type: ignore[misc]
    assert said["id"] == clock_id()
    assert abs(stamp - (said["t_ns"] - AHEAD_S * 1_000_000_000)) <= sigma  # type: ignore[operator]
    assert sigma < 1_000_000_000


def test_on_our_own_machine_stamps_are_left_alone() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with open_router(endpoint) as router, open_client(endpoint) as client:
        clock = clock_sync.CellClock(client)
        assert clock.convert(123) is None
        router.answer(topics.CLOCK.key, clock_sync.answer)
        deadline = time.monotonic() + 20.0
        while clock.convert(123) is None and time.monotonic() < deadline:
            time.sleep(0.05)
        assert clock.convert(123) == (123, 0) and clock.id == clock_id()
        clock.close()


def test_nobody_is_found_without_an_address(keys: Path) -> None:
    """No scouting: a router that runs is not found by one who does not know where."""
    with open_router(f"tcp/127.0.0.1:{free_port()}"), pytest.raises(BusError):
        open_client(f"tcp/127.0.0.1:{free_port()}", timeout_s=0.5)
    with pytest.raises(FileExistsError):
        bus_keys.make(keys, HERE, [SENSOR])
