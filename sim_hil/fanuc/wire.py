"""The simulated controller's own view of the classic Stream Motion wire, versions 1-3, as tables of fields.

Written from the packet description alone and sharing nothing with the driver, so that the two can disagree. Values stay
as they are on the wire: degrees, millimetres, FANUC J3.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Axes = npt.NDArray[np.float64]
Table = Mapping[int, tuple[str, np.dtype[np.void]]]  # packet type -> name, fields

USABLE_VERSIONS = (1, 2, 3)
STAGES = 20
CARTESIAN, JOINT = 0, 1  # data_style of a command
IMPLAUSIBLE = 1e6  # deg or mm: beyond it a number is garbage, such as floats in the wrong byte order

_HEAD = [("type", ">u4"), ("version", ">u4")]
_COMMAND = _HEAD + [
    ("sequence", ">u4"),
    ("last_data", "u1"),
    ("read_type", "u1"),
    ("read_index", ">u2"),
    ("read_mask", ">u2"),
    ("data_style", "u1"),
    ("write_type", "u1"),
    ("write_index", ">u2"),
    ("write_mask", ">u2"),
    ("write_value", ">u2"),
]
_POSE_JOINTS = [("pose", ">f4", 9), ("joints", ">f4", 9)]

REQUESTS: Table = {
    0: ("start", np.dtype(_HEAD)),
    1: ("command", np.dtype(_COMMAND + [("unused", ">u2"), ("position", ">f4", 9)])),
    2: ("stop", np.dtype(_HEAD)),
    3: ("thresholds", np.dtype(_HEAD + [("axis", ">u4"), ("kind", ">u4")])),
    4: ("commanded", np.dtype(_HEAD)),
    5: ("command", np.dtype(_COMMAND + [("unused", ">u2", 3), ("position", ">f8", 9)])),
    6: ("version", np.dtype(_HEAD)),
}
REPLIES: Table = {
    0: (
        "status",
        np.dtype(
            _HEAD
            + [
                ("sequence", ">u4"),
                ("status", "u1"),
                ("read_type", "u1"),
                ("read_index", ">u2"),
                ("read_mask", ">u2"),
                ("read_value", ">u2"),
                ("time_stamp", ">u4"),
            ]
            + _POSE_JOINTS
            + [("current", ">f4", 9)]
        ),
    ),
    3: (
        "thresholds",
        np.dtype(
            _HEAD
            + [("axis", ">u4"), ("kind", ">u4"), ("max_speed", ">u4"), ("interval", ">u4")]
            + [("no_payload", ">f4", STAGES), ("full_payload", ">f4", STAGES)]
        ),
    ),
    4: ("commanded", np.dtype(_HEAD + [("time_stamp", ">u4")] + _POSE_JOINTS)),
    6: ("version", np.dtype(_HEAD)),
}


class Malformed(Exception):
    """Bytes that are no packet of this wire; the text says why."""


@dataclass(frozen=True, slots=True)
class Packet:
    name: str
    type: int
    version: int
    fields: np.void

    def __getitem__(self, field: str) -> int:
        return int(self.fields[field])

    def axes(self, field: str) -> Axes:
        return np.asarray(self.fields[field], dtype=np.float64)


def read_request(data: bytes) -> Packet:
    """A packet from the PC. Raises Malformed."""
    packet = unpack(data, REQUESTS)
    if packet.type == 5 and packet.version < 2:
        raise Malformed("double precision command in version 1")
    if packet.name == "command":
        if packet["last_data"] > 1:
            raise Malformed(f"last_data is {packet['last_data']}")
        if packet["data_style"] > 1:
            raise Malformed(f"data style {packet['data_style']}")
        if packet.type == 5 and packet["data_style"] == CARTESIAN:
            raise Malformed("Cartesian command in double precision")
    if packet.name == "thresholds" and not (1 <= packet["axis"] <= 9 and packet["kind"] <= 2):
        raise Malformed(f"thresholds of axis {packet['axis']}, kind {packet['kind']}")
    return packet


def read_reply(data: bytes) -> Packet:
    """A packet from a controller. Raises Malformed."""
    return unpack(data, REPLIES)


def unpack(data: bytes, table: Table) -> Packet:
    """One packet of `table`. Raises Malformed."""
    if len(data) < 8:
        raise Malformed(f"{len(data)} bytes")
    number, version = (int(x) for x in np.frombuffer(data, ">u4", 2))
    if number not in table:
        raise Malformed(f"packet type {number}")
    name, layout = table[number]
    # How long a version reply is was never documented: its header alone counts.
    if len(data) != layout.itemsize and not (name == "version" and table is REPLIES):
        raise Malformed(f"{name} of {len(data)} bytes instead of {layout.itemsize}")
    if version == 0 and "version" in (layout.names or ()):
        raise Malformed(f"{name} of version 0")
    fields = np.frombuffer(data, layout, 1)[0]
    for field in layout.names or ():
        if layout[field].base.kind == "f":
            with np.errstate(invalid="ignore"):  # signalling NaN
                values = np.abs(fields[field].astype(np.float64))
            if not np.all(values <= IMPLAUSIBLE):
                raise Malformed(f"{name} with a {field} that is not a number to go by")
    return Packet(name, number, version, fields)


def write_reply(name: str, version: int, **values: object) -> bytes:
    return pack(REPLIES, name, version, values)


def write_request(name: str, version: int, **values: object) -> bytes:
    """What a PC sends, for the tests of the controller. A command is double precision from version 2 on."""
    table = REQUESTS if version > 1 else {k: v for k, v in REQUESTS.items() if k != 5}
    return pack(table, name, version, values)


def pack(table: Table, name: str, version: int, values: dict[str, object]) -> bytes:
    """The packet `name` of `table`; fields that are not given are 0."""
    number = max(k for k, (known, _) in table.items() if known == name)
    fields = np.zeros(1, table[number][1])
    head = {"type": number, "version": version} if "version" in (table[number][1].names or ()) else {"type": number}
    for field, value in {**head, **values}.items():
        fields[field] = value
    return fields.tobytes()
