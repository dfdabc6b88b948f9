"""`python -m sim_hil DEVICE CELL ...`: one simulated device, or a suite of trials, as a process of its own."""

from __future__ import annotations

import sys

from asc_rt import realtime

USAGE = "usage: python -m sim_hil {fanuc CELL | human CELL | trials SUITE} [options]"


def main(argv: list[str]) -> int:
    match argv:
        case ["fanuc", *rest]:
            realtime.one_blas_thread()  # before numpy is imported
            from sim_hil.fanuc import server

            return server.main(rest)
        case ["human", cell, *rest]:
            from sim_hil import human

            return human.main(cell, rest)
        case ["trials", *rest]:
            from sim_hil.trials import main as trials

            return trials.main(rest)
    print(USAGE, file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
