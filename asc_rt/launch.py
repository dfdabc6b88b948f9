"""How a process of ours is launched: its arguments, and being told to end."""

from __future__ import annotations

import argparse
import signal
from typing import NoReturn


class OneLineParser(argparse.ArgumentParser):
    """Bad usage is one line and exit code 2, not the usage as well."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"error: {message}\n")


def add_overrides(parser: argparse.ArgumentParser) -> None:
    """`--set KEY=VALUE`, as often as wanted: the `set` of load_cell."""
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="put over the cell file")


def told_to_end() -> list[int]:
    """From now on SIGTERM and SIGINT are put into this list, and end nothing by themselves."""
    told: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda signum, _: told.append(signum))
    return told
