"""What is wrong with the files of a cell: all of it, one line each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path


class Faults(list[str]):
    def note(self, path: Path, key: str, text: str) -> None:
        """One line: file, key, what is wrong; what would be right."""
        self.append(f"{path}: {key}: {text}")


class FaultsError(Exception):
    """`lines`: one per fault, each with what would be right."""

    def __init__(self, lines: Sequence[str]) -> None:
        super().__init__("\n".join(lines))
        self.lines = tuple(lines)
