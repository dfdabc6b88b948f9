"""The cycle record: one table of every field that a cycle has, and what follows from it.

`TABLE` is the only description. From it come, for a robot of n joints, the packed bytes that the loop writes (a valid
protobuf `asc.v1.CycleRecord`), the numpy dtype that reads them back as columns, and the FileDescriptorSet that lets any
tool read them.

The record ends in a CRC-32 of all that is before it, so that a changed byte is found even where no output depends on it
(see `logs.diff.altered`). The logger writes it, `seal`: the loop has no time for it.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

import numpy as np
from google.protobuf import descriptor_pb2

from asc_rt.core.params import MAX_SENSORS
from asc_rt.core.types import (
    MAX_CAPSULES,
    MAX_PAIRS,
    CommandKind,
    CoreState,
    CycleInputs,
    CycleOutputs,
    EventKind,
    Goal,
    Health,
    HumanState,
    JointCommand,
    JointState,
    MessageFault,
    Mode,
    Monitor,
    OperatorEvent,
    Pairs,
    RobotFlag,
    SafetyDecision,
    SensorReport,
    Status,
    StopReason,
    StopRequest,
)
from asc_rt.fixed_protobuf import (
    COLUMN,
    FIXED32,
    INDICES,
    JOINTS,
    NUMBERS,
    PACKAGE,
    POINTS,
    Array,
    Buffer,
    FieldProto,
    Leaf,
    Message,
    Part,
    Unsigned,
    add_field,
    describe,
    tag,
)
from asc_rt.inputs import MAX_EVENTS
from asc_rt.packing import RecordError, compiled
from drivers.base import WriteReceipt

NAME = f"{PACKAGE}.CycleRecord"


@dataclass(slots=True)
class Timings:
    """Monotonic ns of this cycle, for the report only: nothing that is replayed depends on them. Not frozen: that would
    take longer to make, and it is made in every cycle."""

    t_wake_ns: int  # the loop is running again: sample received, or deadline reached
    t_read_ns: int  # inputs frozen
    t_step_end_ns: int
    t_write_end_ns: int


# --- the table -------------------------------------------------------------------------------------------------------

GOAL = {"id": int, "q": JOINTS}
STATE = Message(
    CoreState,
    {
        "tick": int, "mode": Mode, "reason": StopReason, "slow": StopReason, "reached_id": int, "event_id": int,
        "silent_cycles": int, "ending": bool, "tool": int, "q_cmd": JOINTS, "dq_cmd": JOINTS, "ddq_cmd": JOINTS,
        "goal": Message(Goal, GOAL),
    },
)  # fmt: skip
JOINT = Message(
    JointState,
    {
        "t_rx_ns": int, "t_device_ns": int, "seq": int, "flags": RobotFlag, "tool_id": int, "dq_is_estimated": bool,
        "q": JOINTS, "dq": JOINTS, "current": JOINTS,
    },
    optional=True,
)  # fmt: skip
HUMAN = Message(
    HumanState,
    {
        "t_capture_ns": int, "seq": int, "sensor_id": int, "calibration_hash": Unsigned, "health": Health,
        "coverage": float, "empty_certified": bool,
        "p0": POINTS, "p1": POINTS, "v0": POINTS, "v1": POINTS,
        "radius": COLUMN, "position_bound": COLUMN, "velocity_bound": COLUMN, "visibility": INDICES,
    },
    optional=True,
    capacity=MAX_CAPSULES,
    kept=True,  # people are seen less often than the loop goes round
)  # fmt: skip
EVENT = {"id": INDICES, "kind": Array("<i8", kind=EventKind), "tool": INDICES}
SENSOR = {
    "id": INDICES, "seq": INDICES, "age_ns": INDICES, "sigma_ns": INDICES, "fault": Array("<i8", kind=MessageFault),
    "health": Array("<i8", kind=Health), "says_nothing": Array("<i8", kind=bool), "coverage": COLUMN,
    "calibration_hash": NUMBERS,
}  # fmt: skip
INPUTS = Message(
    CycleInputs,
    {
        "tick": int, "t_ns": int, "period_ns": int, "human_age_ns": int, "missed_ticks": int,
        "late": bool, "joint": JOINT, "human": HUMAN, "goal": Message(Goal, GOAL, optional=True, kept=True),
        "events": Message(OperatorEvent, EVENT, capacity=MAX_EVENTS, rows=True, kept=True),
        "sensors": Message(SensorReport, SENSOR, capacity=MAX_SENSORS, rows=True),
    },
)  # fmt: skip
PAIRS = Message(
    Pairs,
    {
        "robot": INDICES, "human": INDICES, "d": COLUMN, "d_dot": COLUMN, "M": COLUMN, "M_dot": COLUMN, "phi": COLUMN,
        "phi_dot": COLUMN, "floor": COLUMN, "achieved": COLUMN, "basis": INDICES, "outside": INDICES,
    },
    capacity=MAX_PAIRS,
    table=True,
)  # fmt: skip
MONITOR = Message(
    Monitor,
    {
        "distance": float, "protective_distance": float, "robot_speed": float, "age": float, "reaction_time": float,
        "stopping_time": float,
    },
    optional=True,
)  # fmt: skip
DECISION = Message(
    SafetyDecision,
    {
        "status": Status, "reason": StopReason, "pair_count": int, "iterations": int, "share": float,
        "d_measured": float, "d_goal": float, "u_ref": JOINTS, "u_safe": JOINTS, "pairs": PAIRS,
        "monitor": MONITOR,
    },
)  # fmt: skip
COMMAND = Message(
    JointCommand,
    {"tick": int, "kind": CommandKind, "is_last": bool, "q": JOINTS, "dq": JOINTS, "tau": JOINTS},
    optional=True,
)
OUTPUTS = Message(
    CycleOutputs,
    {
        "decision": DECISION,
        "command": COMMAND,
        "stop": Message(StopRequest, {"reason": StopReason}, optional=True, kept=True),
    },
)
RECEIPT = Message(WriteReceipt, {"t_tx_ns": int, "seq": int, "ok": bool, "q": JOINTS}, optional=True)
TIMINGS = Message(Timings, {"t_wake_ns": int, "t_read_ns": int, "t_step_end_ns": int, "t_write_end_ns": int})

TABLE = {"state": STATE, "inputs": INPUTS, "outputs": OUTPUTS, "receipt": RECEIPT, "timings": TIMINGS}
CHECK_NUMBER = len(TABLE) + 1  # the check's protobuf field
CHECK_SIZE = 4


# --- the record ------------------------------------------------------------------------------------------------------


class RecordLayout:
    """The record of a robot with n joints: sizes, places, and both ways between dataclasses and bytes."""

    def __init__(self, n: int) -> None:
        self.n = n
        self.parts: dict[str, Part] = {}
        offset = 0
        for number, (name, message) in enumerate(TABLE.items(), start=1):
            self.parts[name] = Part(name, number, message, n, offset)
            offset += self.parts[name].size
        self._check_tag = tag(CHECK_NUMBER, FIXED32)
        self._checked = offset  # bytes that the check covers
        self._check_offset = offset + len(self._check_tag)
        self.size = self._check_offset + CHECK_SIZE
        self._parts = tuple(self.parts.values())
        pieces = [piece for part in self._parts for piece in part.pieces]
        names = {name: packer for part in self._parts for name, packer in part.names.items()}
        self._pack_into = compiled([*pieces, self._check_tag + bytes(CHECK_SIZE)], ", ".join(self.parts), names)
        check = Leaf("check", self._check_tag, "I", "<u4", (), int, self._check_offset)
        self.leaves = [leaf for part in self._parts for leaf in part.leaves] + [check]
        self.dtype = np.dtype(
            {
                "names": [leaf.path for leaf in self.leaves],
                "formats": [(leaf.format, leaf.shape) for leaf in self.leaves],
                "offsets": [leaf.offset for leaf in self.leaves],
                "itemsize": self.size,
            }
        )

    def buffer(self) -> bytearray:
        """Room for one record, to be used again and again."""
        return bytearray(self.size)

    def pack(
        self,
        into: bytearray | memoryview,
        before: CoreState,
        inputs: CycleInputs,
        outputs: CycleOutputs,
        receipt: WriteReceipt | None,
        timings: Timings,
        at: int = 0,
    ) -> None:
        """Write one whole record, but not its check, into what `buffer` gave, or from byte `at` of other memory on.
        RecordError: something does not fit; `into` holds no record then."""
        try:
            self._pack_into(into, at, before, inputs, outputs, receipt, timings)
        except struct.error as error:
            raise RecordError(f"a number does not fit into the record: {error}") from error

    def sealed(self, record: Buffer) -> bytes:
        """The record with the check that belongs to the bytes before it."""
        view = memoryview(record)
        return b"".join((view[: self._check_offset], zlib.crc32(view[: self._checked]).to_bytes(CHECK_SIZE, "little")))

    def syndrome(self, record: Buffer) -> int:
        """CRC of the bytes XOR the CRC that the record carries: 0 as written."""
        told: int = struct.unpack_from("<I", record, self._check_offset)[0]
        return zlib.crc32(memoryview(record)[: self._checked]) ^ told

    def unpack(self, record: Buffer) -> tuple[CoreState, CycleInputs, CycleOutputs]:
        """Exact inverse of `pack`: equal values give equal bytes again. RecordError: not a record of this layout."""
        if len(record) != self.size:
            raise RecordError(f"a record of {self.n} joints has {self.size} bytes, this one {len(record)}")
        p = self.parts
        return p["state"].unpack(record), p["inputs"].unpack(record), p["outputs"].unpack(record)

    def unpack_rest(self, record: Buffer) -> tuple[WriteReceipt | None, Timings]:
        return self.parts["receipt"].unpack(record), self.parts["timings"].unpack(record)


def file_descriptor_set() -> descriptor_pb2.FileDescriptorSet:
    """The schema for readers. proto2, because there a zero that was written stays a field that is present."""
    file = descriptor_pb2.FileDescriptorProto(name="asc/v1/cycle_record.proto", package=PACKAGE, syntax="proto2")
    record = file.message_type.add(name="CycleRecord")
    for number, (name, message) in enumerate(TABLE.items(), start=1):
        add_field(record, name, number, FieldProto.TYPE_MESSAGE, describe(file, message))
    add_field(record, "check", CHECK_NUMBER, FieldProto.TYPE_FIXED32)
    return descriptor_pb2.FileDescriptorSet(file=[file])
