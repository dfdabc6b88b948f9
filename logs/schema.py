"""The channels of a recording: topic, encoding and schema of each. Writer and reader both speak from this table."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from asc_rt import human_state_pb2, record

PROFILE = "asc"  # of the MCAP header
LIBRARY = "asc-rt logs.writer"

PARAMS, CELL, FINGERPRINT = "params.json", "cell.toml", "fingerprint.json"  # names of attachments
SESSION, END = "session", "end"  # names of metadata records


@dataclass(frozen=True, slots=True)
class Channel:
    """`encoding`: how messages are written, as MCAP names it. JSON channels have no schema: nobody plots them."""

    topic: str
    encoding: str = "json"
    schema_name: str = ""
    schema_data: bytes = b""

    @property
    def schema_encoding(self) -> str:
        return "protobuf" if self.schema_data else ""


def _file_set(*files: descriptor_pb2.FileDescriptorProto) -> bytes:
    data: bytes = descriptor_pb2.FileDescriptorSet(file=files).SerializeToString()
    return data


def _wire_file() -> descriptor_pb2.FileDescriptorProto:
    """One packet as it was on the wire."""
    field = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="asc/v1/wire.proto", package="asc.v1", syntax="proto2")
    message = file.message_type.add(name="Wire")
    message.field.add(name="t_ns", number=1, label=field.LABEL_OPTIONAL, type=field.TYPE_SFIXED64)
    message.field.add(name="length", number=2, label=field.LABEL_OPTIONAL, type=field.TYPE_UINT32)
    message.field.add(name="data", number=3, label=field.LABEL_OPTIONAL, type=field.TYPE_BYTES)
    return file


def _human_file() -> descriptor_pb2.FileDescriptorProto:
    file = descriptor_pb2.FileDescriptorProto()
    human_state_pb2.DESCRIPTOR.CopyToProto(file)
    return file


def _message_class(file: descriptor_pb2.FileDescriptorProto, name: str) -> Any:
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))


_Wire = _message_class(_wire_file(), "asc.v1.Wire")


def wire_message(t_ns: int, length: int, data: bytes) -> bytes:
    """A packet of `length` bytes that passed at monotonic `t_ns`; `data`: its beginning, or all of it."""
    message: bytes = _Wire(t_ns=t_ns, length=length, data=data).SerializeToString()
    return message


def parse_wire_message(message: bytes) -> tuple[int, int, bytes]:
    """Inverse of `wire_message`."""
    wire = _Wire.FromString(message)
    return wire.t_ns, wire.length, wire.data


_WIRE = _file_set(_wire_file())

CYCLE = Channel("/cell/cycle", "protobuf", record.NAME, _file_set(*record.file_descriptor_set().file))
WIRE_RX = Channel("/wire/rx", "protobuf", "asc.v1.Wire", _WIRE)
WIRE_TX = Channel("/wire/tx", "protobuf", "asc.v1.Wire", _WIRE)
HUMAN = Channel("/cell/human", "protobuf", "asc.v1.HumanState", _file_set(_human_file()))
OPERATOR = Channel("/cell/operator")
GOAL = Channel("/cell/goal")
CONTROL = Channel("/cell/control")
DROPOUT = Channel("/cell/dropout")  # {"cycle": n, "wire": n}: slots lost in the rings so far
TRUTH = Channel("/sim/truth")
HELLO = Channel("/session")  # one message before all others, so that the schemas are on disk from the first moment

CHANNELS = (CYCLE, WIRE_RX, WIRE_TX, HUMAN, OPERATOR, GOAL, CONTROL, DROPOUT, TRUTH, HELLO)
