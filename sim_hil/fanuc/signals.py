"""Digital signals of the simulated controller, and the tool changer that is wired to them."""

from __future__ import annotations

DI, DO, RI, RO, FLAG = 1, 2, 8, 9, 35  # signal types as the classic wire numbers them
SIZES = {DI: 128, DO: 128, RI: 8, RO: 8, FLAG: 1024}  # how many are assigned. ASSUMED
WRITABLE = (DO, RO, FLAG)
WINDOW = 16

RELEASE = (RO, 1)  # on: the changer lets go of the tool
LOCKED, TOOL_PRESENT = (RI, 1), (RI, 2)
TOOL_IDENTITY = (RI, 3)  # first of IDENTITY_BITS, lowest bit first
IDENTITY_BITS = 4


class Unassigned(Exception):
    """A signal that the controller does not have, or an input that somebody wants to write."""


class Signals:
    def __init__(self, tool: int = 0) -> None:
        self._on: set[tuple[int, int]] = set()
        self.couple(tool)

    def __getitem__(self, signal: tuple[int, int]) -> bool:
        return signal in self._on

    def set(self, kind: int, index: int, on: bool) -> None:
        """As the machine around the robot does; `write` is what a program may do."""
        (self._on.add if on else self._on.discard)((kind, index))

    def couple(self, tool: int) -> None:
        """Put tool number `tool` (0: none) into the changer; not while it is told to let go."""
        if self[RELEASE]:
            return
        self.set(*LOCKED, True)
        self.set(*TOOL_PRESENT, tool > 0)
        for bit in range(IDENTITY_BITS):
            self.set(TOOL_IDENTITY[0], TOOL_IDENTITY[1] + bit, bool(tool >> bit & 1))

    def read(self, kind: int, index: int, mask: int) -> int:
        """16 signals from `index` on, under `mask`; bit k is signal index + k. Raises Unassigned."""
        return sum(self[(kind, index + bit)] << bit for bit in self._bits(kind, index, mask))

    def write(self, kind: int, index: int, mask: int, value: int) -> None:
        """Raises Unassigned, having written nothing."""
        bits = self._bits(kind, index, mask)
        if kind not in WRITABLE:
            raise Unassigned(f"type {kind} is not an output")
        for bit in bits:
            self.set(kind, index + bit, bool(value >> bit & 1))
        if self[RELEASE]:
            self.set(*LOCKED, False)
            self.set(*TOOL_PRESENT, False)
            for bit in range(IDENTITY_BITS):
                self.set(TOOL_IDENTITY[0], TOOL_IDENTITY[1] + bit, False)

    @staticmethod
    def _bits(kind: int, index: int, mask: int) -> list[int]:
        bits = [bit for bit in range(WINDOW) if mask >> bit & 1]
        if kind not in SIZES or any(not 1 <= index + bit <= SIZES[kind] for bit in bits):
            raise Unassigned(f"type {kind}, index {index}, mask {mask:#06x}")
        return bits
