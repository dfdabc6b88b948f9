"""Drives served by a person while nothing runs: how each is, a fault reset, a number for a new drive.

Nothing in here enables a drive, and nothing resets one but the axis that the person names. What follows a reset is a
session from the very start: the whole checklist again.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence

import numpy as np

from drivers.base import Finding
from drivers.can import start_up
from drivers.can.arm import ArmCodec, Power
from drivers.can.link import Link
from drivers.can.options import Options
from drivers.can.stream import Stream, look
from drivers.can.watch import COOLED_C, HEATED_C, AxisState

LOOKS = 25  # cycles between two looks at an arm that has to stand still
COOL_C = HEATED_C - COOLED_C  # a drive that is reset hotter than this trips again at once


def tell(link: Link, codec: ArmCodec, options: Options, period_ns: int) -> Iterator[Finding]:
    """The checklist as far as it enables nothing, then a line for each drive."""
    stream = yield from _begin(link, codec, options, period_ns)
    if stream is not None:
        yield from _states(stream)


def reset(
    link: Link, codec: ArmCodec, options: Options, period_ns: int, axes: Sequence[int], supported: bool
) -> Iterator[Finding]:
    """Reset the faults of these axes, counted from 0, if every condition holds for each of them; else of none."""
    stream = yield from _begin(link, codec, options, period_ns)
    if stream is None:
        return
    conditions = [_rest(stream), *(line for i in axes for line in _conditions(stream, i, supported))]
    yield from conditions
    if all(line.ok for line in conditions):
        for i in axes:
            yield codec.reset(link, i)


def assign(link: Link, codec: ArmCodec, options: Options, number: int) -> Iterator[Finding]:
    """Give the one drive on the bus that has no number this one."""
    for line in start_up.examine_bus(link, codec, options):
        yield line
        if not line.ok:
            return
    yield codec.assign(link, number)


def _begin(link: Link, codec: ArmCodec, options: Options, period_ns: int) -> Generator[Finding, None, Stream | None]:
    """A stream that only asks, after LOOKS cycles; None: a line does not hold, or somebody is silent."""
    lines = []
    for line in start_up.examine(link, codec, options, period_ns):
        lines.append(line)
        yield line
    if not all(line.ok for line in lines):
        return None
    stream = Stream(link, codec, period_ns, round(options.stale_ms * 1e6), None)
    _look(stream)
    silent = [i + 1 for i, axis in enumerate(stream.axes) if axis.feedback is None]
    if silent:
        yield Finding("drives", False, f"axes {silent} are silent", "check power and cabling of these drives")
        return None
    return stream


def _look(stream: Stream) -> None:
    stream.pause()
    for _ in range(LOOKS):
        begin_ns = stream.link.now_ns()
        stream.send(look(len(stream.axes)))
        stream.collect(begin_ns + stream.period_ns, begin_ns + stream.period_ns)


def _states(stream: Stream) -> Iterator[Finding]:
    for i, axis in enumerate(stream.axes):
        told = axis.feedback
        assert told is not None
        heat = "" if told.hottest_c is None else f", {told.hottest_c:.0f} C"
        ok = told.power in (Power.DISABLED, Power.ENABLED)
        fix = f"find the cause; then, at rest and supported: asc drives CELL --reset {i + 1}"
        yield Finding(f"axis {i + 1} state", ok, f"{told.words} at {told.q:.3f} rad{heat}", fix)


def _rest(stream: Stream) -> Finding:
    first = stream.pose()[0]
    _look(stream)
    moved = float(np.max(np.abs(stream.pose()[0] - first)))
    detail = f"moves by {moved * 1e3:.1f} mrad in {LOOKS} cycles, at most {start_up.SEED * 1e3:.0f}"
    return Finding("at rest", moved <= start_up.SEED, detail, "let it come to rest")


def _conditions(stream: Stream, i: int, supported: bool) -> Iterator[Finding]:
    """Is there a fault, is its cause over, and does nothing fall?"""
    axis, name = stream.axes[i], f"axis {i + 1}"
    told = axis.feedback
    assert told is not None
    is_faulted = told.power in (Power.FAULT, Power.NO_VOLTAGE)
    yield Finding(f"{name} fault", is_faulted, told.words, "it has no fault: there is nothing to reset")
    yield _cool(name, axis)
    carried = stream.codec.joints[i].has_brake or supported
    detail = "braked" if stream.codec.joints[i].has_brake else "supported, as you say" if supported else "has no brake"
    fix = "reset, it holds nothing any more: support the arm, then add --supported"
    yield Finding(f"{name} weight", carried, detail, fix)


def _cool(name: str, axis: AxisState) -> Finding:
    told = axis.feedback
    assert told is not None
    if told.hottest_c is None:
        return Finding(f"{name} heat", not told.warning, "it warns" if told.warning else "no warning", "let it cool")
    detail = f"{told.hottest_c:.0f} C, at most {COOL_C:.0f} C"
    return Finding(f"{name} heat", told.hottest_c <= COOL_C, detail, "let it cool down")
