"""Replay runs the decision again, in any order, and names what differs."""

import dataclasses
import random
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from asc_rt.core.params import Params
from asc_rt.core.types import CoreState, CycleInputs, CycleOutputs, vector
from logs import schema
from logs.diff import altered, differences
from logs.reader import open_log
from logs.replay import Order, Stepper, replay

Decision = Callable[[Params], Stepper]


@pytest.mark.parametrize(("start", "order"), [(0, Order.FORWARD), (25, Order.FORWARD), (0, Order.REVERSE)])
def test_the_same_code_gives_the_same_bytes(recording: Any, decision: Decision, start: int, order: Order) -> None:
    path = recording.write(recording.packed(recording.cycles(40)))
    report = replay(path, start, order, stepper=decision)
    assert report.cycles == 40 - start
    assert (report.mismatches, report.exact, report.first_difference) == (0, True, None)
    assert report.fingerprint_match
    assert (report.wire_mismatches, report.gaps) == (0, 0)


def test_reverse_order_really_is_reverse(recording: Any, decision: Decision) -> None:
    path = recording.write(recording.packed(recording.cycles(10)))
    asked: list[int] = []

    def remember(numbers: Any) -> Any:
        asked.extend(numbers)
        return asked

    replay(path, 3, Order.REVERSE, stepper=decision, progress=remember)
    assert asked == [9, 8, 7, 6, 5, 4, 3]


def changed_from(tick: int, change: Callable[[CycleOutputs], CycleOutputs], decision: Decision) -> Decision:
    """Code that decides otherwise from a cycle on."""

    def stepper(params: Params) -> Stepper:
        decide = decision(params)

        def step(state: CoreState, x: CycleInputs) -> tuple[CoreState, CycleOutputs]:
            after, out = decide(state, x)
            return after, change(out) if x.tick >= tick else out

        return step

    return stepper


def nudge(out: CycleOutputs) -> CycleOutputs:
    u = np.array(out.decision.u_safe)
    u[4] = np.nextafter(u[4], 9.0)  # the smallest change there is
    return dataclasses.replace(out, decision=dataclasses.replace(out.decision, u_safe=vector(u)))


@pytest.mark.parametrize("order", Order)
def test_a_change_of_the_code_is_named(recording: Any, decision: Decision, order: Order) -> None:
    path = recording.write(recording.packed(recording.cycles(30)))
    report = replay(path, 0, order, stepper=changed_from(17, nudge, decision))
    assert report.mismatches == 13
    assert not report.exact
    assert report.first_difference is not None
    assert (report.first_difference.cycle, report.first_difference.field) == (17, "outputs.decision.u_safe[4]")
    assert report.first_difference.logged != report.first_difference.replayed


def test_a_change_of_the_state_alone_is_named(recording: Any, decision: Decision) -> None:
    path = recording.write(recording.packed(recording.cycles(30)))

    def stepper(params: Params) -> Stepper:
        def step(state: CoreState, x: CycleInputs) -> tuple[CoreState, CycleOutputs]:
            after, out = decision(params)(state, x)
            return (dataclasses.replace(after, silent_cycles=5) if x.tick == 11 else after), out

        return step

    report = replay(path, stepper=stepper)
    assert report.first_difference is not None
    assert report.mismatches == 1
    assert dataclasses.astuple(report.first_difference) == (11, "state_after.silent_cycles", 0, 5)


def test_code_that_raises_differs(recording: Any, decision: Decision) -> None:
    path = recording.write(recording.packed(recording.cycles(5)))

    def broken(out: CycleOutputs) -> CycleOutputs:
        raise ZeroDivisionError("by zero")

    report = replay(path, stepper=changed_from(3, broken, decision))
    assert report.mismatches == 2
    assert report.first_difference is not None
    assert report.first_difference.replayed == "ZeroDivisionError: by zero"


def flip(recording: Any, packed: list[bytes], cycle: int, path: str, byte: int, error: int = 0x10) -> list[bytes]:
    """One byte of one field of one record changed; the file around it is written anew, with right checksums."""
    data = bytearray(packed[cycle])
    data[recording.layout.dtype.fields[path][1] + byte] ^= error
    return [*packed[:cycle], bytes(data), *packed[cycle + 1 :]]


@pytest.mark.parametrize(
    ("path", "byte", "field"),
    [
        ("inputs.joint.q", 8 * 2 + 6, "inputs.joint.q[2]"),  # decides something
        ("inputs.joint.current", 8 * 5, "inputs.joint.current[5]"),  # decides nothing
        ("inputs.human.v1", 8 * 4 + 1, "inputs.human.v1[1][1]"),
        ("inputs.human.p0", 8 * 3 * 19, "inputs.human.p0[19][0]"),  # unused room behind the capsules
        ("inputs.missed_ticks", 0, "inputs.missed_ticks"),
        ("inputs.tick", 0, "inputs.tick"),
        ("inputs.late", 0, "inputs.late"),
        ("inputs.human.health", 0, "inputs.human.health"),
        ("inputs.human.count", 0, "inputs.human.count"),
        ("inputs.joint.present", 0, "inputs.joint.present"),
        ("state.q_cmd", 8 + 6, "state.q_cmd[1]"),
        ("state.mode", 0, "state.mode"),
        ("outputs.decision.pairs.phi", 3, "outputs.decision.pairs.phi[0]"),
        ("receipt.q", 8, "receipt.q[1]"),
        ("timings.t_wake_ns", 1, "timings.t_wake_ns"),
        ("check", 2, "check"),
    ],
)
@pytest.mark.parametrize("order", Order)
def test_one_flipped_byte_is_named(
    recording: Any, decision: Decision, path: str, byte: int, field: str, order: Order
) -> None:
    packed = recording.packed(recording.cycles(30))
    report = replay(recording.write(flip(recording, packed, 20, path, byte)), 0, order, stepper=decision)
    assert report.first_difference is not None
    where = report.first_difference
    assert where.field == field
    assert where.cycle == (20 ^ 0x10 if path == "inputs.tick" else 20)
    assert report.mismatches == 1
    assert not report.exact


def test_any_flipped_byte_is_put_right(recording: Any) -> None:
    """A CRC names the single changed byte: what it names must be what was there."""
    layout = recording.layout
    record = recording.packed(recording.cycles(5))[4]
    rng = random.Random(3)
    for _ in range(40):
        data = bytearray(record)
        data[rng.randrange(len(data))] ^= rng.randrange(1, 256)
        found = altered(layout, data)
        truth = next(differences(layout, data, record, (*layout.parts, "check")), None)
        assert found is not None
        if truth is None:
            assert found.field.endswith("(its tag)")
        else:
            assert found == truth
    assert altered(layout, record) is None


def test_a_larger_change_is_found_though_not_named(recording: Any, decision: Decision) -> None:
    packed = recording.packed(recording.cycles(10))
    data = bytearray(packed[6])
    offset = recording.layout.dtype.fields["inputs.joint.current"][1]
    data[offset : offset + 40] = bytes(range(40))
    report = replay(recording.write([*packed[:6], bytes(data), *packed[7:]]), stepper=decision)
    assert report.first_difference is not None
    assert (report.first_difference.cycle, report.first_difference.field) == (6, "record")


def test_missing_records_are_gaps_not_differences(recording: Any, decision: Decision) -> None:
    packed = recording.packed(recording.cycles(30))
    report = replay(recording.write(packed[:10] + packed[13:20] + packed[21:]), stepper=decision)
    assert (report.mismatches, report.gaps) == (0, 2)


def test_another_machine_is_compared_with_a_tolerance_and_told(recording: Any, decision: Decision) -> None:
    path = recording.write(recording.packed(recording.cycles(10)), fingerprint={"hash": "another machine"})
    report = replay(path, stepper=changed_from(5, nudge, decision))
    assert not report.fingerprint_match
    assert not report.exact
    assert report.mismatches == 0
    assert 0 < report.largest_difference < report.tolerance

    def much(out: CycleOutputs) -> CycleOutputs:
        return dataclasses.replace(out, decision=dataclasses.replace(out.decision, d_measured=0.5))

    assert replay(path, stepper=changed_from(5, much, decision)).mismatches == 5


@pytest.mark.parametrize("channel", [schema.WIRE_RX, schema.WIRE_TX])
def test_missing_packets_are_wire_mismatches(recording: Any, decision: Decision, channel: schema.Channel) -> None:
    path = recording.write(recording.packed(recording.cycles(10)), without=(channel, 4))
    assert replay(path, stepper=decision).wire_mismatches == 1


def test_what_was_sent_otherwise_is_a_wire_mismatch(recording: Any, decision: Decision) -> None:
    cycles = recording.cycles(10)
    state, x, out, receipt, timings = cycles[7]
    cycles[7] = (state, x, out, dataclasses.replace(receipt, q=vector(receipt.q + 1e-3)), timings)
    report = replay(recording.write(recording.packed(cycles)), stepper=decision)
    assert (report.wire_mismatches, report.mismatches) == (1, 0)
    assert replay(recording.write(recording.packed(cycles), wire=False), stepper=decision).wire_mismatches == 0


def test_a_truncated_log_is_replayed_as_far_as_it_goes(recording: Any, decision: Decision) -> None:
    report = replay(recording.write(recording.packed(recording.cycles(30)), close=False), stepper=decision)
    assert (report.cycles, report.mismatches, report.truncated) == (30, 0, True)


def test_a_start_beyond_the_end_is_refused(recording: Any, decision: Decision) -> None:
    with pytest.raises(IndexError, match="the log has 5"):
        replay(recording.write(recording.packed(recording.cycles(5))), 5, stepper=decision)


def test_the_report_has_the_keys_of_the_command(recording: Any, decision: Decision) -> None:
    report = replay(recording.write(recording.packed(recording.cycles(5))), stepper=decision).as_dict()
    assert {"cycles", "mismatches", "exact", "fingerprint_match", "first_difference", "wire_mismatches"} <= set(report)


def test_differences_tell_the_bits_of_floats(recording: Any) -> None:
    packed = recording.packed(recording.cycles(3))
    layout, data = recording.layout, bytearray(packed[2])
    offset = layout.dtype.fields["outputs.decision.d_measured"][1]
    data[offset : offset + 8] = np.float64(0.0).tobytes()
    other = bytearray(data)
    other[offset : offset + 8] = np.float64(-0.0).tobytes()
    (found,) = differences(layout, data, other, ("outputs",))
    assert found.field == "outputs.decision.d_measured"
    data[offset : offset + 8] = np.float64(np.nan).tobytes()
    assert list(differences(layout, data, data, ("outputs",))) == []
    assert open_log(recording.write(packed)).record(2) == packed[2]
