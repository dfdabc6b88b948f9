"""The record is a valid protobuf message and gives back exactly what was packed."""

import dataclasses
import struct
from typing import Any

import numpy as np
import pytest
from google.protobuf import descriptor_pool, message_factory
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from asc_rt import record
from asc_rt.core.types import (
    MAX_CAPSULES,
    MAX_PAIRS,
    CycleInputs,
    EventKind,
    OperatorEvent,
    Pairs,
    RobotFlag,
)
from asc_rt.fixed_protobuf import Array, Message
from asc_rt.packing import RecordError
from asc_rt.record import MAX_EVENTS, RecordLayout
from drivers.base import WriteReceipt
from tests.pairs import ROWS, pairs_of

N = 6
LAYOUT = RecordLayout(N)
NO_ROWS = np.zeros((len(ROWS), MAX_PAIRS))

int64 = st.integers(-(2**63), 2**63 - 1)
SCALARS: dict[type, st.SearchStrategy[Any]] = {
    int: int64,
    record.Unsigned: st.integers(0, 2**64 - 1),
    float: st.floats(width=64),  # with NaN, infinities and -0.0: the record keeps what it is given
    bool: st.booleans(),
    RobotFlag: st.integers(0, 31).map(RobotFlag),
}


COLUMNS: dict[str, st.SearchStrategy[Any]] = {
    "<f8": SCALARS[float],
    "<i8": SCALARS[int],
    "<u8": SCALARS[record.Unsigned],
}


def scalars(kind: Any) -> st.SearchStrategy[Any]:
    return SCALARS[kind] if kind in SCALARS else st.sampled_from(kind)


def arrays(array: Array, rows: int) -> st.SearchStrategy[Any]:
    shape = (rows,) if array.width == 1 else (rows, array.width)
    elements = COLUMNS[array.dtype]
    return hnp.arrays(array.dtype, shape, elements=elements, fill=elements)


def row_scalars(array: Array) -> st.SearchStrategy[Any]:
    return COLUMNS[array.dtype] if array.kind in (int, float) else scalars(array.kind)


def objects(message: Message) -> st.SearchStrategy[Any]:
    """Any value of the message's dataclass, with any number of rows, or None where that is a value."""
    if message.rows:
        columns = {name: row_scalars(array) for name, array in message.arrays.items()}
        return st.lists(st.builds(message.cls, **columns), max_size=message.capacity).map(tuple)

    def with_rows(rows: int) -> st.SearchStrategy[Any]:
        fields = {name: scalars(kind) for name, kind in message.scalars.items()}
        fields |= {name: arrays(array, rows) for name, array in message.arrays.items()}
        fields |= {name: objects(inner) for name, inner in message.messages.items()}
        return st.builds(pairs_of if message.table else message.cls, **fields)

    made = st.integers(0, message.capacity).flatmap(with_rows) if message.capacity else with_rows(N)
    return st.none() | made if message.optional else made


cycles = st.tuples(*map(objects, record.TABLE.values()))

bounded = settings(max_examples=30, deadline=None)


def packed(cycle: tuple[Any, ...]) -> bytearray:
    buffer = LAYOUT.buffer()
    LAYOUT.pack(buffer, *cycle)
    return bytearray(LAYOUT.sealed(buffer))


def same(a: Any, b: Any) -> bool:
    """Equal to the bit, and of the same types."""
    if type(a) is not type(b):
        return False
    if dataclasses.is_dataclass(a):
        return all(same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    if isinstance(a, tuple):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, float):
        return struct.pack("d", a) == struct.pack("d", b)
    return bool(a == b)


@bounded
@given(cycles)
def test_unpack_is_the_exact_inverse_of_pack(cycle: tuple[Any, ...]) -> None:
    data = packed(cycle)
    assert same(LAYOUT.unpack(data) + LAYOUT.unpack_rest(data), cycle)


@bounded
@given(cycles, cycles)
def test_nothing_of_the_cycle_before_stays_in_the_buffer(first: tuple[Any, ...], second: tuple[Any, ...]) -> None:
    buffer = packed(first)
    LAYOUT.pack(buffer, *second)
    assert LAYOUT.sealed(buffer) == packed(second)


@bounded
@given(cycles, cycles)
def test_what_is_the_same_object_again_is_written_again(first: tuple[Any, ...], second: tuple[Any, ...]) -> None:
    state, inputs, *rest = second
    mixed = state, dataclasses.replace(inputs, human=first[1].human, goal=first[1].goal), *rest
    for cycle in (first, mixed, second, mixed, first):
        fresh, buffer = RecordLayout(N), LAYOUT.buffer()
        fresh.pack(buffer, *cycle)
        assert packed(cycle) == LAYOUT.sealed(buffer)


def parsed(data: bytes | bytearray) -> Any:
    pool = descriptor_pool.DescriptorPool()
    for file in record.file_descriptor_set().file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(record.NAME)).FromString(bytes(data))


@bounded
@given(cycles)
def test_the_bytes_are_the_protobuf_message_itself(cycle: tuple[Any, ...]) -> None:
    data = packed(cycle)
    assert parsed(data).SerializeToString(deterministic=True) == data


def told(kind: type, value: Any) -> Any:
    return kind(value) if kind is not record.Unsigned else value


def assert_message_tells(message: Message, obj: Any, proto: Any) -> None:
    """`proto`, made by protobuf from the schema, holds the values of the dataclass."""
    if message.optional:
        assert proto.present == (obj is not None)
        if obj is None:
            return
    if message.rows:
        assert proto.count == len(obj)
        for name, array in message.arrays.items():
            column = getattr(proto, name)
            assert not any(column[len(obj) :])
            assert all(same(array.kind(x), getattr(row, name)) for x, row in zip(column, obj, strict=False)), name
        return
    for name, kind in message.scalars.items():
        assert same(told(kind, getattr(proto, name)), getattr(obj, name)), name
    for name in message.arrays:
        array = getattr(obj, name)
        column = np.array(getattr(proto, name), array.dtype)
        assert column[: array.size].tobytes() == array.tobytes(), name
        assert not column[array.size :].any()
        if message.capacity:
            assert proto.count == len(array)
    for name, inner in message.messages.items():
        assert_message_tells(inner, getattr(obj, name), getattr(proto, name))


@bounded
@given(cycles)
def test_protobuf_reads_the_same_values(cycle: tuple[Any, ...]) -> None:
    proto = parsed(packed(cycle))
    for (name, message), obj in zip(record.TABLE.items(), cycle, strict=True):
        assert_message_tells(message, obj, getattr(proto, name))


@bounded
@given(cycles)
def test_numpy_reads_the_same_values(cycle: tuple[Any, ...]) -> None:
    before, inputs, outputs, receipt, timings = cycle
    row = np.frombuffer(packed(cycle), LAYOUT.dtype)[0]
    assert row["state.mode"] == before.mode
    assert row["state.goal.q"].tobytes() == before.goal.q.tobytes()
    assert row["inputs.joint.present"] == (inputs.joint is not None)
    assert row["outputs.decision.pairs.count"] == len(outputs.decision.pairs.d)
    assert row["timings.t_wake_ns"] == timings.t_wake_ns
    if inputs.human is not None:
        m = len(inputs.human.radius)
        assert row["inputs.human.v1"][:m].tobytes() == inputs.human.v1.tobytes()
    if receipt is not None:
        assert row["receipt.q"].tobytes() == receipt.q.tobytes()


@bounded
@given(cycles)
def test_parts_pack_alone_to_the_bytes_they_have_in_the_record(cycle: tuple[Any, ...]) -> None:
    data = packed(cycle)
    for part, obj in zip(LAYOUT.parts.values(), cycle, strict=True):
        assert part.pack(obj) == part.bytes_of(data)


def all_messages(messages: dict[str, Message]) -> list[Message]:
    return [m for top in messages.values() for m in (top, *all_messages(top.messages))]


def test_the_table_has_every_field_of_every_type() -> None:
    for message in all_messages(record.TABLE):
        if message.table:
            assert [vars(message.cls)[name].at for name in message.arrays] == list(range(len(message.arrays)))
            continue
        table = {*message.scalars, *message.arrays, *message.messages}
        assert table == set(message.cls.__annotations__), message.cls


def plain(message: Message, rows: int = 3) -> Any:
    """The message's dataclass filled with something."""
    if message.rows:
        return ()
    rows = rows if message.capacity else N
    shapes = {name: (rows, a.width) if a.width > 1 else rows for name, a in message.arrays.items()}
    make = pairs_of if message.table else message.cls
    return make(
        **{name: kind(1) for name, kind in message.scalars.items()},
        **{name: np.ones(shapes[name], a.dtype) for name, a in message.arrays.items()},
        **{name: plain(inner) for name, inner in message.messages.items()},
    )


def example(**changes: Any) -> tuple[Any, ...]:
    return tuple(({name: plain(message) for name, message in record.TABLE.items()} | changes).values())


INPUTS: CycleInputs = plain(record.INPUTS)
RECEIPT: WriteReceipt = plain(record.RECEIPT)


@pytest.mark.parametrize(
    "changes",
    [
        {"inputs": dataclasses.replace(INPUTS, human=plain(record.HUMAN, rows=MAX_CAPSULES + 1))},
        {"inputs": dataclasses.replace(INPUTS, events=(OperatorEvent(1, EventKind.ARM),) * (MAX_EVENTS + 1))},
        {"receipt": dataclasses.replace(RECEIPT, q=np.zeros(N - 1))},
        {"receipt": dataclasses.replace(RECEIPT, q=np.zeros(N, np.float32))},
        {"receipt": dataclasses.replace(RECEIPT, seq=2**63)},
    ],
    ids=["capsules", "events", "joints", "float32", "int64"],
)
def test_what_does_not_fit_is_refused_and_never_cut_and_leaves_nothing_behind(changes: dict[str, Any]) -> None:
    good = example()
    before = packed(good)
    with pytest.raises(RecordError):
        packed(example(**changes))
    assert packed(good) == before


@pytest.mark.parametrize(
    "pairs", [Pairs(1, NO_ROWS[:, :1]), Pairs(1, NO_ROWS[0]), Pairs(MAX_PAIRS + 1, NO_ROWS), Pairs(-1, NO_ROWS)]
)
def test_pairs_of_another_form_are_refused(pairs: Pairs) -> None:
    outputs = example()[2]
    broken = dataclasses.replace(outputs, decision=dataclasses.replace(outputs.decision, pairs=pairs))
    with pytest.raises(RecordError, match="pairs"):
        packed(example(outputs=broken))


@pytest.mark.parametrize("path", ["state.mode", "inputs.human.count", "outputs.decision.status"])
def test_impossible_values_are_named(path: str) -> None:
    data = packed(example())
    data[LAYOUT.dtype.fields[path][1]] = 99  # type: ignore[index]
    with pytest.raises(RecordError, match=path):
        LAYOUT.unpack(data)


@pytest.mark.parametrize("size", [0, LAYOUT.size - 1, LAYOUT.size + 1])
def test_another_size_is_no_record(size: int) -> None:
    with pytest.raises(RecordError):
        LAYOUT.unpack(bytes(size))


@given(st.integers(0, LAYOUT.size - 1), st.integers(1, 255))
def test_every_changed_byte_is_noticed(offset: int, error: int) -> None:
    data = packed(example())
    assert LAYOUT.syndrome(data) == 0
    data[offset] ^= error
    assert LAYOUT.syndrome(data) != 0
