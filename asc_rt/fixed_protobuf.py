"""Dataclasses as protobuf messages of a fixed size.

Where every field has a fixed size, protobuf tags and lengths stand at fixed places: one `struct` writes the message, a
numpy dtype reads it, and any protobuf reader understands it. A `Message` says which fields a dataclass has; a `Part` is
such a message ready to pack.
"""

from __future__ import annotations

import dataclasses
import itertools
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2

from asc_rt.packing import Choice, Names, Piece, RecordError, Value, compiled, misfit

PACKAGE = "asc.v1"

Buffer = bytes | bytearray | memoryview


class Unsigned(int):
    """Marks an integer that uses all 64 bits."""


@dataclass(frozen=True, slots=True)
class Array:
    """A column of numbers: as long as the message's count, else one row per joint; `width` numbers in each row. In a
    message of `rows` each number stands for a `kind`."""

    dtype: str = "<f8"
    width: int = 1
    kind: type = float


JOINTS = COLUMN = Array()
POINTS = Array(width=3)
INDICES = Array("<i8", kind=int)
NUMBERS = Array("<u8", kind=int)


class Message:
    """One dataclass as a protobuf message. Fields: name -> Python type, Array or Message; the order numbers them.

    `optional`: None is a value of its own (a flag `present`). `capacity`: the arrays hold 0..capacity rows (a field
    `count`), else n. `rows`: a tuple of 0..capacity dataclasses, written as columns. `table`: the dataclass has a
    `count` and one float64 array, `table`, (arrays, capacity), with the arrays as its rows, whole numbers by their
    bits. `kept`: often the same object in the next record. Scalars stand before arrays, arrays before messages,
    whatever order the table has.
    """

    def __init__(
        self,
        cls: type,
        fields: dict[str, Any],
        *,
        optional: bool = False,
        capacity: int = 0,
        rows: bool = False,
        table: bool = False,
        kept: bool = False,
    ) -> None:
        self.cls, self.optional, self.capacity, self.kept = cls, optional, capacity, kept
        self.rows, self.table = rows, table
        self.messages = {k: v for k, v in fields.items() if isinstance(v, Message)}
        self.arrays = {k: v for k, v in fields.items() if isinstance(v, Array)}
        self.scalars = {k: v for k, v in fields.items() if k not in self.messages and k not in self.arrays}
        self.head: dict[str, type] = ({"present": bool} if optional else {}) | ({"count": int} if capacity else {})
        inside = sum(inner.leaf_count for inner in self.messages.values())
        self.leaf_count: int = len(self.head) + len(self.scalars) + len(self.arrays) + inside


# --- from the table to bytes -----------------------------------------------------------------------------------------

VARINT, FIXED64, LENGTH, FIXED32 = 0, 1, 2, 5  # protobuf wire types
FieldProto = descriptor_pb2.FieldDescriptorProto


@dataclass(frozen=True, slots=True)
class Leaf:
    """One number or array of the record."""

    path: str  # "inputs.joint.q"
    tag: bytes  # the constant bytes before it: protobuf tags and lengths, also of the messages that begin here
    code: str  # of `struct`
    format: str  # of numpy, one element
    shape: tuple[int, ...]
    kind: type  # Python type of a scalar; float or int for arrays
    offset: int = 0  # of the value, from the start of the record

    @property
    def size(self) -> int:
        return struct.calcsize("<" + self.code)


def _wire(kind: type) -> tuple[str, str, int, int]:
    """struct code, numpy format, protobuf type, wire type of a scalar. Enums and bools: varints of one byte (< 128)."""
    if issubclass(kind, float):
        return "d", "<f8", FieldProto.TYPE_DOUBLE, FIXED64
    if issubclass(kind, bool):
        return "B", "u1", FieldProto.TYPE_BOOL, VARINT
    if issubclass(kind, IntEnum):
        return "B", "u1", FieldProto.TYPE_ENUM, VARINT
    if issubclass(kind, Unsigned):
        return "Q", "<u8", FieldProto.TYPE_FIXED64, FIXED64
    return "q", "<i8", FieldProto.TYPE_SFIXED64, FIXED64


def varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def tag(number: int, wire_type: int) -> bytes:
    return varint(number << 3 | wire_type)


def _leaves(message: Message, n: int, path: str) -> list[Leaf]:
    """Every leaf of a message in its order of bytes, without the header of the message itself."""
    found: list[Leaf] = []
    numbers = itertools.count(1)
    for name, kind in (message.head | message.scalars).items():
        code, fmt, _, wire_type = _wire(kind)
        found.append(Leaf(f"{path}.{name}", tag(next(numbers), wire_type), code, fmt, (), kind))
    for name, array in message.arrays.items():
        rows = message.capacity or n
        size = 8 * rows * array.width
        shape = (rows,) if array.width == 1 else (rows, array.width)
        kind = float if array.dtype == "<f8" else int
        head = tag(next(numbers), LENGTH) + varint(size)
        found.append(Leaf(f"{path}.{name}", head, f"{size}s", array.dtype, shape, kind))
    for name, inner in message.messages.items():
        found += _headed(next(numbers), _leaves(inner, n, f"{path}.{name}"))
    return found


def _headed(number: int, leaves: list[Leaf]) -> list[Leaf]:
    """The leaves of a message with its tag and length put before the first."""
    first = leaves[0]
    head = tag(number, LENGTH) + varint(len(_blank(leaves))) + first.tag
    return [dataclasses.replace(first, tag=head), *leaves[1:]]


def _blank(leaves: list[Leaf]) -> bytes:
    """The leaves with nothing in them: what an absent message is."""
    return b"".join(leaf.tag + bytes(leaf.size) for leaf in leaves)


# --- writing ---------------------------------------------------------------------------------------------------------


def _pieces(message: Message, n: int, path: str, it: str, leaves: Iterator[Leaf], names: Names) -> Iterator[Piece]:
    """The pieces of `message`, found in the expression `it`, in the order of its leaves."""
    if message.optional:
        yield next(leaves).tag + b"\1"
    rows = str(n)
    if message.capacity:
        rows, first = f"rows_{path.replace('.', '_')}", next(iter(message.arrays))
        leaf = next(leaves)
        yield leaf.tag
        number = f"{it}.count" if message.table else f"len({it}.{first})"
        fits = f"0 <= ({rows} := {number}) <= {message.capacity}"
        yield Value(leaf.code, f"{rows} if {fits} else misfit({path!r}, 'more than {message.capacity} rows')")
    for name in message.scalars:
        leaf = next(leaves)
        yield leaf.tag
        yield Value(leaf.code, f"{it}.{name}")
    if message.table:
        columns, name = list(itertools.islice(leaves, len(message.arrays))), f"table_{path.replace('.', '_')}"
        names[name] = _table(path, columns, message.capacity)
        yield Value(f"{len(_blank(columns))}s", f"{name}({it}.table)")
    else:
        for name, array in message.arrays.items():  # struct would pad or cut silently
            leaf = next(leaves)
            yield leaf.tag
            fits = f"len(data := {it}.{name}.tobytes()) == {8 * array.width} * {rows}"
            yield Value(leaf.code, f"data if {fits} else misfit({leaf.path!r}, 'not an 8-byte number for each place')")
    for name, inner in message.messages.items():
        inner_path, inner_it = f"{path}.{name}", f"{it}.{name}"
        if inner.optional or inner.rows:
            yield _choice(inner, n, inner_path, inner_it, list(itertools.islice(leaves, inner.leaf_count)), names)
        else:
            yield from _pieces(inner, n, inner_path, inner_it, leaves, names)


def _choice(message: Message, n: int, path: str, it: str, leaves: list[Leaf], names: Names) -> Piece:
    """The piece of a message that may be absent, or of a tuple of them."""
    name, absent = path.replace(".", "_"), _blank(leaves)

    def choice(it: str, names: Names) -> Choice:
        if message.rows:
            return Choice(it, name, _of_rows(message, path, name, leaves))
        return Choice(
            it, name, [(f"{name} is None", [absent]), ("", list(_pieces(message, n, path, name, iter(leaves), names)))]
        )

    if not message.kept:
        return choice(it, names)
    own: Names = {}
    names[name] = _kept(compiled([choice("it", own)], "it", own), len(absent))
    return Value(f"{len(absent)}s", f"{name}({it}) if {it} else {absent!r}")  # else: None, or no rows


def _of_rows(message: Message, path: str, name: str, leaves: list[Leaf]) -> list[tuple[str, list[Piece]]]:
    """A tuple of dataclasses, written as columns: the pieces for each number of them."""
    head, *columns = leaves

    def pieces(count: int) -> Iterator[Piece]:
        yield head.tag + struct.pack(f"<{head.code}", count)
        for (column, array), leaf in zip(message.arrays.items(), columns, strict=True):
            yield leaf.tag
            yield from (Value(_CODE[array.dtype], f"{name}[{i}].{column}") for i in range(count))
            yield bytes(8 * (message.capacity - count))

    refused = Value(f"{len(_blank(leaves))}s", f"misfit({path!r}, 'more than {message.capacity} rows')")
    return [*((f"len({name}) == {k}", list(pieces(k))) for k in range(message.capacity + 1)), ("", [refused])]


def _kept(pack: Callable[..., None], size: int) -> Callable[[Any], bytearray]:
    """The bytes of a message; as nothing in it can change, it is packed only when it is another object than the last
    time."""
    made, last = bytearray(size), None

    def data(obj: Any) -> bytearray:
        nonlocal last
        if obj is not last:
            last = None  # should it not fit
            pack(made, 0, obj)
            last = obj
        return made

    return data


def _table(path: str, leaves: list[Leaf], capacity: int) -> Callable[[Any], bytearray]:
    """The bytes of the arrays of a table, which is copied between their tags."""
    (head,) = {len(leaf.tag) for leaf in leaves}
    made, shape = bytearray(_blank(leaves)), (len(leaves), capacity)
    cells = np.ndarray(shape, "<f8", made, head, (head + 8 * capacity, 8))

    def data(table: Any) -> bytearray:
        if table.shape != shape:
            misfit(path, f"a table of {table.shape} instead of {shape}")
        cells[...] = table
        return made

    return data


_CODE = {"<f8": "d", "<i8": "q", "<u8": "Q"}


# --- reading ---------------------------------------------------------------------------------------------------------


def _build(message: Message, path: str, n: int, row: Iterator[Any]) -> Any:
    """The object that the values of a row, one for each leaf, stand for: inverse of `_pieces`."""
    if message.optional and not next(row):
        for _ in range(message.leaf_count - 1):
            next(row)
        return None
    rows = message.capacity or n
    count = next(row) if message.capacity else n
    if count > rows:
        raise RecordError(f"{path}.count: {count} is more than {rows}")
    if message.table:
        table = np.array([np.frombuffer(next(row), np.float64) for _ in message.arrays])
        table.setflags(write=False)
        return message.cls(count, table)
    made = {name: _scalar(f"{path}.{name}", kind, next(row)) for name, kind in message.scalars.items()}
    for name, array in message.arrays.items():
        flat = np.frombuffer(next(row), dtype=array.dtype, count=count * array.width)
        made[name] = flat if array.width == 1 else flat.reshape(count, array.width)
    for name, inner in message.messages.items():
        made[name] = _build(inner, f"{path}.{name}", n, row)
    if not message.rows:
        return message.cls(**made)
    columns = [
        [_scalar(f"{path}.{name}", message.arrays[name].kind, value) for value in column.tolist()]
        for name, column in made.items()
    ]
    return tuple(message.cls(**dict(zip(made, row, strict=True))) for row in zip(*columns, strict=True))


def _scalar(path: str, kind: type, value: Any) -> Any:
    try:
        return value if kind is Unsigned else kind(value)
    except ValueError as error:
        raise RecordError(f"{path}: {value} is no {kind.__name__}") from error


class Part:
    """One top-level message of the record (`state`, `inputs`, ...): packs and unpacks on its own. `pieces`: what it
    is made of, found in the expression `name`, with `names`."""

    def __init__(self, name: str, number: int, message: Message, n: int, offset: int) -> None:
        self.name, self.offset, self._message, self._n = name, offset, message, n
        leaves = _headed(number, _leaves(message, n, name))
        self._row = struct.Struct("<" + "".join(f"{len(leaf.tag)}x{leaf.code}" for leaf in leaves))
        self.size = self._row.size
        self.leaves: list[Leaf] = []
        for leaf in leaves:
            offset += len(leaf.tag)
            self.leaves.append(dataclasses.replace(leaf, offset=offset))
            offset += leaf.size
        self.names: Names = {}
        if message.optional:
            self.pieces: list[Piece] = [_choice(message, n, name, name, leaves, self.names)]
        else:
            self.pieces = list(_pieces(message, n, name, name, iter(leaves), self.names))
        self._pack_into = compiled(self.pieces, name, self.names)

    def pack_into(self, record: bytearray | memoryview, obj: Any) -> None:
        try:
            self._pack_into(record, self.offset, obj)
        except struct.error as error:
            raise RecordError(f"{self.name}: a number does not fit into the record: {error}") from error

    def pack(self, obj: Any) -> bytes:
        """The bytes of this part alone."""
        record = bytearray(self.offset + self.size)
        self.pack_into(record, obj)
        return self.bytes_of(record)

    def unpack(self, record: Buffer) -> Any:
        return _build(self._message, self.name, self._n, iter(self._row.unpack_from(record, self.offset)))

    def bytes_of(self, record: Buffer) -> bytes:
        return bytes(record[self.offset : self.offset + self.size])


# --- from the table to protobuf --------------------------------------------------------------------------------------


COLUMN_TYPES = {
    "<f8": FieldProto.TYPE_DOUBLE,
    "<i8": FieldProto.TYPE_SFIXED64,
    "<u8": FieldProto.TYPE_FIXED64,
}


def add_field(into: descriptor_pb2.DescriptorProto, name: str, number: int, kind: int, type_name: str = "") -> None:
    field = into.field.add(name=name, number=number, label=FieldProto.LABEL_OPTIONAL)
    field.type = kind
    if type_name:
        field.type_name = f".{PACKAGE}.{type_name}"


def describe(file: descriptor_pb2.FileDescriptorProto, message: Message) -> str:
    """Add the message type and all that it uses to `file`; its name."""
    name = f"{'Optional' if message.optional else ''}{message.cls.__name__}"
    if any(known.name == name for known in file.message_type):
        return name
    made = file.message_type.add(name=name)
    numbers = itertools.count(1)
    for field, kind in (message.head | message.scalars).items():
        enum = _describe_enum(file, kind) if issubclass(kind, IntEnum) else ""
        add_field(made, field, next(numbers), _wire(kind)[2], enum)
    for field, array in message.arrays.items():
        column = made.field.add(name=field, number=next(numbers), label=FieldProto.LABEL_REPEATED)
        column.type = COLUMN_TYPES[array.dtype]
        column.options.packed = True
    for field, inner in message.messages.items():
        add_field(made, field, next(numbers), FieldProto.TYPE_MESSAGE, describe(file, inner))
    return name


def _describe_enum(file: descriptor_pb2.FileDescriptorProto, kind: type[IntEnum]) -> str:
    if not any(known.name == kind.__name__ for known in file.enum_type):
        made = file.enum_type.add(name=kind.__name__)
        for value in kind:  # protobuf enum values share one namespace: prefix them
            made.value.add(name=f"{kind.__name__}_{value.name}", number=value.value)
    return kind.__name__
