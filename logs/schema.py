"""The channels of a recording: topic, encoding and schema of each. Writer and reader both speak from this table."""

from __future__ import annotations

import functools
import re
import struct
from dataclasses import dataclass
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
from google.protobuf.message import DecodeError

from asc_rt import human_state_pb2, record
from asc_rt.fixed_protobuf import FIXED64, LENGTH, VARINT, tag, varint

PROFILE = "asc"  # of the MCAP header
LIBRARY = "asc-rt logs.writer"

PARAMS, CELL, FINGERPRINT = "params.json", "cell.toml", "fingerprint.json"  # names of attachments
DECIDED = "params.decided.json"  # the parameters after the robot told its own limits, where they differ
PACKAGES, CLOCK, CERTIFICATE = "packages.txt", "clock.json", "certificate"
SESSION, END, RECOVERED = "session", "end", "recovered"  # names of metadata records


@dataclass(frozen=True, slots=True)
class Channel:
    """`encoding`: how messages are written, as MCAP names it. JSON channels have no schema: nobody plots them."""

    topic: str
    encoding: str = "json"
    schema_name: str = ""
    schema_data: bytes = b""

    @property
    def schema_encoding(self) -> str:
        if not self.schema_data:
            return ""
        return "ros2msg" if self.encoding == "cdr" else "protobuf"


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


def _message_class(name: str, *files: descriptor_pb2.FileDescriptorProto) -> Any:
    pool = descriptor_pool.DescriptorPool()
    for file in files:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))


_Wire = _message_class("asc.v1.Wire", _wire_file())


def wire_message(t_ns: int, length: int, data: bytes | memoryview) -> bytes:
    """A packet of `length` bytes that passed at monotonic `t_ns`; `data`: its beginning, or all of it."""
    return _WIRE_STAMP.pack(_WIRE_STAMP_TAG, t_ns) + _wire_head(length, len(data)) + data


_WIRE_STAMP, _WIRE_STAMP_TAG = struct.Struct("<Bq"), 1 << 3 | FIXED64


@functools.lru_cache(256)
def _wire_head(length: int, size: int) -> bytes:
    """Field 2, and tag and size of field 3. Written out, because every packet of every cycle passes here."""
    return tag(2, VARINT) + varint(length) + tag(3, LENGTH) + varint(size)


def parse_wire_message(message: bytes) -> tuple[int, int, bytes]:
    """Inverse of `wire_message`."""
    wire = _Wire.FromString(message)
    return wire.t_ns, wire.length, wire.data


# --- messages of others, by their published definitions ---------------------------------------------------------------


def _foxglove_file() -> descriptor_pb2.FileDescriptorProto:
    """FrameTransforms, Log, CompressedImage and CameraCalibration of Foxglove's schemas: the fields that we fill, under
    their numbers."""
    field = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="foxglove/asc.proto", package="foxglove", syntax="proto3")
    file.dependency.append("google/protobuf/timestamp.proto")
    level = file.enum_type.add(name="LogLevel")
    for number, name in enumerate(_LEVELS):
        level.value.add(name=name, number=number)

    def message(type_name: str, /, **fields: tuple[int, int, str]) -> None:
        made = file.message_type.add(name=type_name)
        for key, (number, kind, of) in fields.items():
            label = field.LABEL_REPEATED if key in ("transforms", *"DKRP") else field.LABEL_OPTIONAL
            made.field.add(name=key, number=number, label=label, type=kind, type_name=of or None)

    stamp = field.TYPE_MESSAGE, ".google.protobuf.Timestamp"
    real, text, inner = (field.TYPE_DOUBLE, ""), (field.TYPE_STRING, ""), field.TYPE_MESSAGE
    message("Vector3", x=(1, *real), y=(2, *real), z=(3, *real))
    message("Quaternion", x=(1, *real), y=(2, *real), z=(3, *real), w=(4, *real))
    message(
        "FrameTransform", timestamp=(1, *stamp), parent_frame_id=(2, *text), child_frame_id=(3, *text),
        translation=(4, inner, ".foxglove.Vector3"), rotation=(5, inner, ".foxglove.Quaternion"),
    )  # fmt: skip
    message("FrameTransforms", transforms=(1, inner, ".foxglove.FrameTransform"))
    level_type = (field.TYPE_ENUM, ".foxglove.LogLevel")
    message(
        "CompressedImage", timestamp=(1, *stamp), data=(2, field.TYPE_BYTES, ""), format=(3, *text),
        frame_id=(4, *text),
    )  # fmt: skip
    size = field.TYPE_FIXED32, ""
    message(
        "CameraCalibration", timestamp=(1, *stamp), width=(2, *size), height=(3, *size), distortion_model=(4, *text),
        D=(5, *real), K=(6, *real), R=(7, *real), P=(8, *real), frame_id=(9, *text),
    )  # fmt: skip
    message("Log", timestamp=(1, *stamp), level=(2, *level_type), message=(3, *text), name=(4, *text))
    return file


_LEVELS = ("UNKNOWN", "DEBUG", "INFO", "WARNING", "ERROR", "FATAL")


def _timestamp_file() -> descriptor_pb2.FileDescriptorProto:
    file = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(file)
    return file


_FOXGLOVE = _file_set(_timestamp_file(), _foxglove_file())
FrameTransforms = _message_class("foxglove.FrameTransforms", _timestamp_file(), _foxglove_file())
_Log = _message_class("foxglove.Log", _timestamp_file(), _foxglove_file())
CompressedImage = _message_class("foxglove.CompressedImage", _timestamp_file(), _foxglove_file())
CameraCalibration = _message_class("foxglove.CameraCalibration", _timestamp_file(), _foxglove_file())


def log_message(wall_ns: int, level: str, text: str) -> bytes:
    """A line for the viewers' log panels."""
    message = _Log(level=level, message=text, name="cell")
    message.timestamp.FromNanoseconds(wall_ns)
    data: bytes = message.SerializeToString()
    return data


def parse_log_message(data: bytes) -> tuple[str, str]:
    """(level, text) of `log_message`."""
    message = _Log.FromString(data)
    return _LEVELS[message.level], message.message


_JOINT_STATE = b"""std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""

# --- the channels ----------------------------------------------------------------------------------------------------

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
TRANSFORMS = Channel("/tf", "protobuf", "foxglove.FrameTransforms", _FOXGLOVE)
LOG = Channel("/log", "protobuf", "foxglove.Log", _FOXGLOVE)
JOINT_STATES = Channel("/joint_states", "cdr", "sensor_msgs/msg/JointState", _JOINT_STATE)
ROBOT_DESCRIPTION = Channel("/robot_description", "cdr", "std_msgs/msg/String", b"string data\n")
CAMERAS = "/cell/camera/"  # and the camera's name: one channel each, from its first image on
CALIBRATION = "/calibration"  # behind it: what its lens does, so that viewers can place the image
HELLO = Channel("/session")  # one message before all others, so that the schemas are on disk from the first moment

_CAMERA_NAME = re.compile(r"[a-z0-9_-]{1,32}")


def camera(image: bytes) -> Channel | None:
    """The channel of a foxglove.CompressedImage: depth as 16-bit PNG, or colour; its frame_id names the camera. None:
    no such image."""
    return _of_camera(CompressedImage, image)


def camera_calibration(calibration: bytes) -> Channel | None:
    """The channel of a foxglove.CameraCalibration, beside that of the camera's images. None: no such message."""
    return _of_camera(CameraCalibration, calibration, CALIBRATION)


def _of_camera(kind: Any, message: bytes, suffix: str = "") -> Channel | None:
    try:
        name = kind.FromString(message).frame_id
    except DecodeError:
        return None
    if not _CAMERA_NAME.fullmatch(name):
        return None
    return Channel(f"{CAMERAS}{name}{suffix}", "protobuf", kind.DESCRIPTOR.full_name, _FOXGLOVE)


DRAWN = (ROBOT_DESCRIPTION, TRANSFORMS, JOINT_STATES, LOG)  # for viewers that know nothing of us
CHANNELS = (CYCLE, WIRE_RX, WIRE_TX, HUMAN, OPERATOR, GOAL, CONTROL, DROPOUT, TRUTH, HELLO, *DRAWN)
