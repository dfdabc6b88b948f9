from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from asc_rt.ladder.journal import FAIL, HARDWARE, PASS, SIM, Journal, JournalError, refusal
from asc_rt.ladder.steps import load_steps

KEY = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))
STEPS = load_steps()
CELL, OTHER = "a" * 64, "b" * 64


def entry(
    number: int, mode: str = SIM, verdict: str = PASS, cell: str = CELL, digest: str | None = None
) -> dict[str, Any]:
    step = STEPS[number - 1]
    return {
        "step": number, "mode": mode, "verdict": verdict, "cell_hash": cell, "time": f"2026-01-0{number}T00:00:00Z",
        "step_sha256": step.digest if digest is None else digest,
    }  # fmt: skip


def asked(entries: list[dict[str, Any]], number: int, mode: str = SIM) -> str | None:
    return refusal(entries, STEPS[number - 1], STEPS[number - 2] if number > 1 else None, mode, CELL)


# --- what may be run -------------------------------------------------------------------------------------------------


def test_the_first_step_in_simulation_may_always_be_run() -> None:
    assert asked([], 1) is None


def test_a_step_waits_for_the_one_before_it_in_the_same_mode() -> None:
    assert "step 1 link comes first (sim): it was not run yet" in str(asked([], 2))
    assert asked([entry(1)], 2) is None
    assert "comes first (hardware)" in str(asked([entry(1), entry(2)], 2, HARDWARE))


def test_a_failed_step_blocks_the_next_until_it_passes() -> None:
    assert "it failed at 2026-01-01" in str(asked([entry(1), entry(1, verdict=FAIL)], 2))
    assert asked([entry(1, verdict=FAIL), entry(1)], 2) is None


def test_the_hardware_waits_for_the_same_step_in_simulation() -> None:
    assert "not on the hardware before it passed in simulation" in str(asked([], 1, HARDWARE))
    assert asked([entry(1)], 1, HARDWARE) is None
    assert "it failed" in str(asked([entry(1, verdict=FAIL)], 1, HARDWARE))
    done = [entry(1), entry(1, HARDWARE)]
    assert "in simulation: it was not run" in str(asked(done, 2, HARDWARE))
    assert asked([*done, entry(2)], 2, HARDWARE) is None


def test_another_cell_is_another_ladder() -> None:
    assert "another cell hash, bbbbbbbbbbbb; now aaaaaaaaaaaa" in str(asked([entry(1, cell=OTHER)], 1, HARDWARE))
    assert "another cell hash" in str(asked([entry(1, cell=OTHER)], 2))


def test_a_step_that_asks_for_something_else_now_counts_as_not_passed() -> None:
    assert "has changed since" in str(asked([entry(1, digest="c" * 64)], 2))


# --- the file --------------------------------------------------------------------------------------------------------


@pytest.fixture
def journal(tmp_path: Path) -> Journal:
    journal = Journal(tmp_path, KEY)
    for number in (1, 2, 3):
        journal.add(entry(number))
    return journal


def test_what_was_added_is_read_again(journal: Journal) -> None:
    again = Journal(journal.path.parent, KEY)
    assert again.entries == journal.entries and [e["n"] for e in again.entries] == [1, 2, 3]
    again.add(entry(4))
    assert len(Journal(journal.path.parent, KEY).entries) == 4


def changed(lines: list[bytes]) -> list[bytes]:
    return [lines[0].replace(b"PASS", b"FAIL"), *lines[1:]]


def resigned(lines: list[bytes]) -> list[bytes]:
    """As somebody with another key would."""
    made = json.loads(lines[0])
    made.pop("signature")
    other = Ed25519PrivateKey.from_private_bytes(bytes(32))
    text = json.dumps(made, sort_keys=True, separators=(",", ":"))
    return [json.dumps({**made, "signature": other.sign(text.encode()).hex()}).encode(), *lines[1:]]


@pytest.mark.parametrize(
    ("tamper", "line", "says"),
    [
        (changed, 1, "not signed"),
        (resigned, 1, "not signed"),
        (lambda lines: [lines[0], lines[2]], 2, "missing or was put in"),
        (lambda lines: lines[1:], 1, "missing or was put in"),
        (lambda lines: [lines[0], lines[0], *lines[1:]], 2, "missing or was put in"),
        (lambda lines: [lines[0], b"{", lines[2]], 2, "no entry"),
        (lambda lines: [lines[0], b"[]", lines[2]], 2, "no entry"),
        (lambda lines: [b"{}", *lines], 1, "no entry"),
    ],
)
def test_a_journal_that_was_changed_is_not_believed(journal: Journal, tamper, line: int, says: str) -> None:
    lines = tamper(journal.path.read_bytes().splitlines())
    journal.path.write_bytes(b"".join(text + b"\n" for text in lines))
    with pytest.raises(JournalError, match=f"journal.jsonl:{line}: .*{says}"):
        Journal(journal.path.parent, KEY)
