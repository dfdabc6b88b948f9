"""The rules of the audit about the files themselves: who recorded, sealed, signed and closed them, and is all there?"""

from __future__ import annotations

import hashlib
from collections.abc import Callable

import numpy as np

from logs import seal
from logs.audit_evidence import Evidence
from logs.audit_finding import Finding, skip
from logs.reader import Log
from logs.summary import dropped


def identity(e: Evidence) -> Finding:
    """The attachments that the session began with are there, unaltered."""
    return _each_part(e, "identity", _part_identity)


def _part_identity(part: Log) -> Finding:
    told, files = part.session, part.attachments
    promised = {key.removeprefix("sha256 "): value for key, value in told.items() if key.startswith("sha256 ")}
    wrong = [name for name, value in promised.items() if hashlib.sha256(files.get(name, b"")).hexdigest() != value]
    who = ", ".join(f"{key} {told.get(key, 'unknown')}" for key in ("cell", "git_commit", "operator", "started"))
    later = f", later {', '.join(sorted(files.keys() - promised))}" if files.keys() - promised else ""
    detail = f"{who}, {len(files)} attachments{later}"
    return Finding("identity", not wrong, f"altered or missing: {', '.join(wrong)}" if wrong else detail)


def seals(e: Evidence) -> Finding:
    """Seals hold (the reader has checked each), reach to the end, and are of a key that the auditor trusts."""
    return _each_part(e, "seals", lambda part: _part_seals(e, part))


def _part_seals(e: Evidence, part: Log) -> Finding:
    s, name = part.seals, "seals"
    if not s.public_key:
        return Finding(name, False, "the session was not sealed: nothing shows that it is unaltered")
    if not s.count:
        return Finding(name, False, "the session should be sealed, and has no seal")
    whole, key = part.extent.data_bytes, seal.key_id(s.public_key)
    detail = f"{s.count} seals hold, to byte {s.sealed_bytes} of {whole}, key {key}"
    if e.trusted is None:
        return Finding(name, True, f"{detail}; whose key it is was not said (--public-key)")
    if seal.raw_hex(e.trusted) != s.public_key:
        return Finding(name, False, f"signed with {key}, which is not {e.trusted_name} (--public-key)")
    rest = "" if s.final else f"; the last {whole - s.sealed_bytes} bytes are not sealed"
    return Finding(name, True, f"{detail}, as {e.trusted_name}{rest}")


def _each_part(e: Evidence, name: str, judge: Callable[[Log], Finding]) -> Finding:
    """The verdict on a session of several files: each must hold, and each is named."""
    found = [judge(part) for part in e.log.parts]
    if len(found) == 1:
        return found[0]
    detail = "; ".join(f"part {i}: {finding.detail}" for i, finding in enumerate(found, 1))
    holds, skipped = all(finding.holds for finding in found), all(finding.skipped for finding in found)
    return Finding(name, holds, detail, skipped)


def signature(e: Evidence) -> Finding:
    """The detached signature, if there is one, is of this file as it is."""
    return _each_part(e, "signature", _part_signature)


def _part_signature(part: Log) -> Finding:
    holds = seal.check_file(part.path, part.seals.public_key) if part.seals.public_key else None
    if holds is None:
        return skip("signature", f"there is no {seal.signature_path(part.path).name}")
    return Finding("signature", holds, "over every byte" if holds else "does not belong to this file")


def closed(e: Evidence) -> Finding:
    """The file was closed by the logger, or afterwards by `asc recover`."""
    return _each_part(e, "closed", _part_closed)


def _part_closed(part: Log) -> Finding:
    if part.truncated:
        left = len(part.data) - part.extent.complete_bytes
        return Finding("closed", False, f"not closed, {left} bytes behind the last whole record; run asc recover")
    if part.recovered:
        told = part.recovered
        added = f", {told['cycles_from_ring']} cycles from the ring" if told["cycles_from_ring"] != "0" else ""
        return Finding("closed", True, f"recovered, {told['bytes_cut']} bytes cut{added}")
    return Finding("closed", True, f"by the logger: {part.end.get('reason', 'unknown')}")


def records(e: Evidence) -> Finding:
    """Every cycle record's own checksum is right."""
    detail = "every record's checksum is right" if not e.broken_records else f"{e.broken_records} records were altered"
    return Finding("records", e.broken_records == 0, detail)


def completeness(e: Evidence) -> Finding:
    """Ticks increase by one from the first cycle to the last, and nothing was dropped."""
    step = np.diff(e.c["inputs.tick"])
    gaps, twice = np.flatnonzero(step > 1), np.flatnonzero(step < 1)
    lost = dropped(e.log, e.c["inputs.tick"])
    e.notes["gaps"] = [[int(e.c["inputs.tick"][i]), int(step[i]) - 1] for i in gaps[:100]]
    if not len(gaps) and not len(twice) and not lost:
        return Finding("completeness", True, f"{e.cycles} cycles, none missing")
    first = f", first at {e.at(int(np.append(gaps, twice).min()))}" if len(gaps) + len(twice) else ""
    detail = f"{lost} cycles missing in {len(gaps)} gaps, {len(twice)} out of order{first}"
    return Finding("completeness", False, detail)
