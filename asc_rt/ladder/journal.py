"""The journal of a cell's ladder: one line of JSON for each step that was run, appended, chained and signed.

Each line carries the SHA-256 of the line before it and a signature with the key that seals the cell's recordings: a
line that was changed, taken out or put in is found, and so is one that somebody else wrote.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from asc_rt.ladder.steps import Step

SIM, HARDWARE = "sim", "hardware"
PASS, FAIL = "PASS", "FAIL"
FILE = "journal.jsonl"

Entry = dict[str, Any]


class JournalError(Exception):
    """A journal that cannot be believed; the text says which line and what to do."""


class Journal:
    """`entries`: all lines so far, oldest first. JournalError: not what was written."""

    def __init__(self, folder: Path, key: Ed25519PrivateKey) -> None:
        self.path = folder / FILE
        self._key, self._last = key, ""
        self.entries: list[Entry] = []
        lines = self.path.read_bytes().splitlines() if self.path.exists() else []
        for number, line in enumerate(lines, 1):
            self.entries.append(self._read(line, number))
            self._last = hashlib.sha256(line).hexdigest()

    def add(self, entry: Entry) -> None:
        """Append and bring to the disk."""
        entry = {**entry, "n": len(self.entries) + 1, "previous": self._last}
        line = _canonical({**entry, "signature": self._key.sign(_canonical(entry)).hex()})
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("ab") as file:
            file.write(line + b"\n")
            file.flush()
            os.fsync(file.fileno())
        self.entries.append(json.loads(line))
        self._last = hashlib.sha256(line).hexdigest()

    def _read(self, line: bytes, number: int) -> Entry:
        try:
            entry: Entry = json.loads(line)
            signature = bytes.fromhex(entry["signature"])
            signed = {key: value for key, value in entry.items() if key != "signature"}
            self._public.verify(signature, _canonical(signed))
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise self._altered(number, "no entry") from error
        except InvalidSignature as error:
            raise self._altered(number, "not signed by this cell's log key") from error
        if (entry.get("n"), entry.get("previous")) != (number, self._last):
            raise self._altered(number, "a line before it is missing or was put in")
        return entry

    @property
    def _public(self) -> Ed25519PublicKey:
        return self._key.public_key()

    def _altered(self, number: int, what: str) -> JournalError:
        return JournalError(f"{self.path}:{number}: {what}; keep it as evidence and begin anew in another folder (-o)")


def refusal(entries: Sequence[Entry], step: Step, before: Step | None, mode: str, cell_hash: str) -> str | None:
    """Why `step` must not be run now, with what to do; None: it may. `before`: the step below it."""
    if before is not None and (why := not_passed(entries, before, mode, cell_hash)):
        return f"step {step.label}: step {before.label} comes first ({mode}): {why}"
    if mode == HARDWARE and (why := not_passed(entries, step, SIM, cell_hash)):
        return f"step {step.label}: not on the hardware before it passed in simulation: {why}; run it with --sim"
    return None


def not_passed(entries: Sequence[Entry], step: Step, mode: str, cell_hash: str) -> str:
    """Why the step does not count as passed; empty: when it was run last it passed, with this cell, as it is now."""
    last = newest(entries, step.number, mode)
    if last is None:
        return "it was not run yet"
    if last["verdict"] != PASS:
        return f"it failed at {last['time']}"
    if last["cell_hash"] != cell_hash:
        return f"it passed at {last['time']} with another cell hash, {last['cell_hash'][:12]}; now {cell_hash[:12]}"
    if last["step_sha256"] != step.digest:
        return f"what the step asks for has changed since it passed at {last['time']}"
    return ""


def newest(entries: Sequence[Entry], number: int, mode: str) -> Entry | None:
    return next((e for e in reversed(entries) if (e["step"], e["mode"]) == (number, mode)), None)


def _canonical(entry: Entry) -> bytes:
    return json.dumps(entry, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
