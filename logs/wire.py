"""Does the record say what was on the wire? Every raw packet goes through the driver's codec once more.

Received bytes must decode to the logged joint state, and the logged command must encode to the bytes that were sent.
A driver without `drivers.base.ReplayCodec` can be checked for the presence of its packets only.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from asc_rt.core.types import CommandKind, JointCommand
from drivers import registry
from drivers.base import DriverError, ReplayCodec
from logs import schema
from logs.recording import Recording

Column = np.ndarray[Any, Any]
Packets = tuple[dict[int, bytes], dict[int, bytes]]  # received and sent: time -> bytes

TOLERANCE = 1e-6  # rad: float32 degrees of the wire are up to 2.7e-7 rad off

FIELDS = (
    "inputs.tick", "inputs.joint.present", "inputs.joint.t_rx_ns", "inputs.joint.seq", "inputs.joint.q",
    "inputs.joint.current", "receipt.present", "receipt.ok", "receipt.t_tx_ns", "receipt.seq", "receipt.q",
    "outputs.command.kind", "outputs.command.q", "outputs.command.dq", "outputs.command.tau",
    "outputs.command.is_last",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class WireReport:
    packets: int  # in the log; 0: there is nothing to compare with
    decoded: bool  # by the driver's codec; False: only their presence was checked
    mismatches: int  # cycles whose sample or command is not what passed on the wire
    first: str  # the first of them, in words


def replay_wire(
    log: Recording,
    columns: dict[str, Column] | None = None,
    decode: Sequence[int] | None = None,
    passed: Packets | None = None,
) -> WireReport:
    """`columns`: FIELDS of all cycles, `passed`: all packets, if they are at hand. `decode`: cycles that go through
    the codec; None: all.

    LogError: the file.
    """
    c = columns or log.columns(*FIELDS)
    received, sent = passed or packets(log)
    codec = codec_of(log)
    if not received and not sent:
        return WireReport(0, codec is not None, 0, "")
    heard = c["inputs.joint.present"] == 1
    claimed = (c["receipt.present"] == 1) & (c["receipt.ok"] == 1)
    off = np.abs(c["receipt.q"] - c["outputs.command.q"]).max(axis=1, initial=0.0)
    checks = {
        "no packet was received at the time of its sample": heard & ~_among(c["inputs.joint.t_rx_ns"], received),
        "no packet was sent at the time of its command": claimed & ~_among(c["receipt.t_tx_ns"], sent),
        "something else was sent than decided": claimed & ~(off <= getattr(codec, "resolution", TOLERANCE)),
    }
    wrong = {int(i): words for words, bad in checks.items() for i in np.flatnonzero(bad)}
    if codec is not None:
        for i in range(len(heard)) if decode is None else decode:
            if i in wrong:
                continue
            words = _heard(c, i, received, codec) if heard[i] else ""
            if words := words or (_said(c, i, sent, codec) if claimed[i] else ""):
                wrong[i] = words
    first = min(wrong, default=None)
    told = "" if first is None else f"cycle {int(c['inputs.tick'][first])}: {wrong[first]}"
    return WireReport(len(received) + len(sent), codec is not None, len(wrong), told)


def _among(times: Column, packets: dict[int, bytes]) -> Column:
    found: Column = np.isin(times, np.fromiter(packets, np.int64, len(packets)))
    return found


def driver_of(log: Recording) -> str:
    """Name of the driver that the session had; "": none that can be read."""
    try:
        return str(json.loads(log.session.get("driver", "{}"))["name"])
    except (ValueError, KeyError, TypeError):
        return ""


def codec_of(log: Recording) -> ReplayCodec | None:
    """The codec of the driver that the session had."""
    try:
        table = json.loads(log.session.get("driver", "{}"))
        driver = registry.driver_class(table.pop("name"))(table)
    except (ValueError, KeyError, TypeError, AttributeError):  # another version of the driver, or none of ours
        return None
    return driver if isinstance(driver, ReplayCodec) else None


def packets(log: Recording) -> Packets:
    found: dict[str, dict[int, bytes]] = {schema.WIRE_RX.topic: {}, schema.WIRE_TX.topic: {}}
    for message in log.messages(*found):
        t_ns, _, data = schema.parse_wire_message(message.data)
        found[message.topic][t_ns] = data
    return found[schema.WIRE_RX.topic], found[schema.WIRE_TX.topic]


def _heard(c: dict[str, Column], i: int, received: dict[int, bytes], codec: ReplayCodec) -> str:
    """What is wrong with the sample of cycle i; "": nothing."""
    try:
        told = codec.decode_sample(received[int(c["inputs.joint.t_rx_ns"][i])])
    except DriverError as error:
        return f"its sample does not decode: {error}"
    if told is None:
        return "the packet of its sample is of another kind"
    seq, q, current = told
    same = seq == c["inputs.joint.seq"][i] and np.array_equal(q, c["inputs.joint.q"][i])
    return "" if same and np.array_equal(current, c["inputs.joint.current"][i]) else "its sample decodes otherwise"


def _said(c: dict[str, Column], i: int, sent: dict[int, bytes], codec: ReplayCodec) -> str:
    """What is wrong with the command of cycle i; "": nothing."""
    kind, last = CommandKind(int(c["outputs.command.kind"][i])), bool(c["outputs.command.is_last"][i])
    q, dq, tau = (c[f"outputs.command.{name}"][i] for name in ("q", "dq", "tau"))
    command = JointCommand(int(c["inputs.tick"][i]), kind, q, dq, tau, last)
    again = codec.encode_command(int(c["receipt.seq"][i]), command)
    return "" if again == sent[int(c["receipt.t_tx_ns"][i])] else "its command encodes to other bytes than were sent"
