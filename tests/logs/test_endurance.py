"""Hours of recording in minutes: the real logger, fed as fast as it takes, with time that passes as told."""

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asc_rt import ring
from logs import schema
from logs.audit import audit
from logs.context import attachments, session
from logs.display import Display
from logs.reader import open_log
from logs.session_files import SessionFiles
from logs.writer import FLUSH_NS, Logger

TICKS = ("inputs.tick", "state.tick", "outputs.command.tick")
STAMPS = (
    "inputs.t_ns", "inputs.joint.t_rx_ns", "inputs.human.t_capture_ns", "receipt.t_tx_ns", "timings.t_wake_ns",
    "timings.t_read_ns", "timings.t_step_end_ns", "timings.t_write_end_ns",
)  # fmt: skip


class Feed:
    """A recorded minute or so, again and again, each time later."""

    def __init__(self, recording: Any, cycles: list[Any], period_ns: int) -> None:
        """`period_ns`: the pace of the loop; the recorded stamps are moved to it."""
        packed = b"".join(recording.packed(cycles))
        self.records = np.frombuffer(bytearray(packed), recording.layout.dtype)
        self.span_ns = len(self.records) * period_ns
        for path in STAMPS:
            self.records[path] -= np.arange(len(self.records)) * (recording.params.period_ns - period_ns)

    def later(self, turn: int) -> list[bytes]:
        block = self.records.copy()
        for path in TICKS:
            block[path] += turn * len(block)
        for path in STAMPS:
            block[path] += turn * self.span_ns
        return [row.tobytes() for row in block]


def endure(recording: Any, core_session: tuple[Path, list[Any]], folder: Path, period_ns: int, seconds: float) -> float:
    """Record so long; the share of a core that the logger took. The log is `folder / log.mcap`."""
    feed, now = Feed(recording, core_session[1], period_ns), [0]
    ring.create(folder / "ring", recording.layout.size, 2000)
    ring.create(ring.wire_path(folder / "ring"), 600, 4000)
    display = Display(recording.params, recording.layout)
    used = 0.0
    with (
        ring.RingWriter(folder / "ring") as cycles,
        ring.RingWriter(ring.wire_path(folder / "ring")) as wire,
        ring.RingReader(folder / "ring") as reader,
        ring.RingReader(ring.wire_path(folder / "ring")) as wire_reader,
    ):
        tap = ring.wire_tap(wire)
        files = SessionFiles(
            folder / "log.mcap", attachments(recording.cell), session(recording.cell), begin=display.begin
        )
        logger = Logger(files, recording.layout, reader, wire_reader, None, display, clock=lambda: now[0])
        in_a_flush, count, total = round(FLUSH_NS / period_ns), 0, round(seconds * 1e9 / period_ns)
        for turn in range(-(-total // len(feed.records))):
            for record, row in zip(feed.later(turn), feed.records, strict=True):
                tap("rx", int(row["inputs.joint.t_rx_ns"]) + turn * feed.span_ns, bytes(132))
                cycles.put(record)
                tap("tx", int(row["receipt.t_tx_ns"]) + turn * feed.span_ns, bytes(104))
                count += 1
                if count % in_a_flush == 0:
                    now[0] += FLUSH_NS
                    began = time.process_time()
                    logger.poll()
                    used += time.process_time() - began
        cycles.close()
        logger.finish("session closed")
        assert (logger.dropped, logger.failure) == (0, None)
    return used / seconds


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize(("period_ms", "seconds"), [(8, 3600), (1, 600)])
def test_hours_are_recorded_without_a_drop(
    recording: Any, core_session: tuple[Path, list[Any]], tmp_path: Path, period_ms: int, seconds: float
) -> None:
    share = endure(recording, core_session, tmp_path, period_ms * 1_000_000, seconds)
    size = (tmp_path / "log.mcap").stat().st_size * 1e-6
    print(f"\n{seconds} s at {period_ms} ms: logger {share:.2%} of a core, {size:.0f} MB")
    log = open_log(tmp_path / "log.mcap")
    assert log.cycles >= seconds * 1000 / period_ms
    assert log.end["lost cycle"] == "0"
    began = time.perf_counter()
    report, _ = audit(tmp_path / "log.mcap")
    print(f"audit {time.perf_counter() - began:.0f} s")
    (complete,) = (rule for rule in report["rules"] if rule["name"] == "completeness")
    assert complete["holds"]


def test_ten_seconds_are(recording: Any, core_session: tuple[Path, list[Any]], tmp_path: Path) -> None:
    endure(recording, core_session, tmp_path, 8_000_000, 10)
    log = open_log(tmp_path / "log.mcap")
    assert log.cycles == 1350
    assert len(list(log.messages(schema.WIRE_RX.topic))) == 1350
