"""The frames of a recorded session as a standard CAN log: candump (.log), ASC, BLF, whatever python-can writes."""

from __future__ import annotations

from collections.abc import Iterable

import can

from drivers.can.frame import unbundle

FORMATS = (".log", ".asc", ".blf")


def write(packets: Iterable[tuple[str, int, bytes]], path: str, channel: str) -> int:
    """`packets`: (direction, monotonic ns, bundle), in the order of time; how many frames were written.

    A bundle holds every axis' newest answer: one that was repeated because its axis missed the cycle is left out.
    """
    count = 0
    with can.Logger(path) as log:
        for direction, t_ns, data in packets:
            _, missed, _, frames = unbundle(data)
            for k, (age, frame) in enumerate(zip(missed, frames, strict=True)):
                if age:
                    continue
                log.on_message_received(
                    can.Message(
                        timestamp=(t_ns + k * 1000) * 1e-9,  # the order of one cycle's frames
                        arbitration_id=frame.id,
                        is_extended_id=False,
                        is_fd=frame.is_fd,
                        bitrate_switch=frame.is_fd,
                        is_rx=direction == "rx",
                        data=frame.data,
                        channel=channel,
                    )
                )
                count += 1
    return count
