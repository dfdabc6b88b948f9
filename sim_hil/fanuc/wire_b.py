"""The simulated controller's own view of the ROS 2 wire of Stream Motion, as tables of fields.

Written from the packet description alone, as `wire` is for the classic one. Degrees, millimetres, URDF J3.
"""

from __future__ import annotations

import numpy as np

from sim_hil.fanuc.wire import STAGES, Malformed, Packet, Table, pack, unpack

USABLE_VERSIONS = (3, 4)
SLOTS = 32
SIGNAL_BYTES = 256
JOINT_DATA = 0xFFFF  # of the word that the headers call unused

_HEAD = [("type", ">u4"), ("version", ">u4")]
_CAPABILITY = _HEAD + [
    ("id", ">u4"),
    ("sampling_rate", ">u4"),
    ("start_move", ">u4"),
    ("available_version", ">u4"),
    ("rob_status_use_tcp", ">u4"),
]
_THRESHOLD_REQUEST = _HEAD + [("axis", ">u4"), ("kind", ">u4")]
_THRESHOLDS = _THRESHOLD_REQUEST + [
    ("max_speed", ">u4"),
    ("interval", ">u4"),
    ("no_payload", ">f4", STAGES),
    ("full_payload", ">f4", STAGES),
]
_SLOT = [("kind", ">u4"), ("signal", ">u4"), ("first", ">u4"), ("length", ">u4")]
_STATUS = _HEAD + [
    ("sequence", ">u4"),
    ("status", "u1"),
    ("robot_status", "u1"),
    ("contact_stop", "u1"),
    ("unused", "u1"),
    ("time_stamp", ">u4"),
    ("pose", ">f4", 9),
    ("joints", ">f4", 9),
    ("current", ">f4", 9),
    ("safety_scale", ">f4"),
]
_FORCE = [("force", ">f4", 3), ("moment", ">f4", 3), ("force_sensor", ">u4")]
_SIGNALS = [("signals", "u1", SIGNAL_BYTES)]
_COMMAND = (
    _HEAD + [("sequence", ">u4"), ("last", "u1"), ("motion", "u1"), ("word", ">u2"), ("position", ">f8", 9)] + _SIGNALS
)

REQUESTS: Table = {
    2: ("stop", np.dtype(_HEAD)),
    3: ("thresholds", np.dtype(_THRESHOLD_REQUEST)),
    7: ("get_capability", np.dtype(_CAPABILITY)),
    8: ("set_capability", np.dtype(_CAPABILITY)),
    200: ("start", np.dtype(_HEAD)),
    201: ("command", np.dtype(_COMMAND)),
    203: ("gpio", np.dtype([*_HEAD, ("slots", _SLOT, SLOTS)])),
    205: ("force", np.dtype([*_HEAD, ("do_reset", ">u4"), ("force_sensor", ">u4")])),
}
REPLIES: Table = {
    3: ("thresholds", np.dtype(_THRESHOLDS)),
    7: ("get_capability", np.dtype(_CAPABILITY)),
    8: ("set_capability", np.dtype(_CAPABILITY)),
    202: ("status", np.dtype(_STATUS + _SIGNALS)),
    203: ("gpio", np.dtype([("type", ">u4"), ("result", ">u4"), ("ptf", ">u4")])),
    204: ("status_force", np.dtype(_STATUS + _FORCE + _SIGNALS)),
}


def read_request(data: bytes) -> Packet:
    """A packet from the PC. Raises Malformed."""
    packet = unpack(data, REQUESTS)
    if packet.name == "command" and not (packet["last"] <= 1 and packet["motion"] <= 1):
        raise Malformed(f"last {packet['last']}, motion {packet['motion']}")
    if packet.name == "thresholds" and not (1 <= packet["axis"] <= 9 and packet["kind"] <= 2):
        raise Malformed(f"thresholds of axis {packet['axis']}, kind {packet['kind']}")
    return packet


def read_reply(data: bytes) -> Packet:
    """A packet from a controller. Raises Malformed."""
    return unpack(data, REPLIES)


def write_reply(name: str, version: int, **values: object) -> bytes:
    return pack(REPLIES, name, version, values)


def write_request(name: str, version: int, **values: object) -> bytes:
    """What a PC sends, for the tests of the controller."""
    return pack(REQUESTS, name, version, values)
