"""Episodes of the whole cell that sees, in lockstep: `python -m sim_hil seeing --cell -n 50`."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import Any

import numpy as np
from tqdm import tqdm

from logs.latency import statistics
from sim_hil.seeing_cell import Cell, Story


def run(seeds: list[int], seconds: float, workers: int) -> dict[str, Any]:
    """What happened in one episode of each seed, together."""
    with ProcessPoolExecutor(workers) as pool:
        stories = list(tqdm(pool.map(partial(episode, seconds=seconds), seeds), total=len(seeds), disable=None))
    outcomes = [story.outcome for story in stories]
    latency = np.concatenate([story.latency_ns for story in stories])
    simulated = sum(outcome.seconds for outcome in outcomes)
    reasons: dict[str, int] = {}
    for note in (note for outcome in outcomes for note in outcome.notes):
        reason = note.split()[-1] if "robot-caused" not in note else "robot-caused"
        reasons[reason] = reasons.get(reason, 0) + 1
    return {
        "episodes": len(seeds),
        "minutes": round(simulated / 60.0, 2),
        "robot_caused": sum(outcome.robot_caused for outcome in outcomes),
        "robot_caused_seeds": [seed for seed, o in zip(seeds, outcomes, strict=True) if o.robot_caused],
        "inside_d_min": sum(outcome.violations for outcome in outcomes),
        "least_distance_m": round(min(outcome.min_distance for outcome in outcomes), 4),
        "goals_per_minute": round(60.0 * sum(outcome.reached for outcome in outcomes) / simulated, 1),
        "stops": reasons,
        "infeasible_cycles": sum(outcome.infeasible for outcome in outcomes),
        "photon_to_command_ms": statistics(latency),
        "cpu_share": {
            "perception": round(sum(story.perception_s for story in stories) / simulated, 3),
            "control": round(sum(story.control_s for story in stories) / simulated, 3),
        },
    }


def episode(seed: int, seconds: float) -> Story:
    return Cell(seed).run(seconds)
