"""A control process in miniature, to be killed: puts the record of cycle 0, 1, 2, ... into a ring until it dies.

python produce.py RING RECORD TICK_OFFSET T_OFFSET
"""

import struct
import sys
import time
from pathlib import Path

from asc_rt.ring import RingWriter, wire_path, wire_tap

ring_path, record_path, tick_offset, t_offset = sys.argv[1:]
record = bytearray(Path(record_path).read_bytes())
with RingWriter(ring_path) as cycles, RingWriter(wire_path(ring_path)) as wire:
    tap, tick = wire_tap(wire), cycles.head
    while True:
        t_ns = time.monotonic_ns()
        struct.pack_into("<q", record, int(tick_offset), tick)
        struct.pack_into("<q", record, int(t_offset), t_ns)
        tap("rx", t_ns, b"status")
        cycles.put(record)
        tap("tx", t_ns, b"command")
        tick += 1
        time.sleep(0.001)
