"""The paper's Table I computed with this sampler: five Panda systems, twice.

`python -m asc_rt.synthesis.table1 [SAMPLES]` prints, beside the paper's figures, first the paper's own conditions
(torque box alone, its one fixed point), then the true ones (torque and joint limits, the point anywhere around the
tool). It is a comparison, not a certificate: the person never moves.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from typing import Any

from asc_rt.config import load_arm
from asc_rt.core import robot_model
from asc_rt.synthesis import sampling, synthesis
from asc_rt.synthesis.sampling import Ranges, Survey
from asc_rt.synthesis.statistics import quantile

D_MIN = 0.05  # m, as the paper's
FLOOR = 0.3  # m/s2; states with a smaller M do not enter rho and k
PAPER_POINT = (0.45, 0.1, 0.55)  # m, where the authors' sampler keeps the obstacle
RANGES = Ranges(
    d_low=0.05, d_high=0.8, v_max=1.0, speed_share=1.0, human_speed=0.0, human_acceleration=0.0, joint_limits=False,
    links="tool", obstacle=PAPER_POINT,
)  # fmt: skip

TRUE_RANGES = replace(RANGES, joint_limits=True, obstacle=None)


@dataclass(frozen=True, slots=True)
class Published:
    """One row of the paper's table."""

    case: str
    robot: str
    tool: str
    M_min: float
    M_max: float
    M_dot: float


PAPER = (
    Published("5 DoF + EE1", "panda_5dof", "ee1", 1.67, 114.37, 1052.93),
    Published("6 DoF + EE1", "panda_6dof", "ee1", 3.26, 121.34, 891.80),
    Published("7 DoF + EE1", "panda", "ee1", 4.13, 127.32, 847.42),
    Published("7 DoF + EE2", "panda", "ee2", 4.53, 120.19, 710.97),
    Published("7 DoF + EE3", "panda_ee3", "ee1", 3.82, 131.55, 856.18),
)


def row(published: Published, samples: int, seed: int = 0, ranges: Ranges = RANGES) -> dict[str, Any]:
    """Our figures of one system, and the paper's."""
    robot, tool = load_arm(published.robot, published.tool)
    model = robot_model.load(robot, tool, "torque")
    draw = sampling.draw_of(model, len(tool.capsules), ranges)
    found = sampling.collect(Survey(model.arm, draw, seed, samples, FLOOR, ranges.v_max))
    low, high = found.least, found.greatest
    rho = high["ratio"].value
    figures = synthesis.Figures(D_MIN, ranges.d_low, ranges.d_high, ranges.v_max, rho, 0.001, 1.0)
    k_paper = synthesis.k_paper(ranges.d_high, ranges.v_max, D_MIN, low["ball"].value, high["steepest"].value)
    return {
        "system": published.case,
        "samples": found.counts["samples"],
        "M_min": low["ball"].value,
        "M_p1e-4": quantile(found.histograms["ball"], 1e-4),
        "M_max": high["ball"].value,
        "M_plus_min": low["M"].value,
        "M_dot_star": high["steepest"].value,
        "ball_nonpositive": found.counts["ball_nonpositive"] / found.counts["samples"],
        "M_dot_p97": quantile(found.histograms["steepest"], 0.97),
        "rho": rho,
        "k_paper": k_paper,
        "k": synthesis.k_bound(figures),
        "paper": {
            "M_min": published.M_min,
            "M_max": published.M_max,
            "M_dot_star": published.M_dot,
            "k": synthesis.k_paper(0.8, 1.0, D_MIN, published.M_min, published.M_dot),
        },
    }


def main() -> None:
    samples = int(sys.argv[1]) if len(sys.argv) > 1 else 100_000
    for title, ranges in (("paper's conditions", RANGES), ("true limits, point anywhere", TRUE_RANGES)):
        print(f"{title}, {samples} samples")
        _print(samples, ranges)


def _print(samples: int, ranges: Ranges) -> None:
    names = (
        "M_min",
        "M_p1e-4",
        "M_max",
        "M_plus_min",
        "ball_nonpositive",
        "M_dot_p97",
        "M_dot_star",
        "rho",
        "k_paper",
        "k",
    )
    print("system".ljust(14), *(name.rjust(11) for name in names), "| paper: M_min  M_max  M_dot*  k")
    for published in PAPER:
        found = row(published, samples, ranges=ranges)
        cells = ("-" if found[name] is None else f"{found[name]:.4g}" for name in names)
        paper = found["paper"]
        print(
            published.case.ljust(14), *(cell.rjust(11) for cell in cells),
            f"| {paper['M_min']:.4g}  {paper['M_max']:.4g}  {paper['M_dot_star']:.5g}  {paper['k']:.4g}",
        )  # fmt: skip


if __name__ == "__main__":
    main()
