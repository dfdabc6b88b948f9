"""Profiles of phi0 = d_min - d over a trial, policies side by side: the picture that the paper shows of its FANUC."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from sim_hil.trials.judge import PROFILE_S, Outcome
from sim_hil.trials.suites import Job, find

COLOURS = {"asc": "tab:blue", "enclosing-sphere": "tab:orange", "ssm-stop": "tab:green", "none": "tab:red"}
FARTHEST = 1.0  # m shown


def draw(suite: str, done: Iterable[tuple[Job, Outcome]], path: Path) -> Path:
    """One panel per system: the median over the trials of each policy, and all of them between its 10 and 90 %."""
    from matplotlib.figure import Figure

    trials = list(done)
    systems = find(suite).systems
    figure = Figure(figsize=(3.4 * len(systems), 3.4), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(systems), sharey=True))
    for i, (system, panel) in enumerate(zip(systems, panels, strict=True)):
        for policy in find(suite).policies:
            profiles = [o.distances for job, o in trials if (job.system, job.policy) == (i, policy)]
            if profiles:
                _profile(panel, system.d_min - _table(profiles), policy)
        panel.axhline(0.0, color="black", linewidth=0.8)
        panel.set(title=system.name.partition("+")[2].replace("+", " then "), xlabel="t [s]", ylim=(-FARTHEST, 0.2))
    panels[0].set_ylabel("phi0 of the tool [m], above 0: too near")
    panels[0].legend(fontsize="small", loc="lower right")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    return path


def _table(profiles: list[tuple[float, ...]]) -> np.ndarray:
    """(trials, times); a trial that ended early is not there any more."""
    table = np.full((len(profiles), max(map(len, profiles))), np.nan)
    for row, profile in zip(table, profiles, strict=True):
        row[: len(profile)] = profile
    return table


def _profile(panel: object, phi0: np.ndarray, policy: str) -> None:
    t = PROFILE_S * np.arange(phi0.shape[1])
    low, middle, high = np.nanpercentile(phi0, (10, 50, 90), axis=0)
    panel.fill_between(t, low, high, color=COLOURS[policy], alpha=0.15, linewidth=0)  # type: ignore[attr-defined]
    panel.plot(t, middle, color=COLOURS[policy], label=policy)  # type: ignore[attr-defined]
