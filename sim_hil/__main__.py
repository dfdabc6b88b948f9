"""`python -m sim_hil DEVICE CELL ...`: one simulated device, or a suite of trials, as a process of its own."""

from __future__ import annotations

import sys

from asc_rt import realtime

DEVICES = "fanuc CELL | can CELL | human CELL | camera CELL | mount CELL | changer CELL TOOL ... | swaps LOG"
DEVICES += " | trials SUITE | seeing"
USAGE = f"usage: python -m sim_hil {{{DEVICES}}} [options]"


def main(argv: list[str]) -> int:
    match argv:
        case ["fanuc", *rest]:
            realtime.one_blas_thread()  # before numpy is imported
            from sim_hil.fanuc import server

            return server.main(rest)
        case ["can", *rest]:
            realtime.one_blas_thread()
            from sim_hil.can import server as can_server

            return can_server.main(rest)
        case ["human", cell, *rest]:
            from sim_hil import human

            return human.main(cell, rest)
        case ["camera", *rest]:
            realtime.one_blas_thread()
            from sim_hil import camera

            return camera.main(rest)
        case ["mount", *rest]:
            from sim_hil import mount

            return mount.main(rest)
        case ["changer", *rest]:
            from sim_hil import changer

            return changer.main(rest)
        case ["swaps", *rest]:
            from sim_hil import swap_picture

            return swap_picture.main(rest)
        case ["seeing", *rest]:
            from sim_hil import seeing

            return seeing.main(rest)
        case ["trials", *rest]:
            from sim_hil.trials import main as trials

            return trials.main(rest)
    print(USAGE, file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
