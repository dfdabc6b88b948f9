"""Outcomes to rows, rows to text."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from sim_hil.trials.judge import Outcome
from sim_hil.trials.statistics import upper_bound
from sim_hil.trials.suites import POLICIES, SUITES, Job

Row = dict[str, Any]
COLUMNS = (
    "system", "policy", "trials", "violations", "robot_caused", "bound_95", "infeasible", "limits_exceeded", "stops",
    "reached", "reachable", "min_distance_m", "M_min", "M_max", "M_dot_star", "k", "median_s", "goals_per_min",
)  # fmt: skip


def rows(suite: str, done: Iterable[tuple[Job, Outcome]]) -> list[Row]:
    """One row per system and policy. Counts are of trials, except `infeasible`: cycles, `stops` and `reached`."""
    outcomes: dict[tuple[int, str], list[Outcome]] = {}
    for job, outcome in sorted(done, key=lambda pair: pair[0].trial):
        outcomes.setdefault((job.system, job.policy), []).append(outcome)
    table = []
    for i in range(len(SUITES[suite].systems)):
        of_system = {policy: outcomes[i, policy] for policy in POLICIES if (i, policy) in outcomes}
        table += [_row(suite, i, policy, of_policy) for policy, of_policy in of_system.items()]
    return table


def holds(suite: str, table: Sequence[Row]) -> bool:
    """What the filter promises: the robot causes no violation and keeps its limits; and where nobody moves, nobody is
    ever too near and there is always a safe control (else the arm brakes, which is no violation).
    """
    promised = ["robot_caused", "limits_exceeded"]
    if not SUITES[suite].is_moving:
        promised += ["violations", "infeasible"]
    return not any(row[key] for row in table if row["policy"] == "asc" for key in promised)


def _row(suite: str, i: int, policy: str, outcomes: Sequence[Outcome]) -> Row:
    system, trials = SUITES[suite].systems[i], len(outcomes)
    violations = sum(o.violations > 0 for o in outcomes)
    robot_caused = sum(o.robot_caused > 0 for o in outcomes)
    seconds = sum(o.seconds for o in outcomes)
    times = [o.seconds for o in outcomes if o.reached]
    return {
        "system": system.name,
        "control": system.control,
        "policy": policy,
        "trials": trials,
        "violations": violations,
        "robot_caused": robot_caused,
        "bound_95": upper_bound(robot_caused if SUITES[suite].is_moving else violations, trials),
        "infeasible": sum(o.infeasible for o in outcomes),
        "limits_exceeded": sum(bool(o.limits_exceeded) for o in outcomes),
        "stops": sum(o.stops for o in outcomes),
        "reached": sum(o.reached for o in outcomes),
        "reachable": sum(o.reachable for o in outcomes),
        "min_distance_m": min(o.min_distance for o in outcomes),
        "M_min": _number(min(o.M_min for o in outcomes)),
        "M_max": _number(max(o.M_max for o in outcomes)),
        "M_dot_star": max(o.M_dot_star for o in outcomes),
        "k": system.k,
        "d_min_m": system.d_min,
        "filtered_share": sum(o.filtered for o in outcomes) / max(1, sum(o.cycles for o in outcomes)),
        "speed_share": max(o.speed_share for o in outcomes),
        "torque_share": max(o.torque_share for o in outcomes),
        "median_s": float(np.median(times)) if times else None,
        "goals_per_min": 60.0 * sum(o.reached for o in outcomes) / seconds if seconds else None,
        "seconds_simulated": seconds,
        "cycles": sum(o.cycles for o in outcomes),
    }


def _number(value: float) -> float | None:
    return value if np.isfinite(value) else None


def text(table: Sequence[Row]) -> str:
    cells = [list(COLUMNS), *([_cell(row[column]) for column in COLUMNS] for row in table)]
    widths = [max(len(line[i]) for line in cells) for i in range(len(COLUMNS))]
    return "\n".join("  ".join(f"{cell:>{w}}" for cell, w in zip(line, widths, strict=True)) for line in cells)


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
