"""The layer setting services of a simulated CANopen node (CiA 305): how it comes by a number. Its code is its own."""

from __future__ import annotations

import struct
from dataclasses import dataclass

MASTER_ID, NODE_ID = 0x7E5, 0x7E4
NO_NUMBER = 255
CONFIGURE, STORE, IDENTIFIED, IS_NAMELESS = 0x11, 0x17, 0x4F, 0x50
ALL_BITS_OPEN = 128


@dataclass(slots=True)
class Lss:
    """Waiting until it is switched, or found by the fast scan, into configuration."""

    identity: tuple[int, int, int, int]  # vendor, product, revision, serial: 1018h
    number: int  # NO_NUMBER: none; it then takes part in nothing but this
    stores: bool = True
    is_configured: bool = False
    wanted: int = NO_NUMBER
    following: int = 0  # which part of the identity the scan asks for next

    def hear(self, data: bytes) -> bytes | None:
        """Its answer to a message of the master."""
        match data[0]:
            case 0x04:
                self.is_configured = data[1] == 1
                if not self.is_configured and self.wanted != NO_NUMBER:
                    self.number, self.wanted = self.wanted, NO_NUMBER
            case 0x4C if self.number == NO_NUMBER:
                return bytes([IS_NAMELESS, *[0] * 7])
            case 0x51 if self.number == NO_NUMBER and not self.is_configured:
                return bytes([IDENTIFIED, *[0] * 7]) if self._scan(data) else None
            case 0x11 if self.is_configured:
                fits = 1 <= data[1] <= 127
                self.wanted = data[1] if fits else self.wanted
                return bytes([CONFIGURE, 0 if fits else 1, *[0] * 6])
            case 0x17 if self.is_configured:
                return bytes([STORE, 0 if self.stores else 1, *[0] * 6])
        return None

    def _scan(self, data: bytes) -> bool:
        """Is it among those whose identity begins like this, down to the bit that is asked for?"""
        number, bit, part, following = struct.unpack_from("<IBBB", data, 1)
        if bit == ALL_BITS_OPEN:
            self.following = 0
            return True
        if part != self.following or bit > 31 or (self.identity[part] ^ number) >> bit:
            return False
        if bit == 0:
            self.is_configured = following < part  # the last part was the last one asked for
            self.following = following
        return True
