"""One session as it was recorded: mostly one file; after a rotation several, read one after the other as if they were
one.

    recording = open_recording("runs/x.mcap")       # and x.part2.mcap, x.part3.mcap ... where they are beside it

What belongs to the session (parameters, attachments, who and where) is the first file's; how it ended is the last
one's. Each part names the SHA-256 of the one before it, so that none can be taken out or exchanged unseen.
"""

from __future__ import annotations

import bisect
import hashlib
import itertools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from logs.mcap_scan import CorruptLog
from logs.reader import Log, LogMessage, Progress, Records, Visitor, open_log
from logs.session_files import manifest_path, part_path


class Recording:
    """Reads like a `Log`. `parts`: its files in order."""

    def __init__(self, parts: tuple[Log, ...]) -> None:
        self.parts = parts
        self.path, self.params, self.layout = parts[0].path, parts[0].params, parts[0].layout
        self.session, self.fingerprint = parts[0].session, parts[0].fingerprint
        self.attachments = {name: data for part in reversed(parts) for name, data in part.attachments.items()}
        self._first = list(itertools.accumulate((part.cycles for part in parts), initial=0))
        self.cycles = self._first.pop()

    @property
    def truncated(self) -> bool:
        """A file was not closed: it holds all its complete records."""
        return any(part.truncated for part in self.parts)

    @property
    def end(self) -> dict[str, str]:
        """What the logger wrote when it closed the last file; empty: it did not."""
        return self.parts[-1].end

    @property
    def chunks_with_cycles(self) -> int:
        """As many as `batches` gives."""
        return sum(part.chunks_with_cycles for part in self.parts)

    @property
    def sha256(self) -> str:
        """Of every byte of all files, in order."""
        sha = hashlib.sha256()
        for part in self.parts:
            sha.update(memoryview(part.data))
        return sha.hexdigest()

    def around(self, t_ns: int, span_ns: int) -> Recording:
        """The recording as if it held only the cycles up to `span_ns` before and after monotonic `t_ns`."""
        offset = self.layout.dtype.fields["inputs.t_ns"][1]  # type: ignore[index]
        ends = (t_ns - span_ns, t_ns + span_ns)
        first, stop = (
            bisect.bisect_left(
                range(self.cycles), end, key=lambda i: int.from_bytes(self.record(i)[offset : offset + 8], "little")
            )
            for end in ends
        )
        near = ((part, before) for part, before in zip(self.parts, self._first, strict=True))
        kept = [part.excerpt(first - before, stop - before) for part, before in near]
        return Recording(tuple(part for part in kept if part.cycles))

    @property
    def topics(self) -> frozenset[str]:
        return frozenset().union(*(part.topics for part in self.parts))

    def record(self, index: int) -> bytes:
        """The bytes of cycle record `index`, counted from 0 over all files."""
        if not 0 <= index < self.cycles:
            raise IndexError(index)
        number = bisect.bisect_right(self._first, index) - 1
        return self.parts[number].record(index - self._first[number])

    def batches(self) -> Iterator[Records]:
        """All cycle records in order, as structured arrays."""
        return itertools.chain.from_iterable(part.batches() for part in self.parts)

    def columns(self, *paths: str) -> dict[str, np.ndarray[Any, Any]]:
        """Some fields of all cycles: path -> one array."""
        found = [part.columns(*paths) for part in self.parts]
        return {path: np.concatenate([columns[path] for columns in found]) for path in paths}

    def messages(self, *topics: str) -> Iterator[LogMessage]:
        """The messages of some topics, in the order of the files."""
        return itertools.chain.from_iterable(part.messages(*topics) for part in self.parts)


def open_recording(path: str | Path, visit: Visitor | None = None, progress: Progress = iter) -> Recording:
    """Map and check every file of the session that begins with `path`; a later part alone is read alone.

    `visit` meets the messages on the way, see `reader.Visitor`; `progress` goes over the megabytes of each file.

    LogError: not readable, foreign, damaged; CorruptLog also: a part is missing, or is not of this session.
    """
    parts = [open_log(path, visit, progress)]
    if parts[0].session.get("part", "1") == "1":
        place = Path(path).resolve()  # the other files are beside the file itself, not beside a link to it
        while (following := part_path(place, len(parts) + 1)).exists():
            parts.append(_continued(open_log(following, visit, progress), parts))
        if (manifest := manifest_path(place)).is_file():
            _check_manifest(manifest, parts, place.name)
    return Recording(tuple(parts))


def _continued(part: Log, before: list[Log]) -> Log:
    """`part`, if it is what followed the last of `before`."""
    told = part.session
    if told.get("recording") != before[0].seals.session:
        raise CorruptLog(f"{part.path}: is no part of the session in {before[0].path.name}")
    if told.get("previous_sha256") != hashlib.sha256(memoryview(before[-1].data)).hexdigest():
        raise CorruptLog(f"{before[-1].path}: altered: {part.path.name} names another SHA-256 of it")
    return part


def _check_manifest(manifest: Path, parts: list[Log], first: str) -> None:
    try:
        named = [str(entry["file"]) for entry in json.loads(manifest.read_text())["parts"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CorruptLog(f"{manifest}: damaged: no list of parts") from error
    there = {first, *(part.path.name for part in parts)}
    if missing := [name for name in named if name not in there]:
        raise CorruptLog(f"{parts[0].path}: incomplete: {', '.join(missing)} of {manifest.name} are not beside it")
