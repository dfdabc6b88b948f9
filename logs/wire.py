"""Does the record say what was on the wire? Every raw packet goes through the driver's codec once more.

Received bytes must decode to the logged joint state, and the logged command must encode to the bytes that were sent.
A driver without `drivers.base.ReplayCodec` can be checked for the presence of its packets only.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivers import registry
from drivers.base import DriverError, ReplayCodec
from logs import schema
from logs.reader import Log

TOLERANCE = 1e-6  # rad: float32 degrees of the wire are up to 2.7e-7 rad off

_FIELDS = (
    "inputs.tick", "inputs.joint.present", "inputs.joint.t_rx_ns", "inputs.joint.seq", "inputs.joint.q",
    "inputs.joint.current", "receipt.present", "receipt.ok", "receipt.t_tx_ns", "receipt.seq", "receipt.q",
    "outputs.command.q", "outputs.command.is_last",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class WireReport:
    packets: int  # in the log; 0: there is nothing to compare with
    decoded: bool  # by the driver's codec; False: only their presence was checked
    mismatches: int  # cycles whose sample or command is not what passed on the wire
    first: str  # the first of them, in words


def replay_wire(log: Log) -> WireReport:
    """LogError: the file."""
    received, sent = (_packets(log, channel) for channel in (schema.WIRE_RX, schema.WIRE_TX))
    codec = codec_of(log)
    if not received and not sent:
        return WireReport(0, codec is not None, 0, "")
    mismatches, first = 0, ""
    for batch in log.batches():
        columns = {name: batch[name] for name in _FIELDS}
        for i in range(len(batch)):
            row = {name: column[i] for name, column in columns.items()}
            wrong = _heard(row, received, codec) or _said(row, sent, codec)
            mismatches += bool(wrong)
            if wrong and not first:
                first = f"cycle {int(row['inputs.tick'])}: {wrong}"
    return WireReport(len(received) + len(sent), codec is not None, mismatches, first)


def codec_of(log: Log) -> ReplayCodec | None:
    """The codec of the driver that the session had."""
    try:
        table = json.loads(log.session.get("driver", "{}"))
        driver = registry.driver_class(table.pop("name"))(table)
    except (ValueError, KeyError, TypeError, AttributeError):  # another version of the driver, or none of ours
        return None
    return driver if isinstance(driver, ReplayCodec) else None


def _packets(log: Log, channel: schema.Channel) -> dict[int, bytes]:
    """Time -> bytes."""
    found = (schema.parse_wire_message(message.data) for message in log.messages(channel.topic))
    return {t_ns: data for t_ns, _, data in found}


def _heard(row: dict[str, Any], received: dict[int, bytes], codec: ReplayCodec | None) -> str:
    """What is wrong with the sample; "": nothing."""
    if not row["inputs.joint.present"]:
        return ""
    data = received.get(int(row["inputs.joint.t_rx_ns"]))
    if data is None:
        return "no packet was received at the time of its sample"
    if codec is None:
        return ""
    try:
        told = codec.decode_sample(data)
    except DriverError as error:
        return f"its sample does not decode: {error}"
    if told is None:
        return "the packet of its sample is of another kind"
    seq, q, current = told
    same = seq == row["inputs.joint.seq"] and np.array_equal(q, row["inputs.joint.q"])
    return "" if same and np.array_equal(current, row["inputs.joint.current"]) else "its sample decodes otherwise"


def _said(row: dict[str, Any], sent: dict[int, bytes], codec: ReplayCodec | None) -> str:
    """What is wrong with the command; "": nothing, or nothing claims to have been sent."""
    if not (row["receipt.present"] and row["receipt.ok"]):
        return ""
    data = sent.get(int(row["receipt.t_tx_ns"]))
    if data is None:
        return "no packet was sent at the time of its command"
    if not abs(row["receipt.q"] - row["outputs.command.q"]).max() <= TOLERANCE:
        return "something else was sent than decided"
    if codec is None:
        return ""
    last = bool(row["outputs.command.is_last"])
    again = codec.encode_set_point(int(row["receipt.seq"]), row["outputs.command.q"], last)
    return "" if again == data else "its command encodes to other bytes than were sent"
