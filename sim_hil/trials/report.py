"""Outcomes to rows, rows to text."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from sim_hil.trials.judge import Outcome
from sim_hil.trials.statistics import paired_events, paired_median, upper_bound
from sim_hil.trials.suite_files import SPHERE, Rules
from sim_hil.trials.suites import Job, find
from sim_hil.trials.transfer import verdict

Row = dict[str, Any]
OURS, NO_FILTER = "asc", "none"
COLUMNS = (
    "system", "policy", "covered", "trials", "violations", "robot_caused", "bound_95", "infeasible", "limits_exceeded",
    "stops", "needed", "reached", "reachable", "min_distance_m", "tool_m", "extra_m",
    "M_min", "M_max", "M_dot_star", "k", "median_s", "goals_per_min",
)  # fmt: skip


def rows(suite: str, done: Iterable[tuple[Job, Outcome]]) -> list[Row]:
    """One row per system and policy. Counts are of trials, except `infeasible`: cycles, `stops` and `reached`.

    `needed`: the share of the trials in which the robot violates without the filter, of those also run without it.
    `paired`: other policies on the same draws as ours: robot-caused, and the medians of (other - ours).
    `tool_m`: the least distance of the tool in a trial, the median of all trials.
    `extra_m`: how much of it the policy adds: less the greater of d_min and what the tool keeps in the same draw
    without the filter (goals that are farther away say nothing of who leads there); without such twins, less d_min.
    """
    outcomes: dict[tuple[int, str], dict[int, Outcome]] = {}
    for job, outcome in sorted(done, key=lambda pair: pair[0].trial):
        outcomes.setdefault((job.system, job.policy), {})[job.trial] = outcome
    table = []
    for i in range(len(find(suite).systems)):
        ours = outcomes.get((i, OURS), {})
        for policy in find(suite).policies:
            if found := outcomes.get((i, policy)):
                row = _row(suite, i, policy, list(found.values()))
                row["extra_m"] = _extra(found, outcomes.get((i, NO_FILTER), {}), row["d_min_m"])
                if find(suite).is_transfer:
                    row |= _coverage(suite, i)
                if policy == OURS:
                    row["needed"] = _needed(ours, outcomes.get((i, NO_FILTER), {}))
                elif paired := _paired(ours, found):
                    row["paired"] = paired
                table.append(row)
    return table


def _coverage(suite: str, i: int) -> Row:
    """Whether the conditions of the index hold on this system; if not, the trials are what the refusal prevents."""
    found = verdict(find(suite).systems[i])
    return {
        "covered": found.is_covered,
        "refused": list(found.reasons),
        "boundary_states": found.boundary_states,
        "boundary_feasible": found.feasible,
    }


def _needed(ours: dict[int, Outcome], unfiltered: dict[int, Outcome]) -> float | None:
    twins = ours.keys() & unfiltered.keys()
    return sum(unfiltered[k].robot_caused > 0 for k in twins) / len(twins) if twins else None


def _extra(found: dict[int, Outcome], unfiltered: dict[int, Outcome], d_min: float) -> float | None:
    twins = found.keys() & unfiltered.keys()
    needed = {k: max(d_min, unfiltered[k].tool_distance) if twins else d_min for k in twins or found}
    return _number(float(np.median([found[k].tool_distance - least for k, least in needed.items()])))


def _paired(ours: dict[int, Outcome], other: dict[int, Outcome]) -> Row | None:
    both = sorted(ours.keys() & other.keys())
    if not both:
        return None
    pairs = [(ours[k], other[k]) for k in both]
    times = [(a.seconds / a.reached, b.seconds / b.reached) for a, b in pairs if a.reached and b.reached]
    nearest = [(a.min_distance, b.min_distance) for a, b in pairs]
    return {
        "robot_caused": paired_events(*zip(*[(a.robot_caused > 0, b.robot_caused > 0) for a, b in pairs], strict=True)),
        "min_distance_m": paired_median(*zip(*nearest, strict=True)),
        "tool_distance_m": paired_median(*zip(*[(a.tool_distance, b.tool_distance) for a, b in pairs], strict=True)),
        "goals": paired_median(*zip(*[(float(a.reached), float(b.reached)) for a, b in pairs], strict=True)),
        "seconds_per_goal": paired_median(*zip(*times, strict=True)) if times else None,
    }


def broken_promises(done: Iterable[tuple[Job, Outcome]]) -> list[str]:
    """Each trial in which the filter broke its word, with the command that runs it again, recorded."""
    lines = []
    for job, o in done:
        if job.policy == OURS and _is_promised(job) and _is_broken(job.suite, o):
            name = find(job.suite).systems[job.system].name
            again = f"--seed {job.seed} --system {name} --policy {OURS} --trial {job.trial} --record -o runs/again"
            lines.append(f"broken: asc trials {job.suite} {again}")
    return lines


def _is_promised(job: Job) -> bool:
    """Nothing is, where the index does not cover the system and only an override lets it move."""
    suite = find(job.suite)
    return not suite.is_transfer or verdict(suite.systems[job.system]).is_covered


def _is_broken(suite: str, o: Outcome) -> bool:
    return any(getattr(o, what) for what in _promises(suite))


def _promises(suite: str) -> tuple[str, ...]:
    """What must not happen, as outcomes and rows name it."""
    always = ("robot_caused", "limits_exceeded")
    return always if find(suite).is_moving else (*always, "violations", "infeasible")


def holds(suite: str, table: Sequence[Row]) -> bool:
    """What the filter promises: the robot causes no violation and keeps its limits; and where nobody moves, nobody is
    ever too near and there is always a safe control (else the arm brakes, which is no violation). Of systems that the
    index does not cover nothing is promised.
    """
    ours = [row for row in table if row["policy"] == OURS and row.get("covered", True)]
    kept = not any(row[what] for row in ours for what in _promises(suite))
    return kept and not shortfalls(suite, table)


def shortfalls(suite: str, table: Sequence[Row]) -> list[str]:
    """Where ours is not as good, or not as much better than the enclosing sphere, as the suite's file asks for."""
    file = find(suite).file
    if file is None:
        return []
    by = {(row["system"], row["policy"]): row for row in table}
    lines = []
    for system in find(suite).systems:
        if (ours := by.get((system.name, OURS))) is not None:
            lines += _shortfalls(file.verdict, ours, by.get((system.name, SPHERE)))
    return lines


def _shortfalls(rules: Rules, ours: Row, sphere: Row | None) -> list[str]:
    name, lines = ours["system"], []
    if ours["reached"] < rules.least_goals * ours["trials"]:
        lines.append(f"{name}: {ours['reached']} goals in {ours['trials']} trials, under {rules.least_goals:g} each")
    if sphere is None:
        return lines
    if rules.extra_share is not None:
        if ours["extra_m"] is None or sphere["extra_m"] is None:
            lines.append(f"{name}: nobody was there")
        elif not ours["extra_m"] <= rules.extra_share * sphere["extra_m"]:
            share = f"more than {rules.extra_share:g} of the sphere's {sphere['extra_m']:.3f} m"
            lines.append(f"{name}: ours keeps a median of {ours['extra_m']:.3f} m extra, {share}")
    if rules.more_goals and not ours["reached"] > sphere["reached"]:
        lines.append(f"{name}: ours reached {ours['reached']} goals, the sphere {sphere['reached']}")
    slower = (sphere.get("paired") or {}).get("seconds_per_goal")
    if rules.more_goals and slower is not None and not slower["median"] > 0.0:
        lines.append(f"{name}: with the sphere a goal takes {-slower['median']:.2f} s less (median of paired trials)")
    return lines


def _row(suite: str, i: int, policy: str, outcomes: Sequence[Outcome]) -> Row:
    system, trials = find(suite).systems[i], len(outcomes)
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
        "bound_95": upper_bound(robot_caused if find(suite).is_moving else violations, trials),
        "infeasible": sum(o.infeasible for o in outcomes),
        "limits_exceeded": sum(bool(o.limits_exceeded) for o in outcomes),
        "stops": sum(o.stops for o in outcomes),
        "reached": sum(o.reached for o in outcomes),
        "reachable": sum(o.reachable for o in outcomes),
        "min_distance_m": min(o.min_distance for o in outcomes),
        "tool_m": _number(float(np.median([o.tool_distance for o in outcomes]))),
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
    cells = [list(COLUMNS), *([_cell(row.get(column)) for column in COLUMNS] for row in table)]
    widths = [max(len(line[i]) for line in cells) for i in range(len(COLUMNS))]
    return "\n".join("  ".join(f"{cell:>{w}}" for cell, w in zip(line, widths, strict=True)) for line in cells)


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
