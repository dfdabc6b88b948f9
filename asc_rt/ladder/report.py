"""Simulation beside hardware, step by step: numbers (JSON), the page (HTML) and its picture (PNG)."""

from __future__ import annotations

import base64
import html
import io
import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import matplotlib.figure
import numpy as np

from asc_rt.core.types import Mode
from asc_rt.ladder.journal import HARDWARE, PASS, SIM, Entry, Journal, newest
from asc_rt.ladder.rules import Run, following
from asc_rt.ladder.steps import Step, load_steps
from logs.audit_evidence import Column, gather
from logs.report import page
from logs.summary import stops

MODES = (SIM, HARDWARE)
COLOURS = {SIM: "#1f5fa8", HARDWARE: "#c77d1e"}
Curve = tuple[Column, Column]  # s, value


def write_report(journal: Journal, path: Path) -> dict[str, Any]:
    """Write `path`.html, .json and .png (whatever suffix it has); the JSON. OSError, LogError: a recording."""
    steps, entries = load_steps(), journal.entries
    told = comparison(steps, entries)
    png = picture(_runs(steps, entries, journal.path.parent))
    path.with_suffix(".json").write_text(json.dumps(told, indent=1, allow_nan=False) + "\n")
    path.with_suffix(".png").write_bytes(png)
    path.with_suffix(".html").write_text(_html(told, png))
    return told


def comparison(steps: tuple[Step, ...], entries: list[Entry]) -> dict[str, Any]:
    """Of every step the newest run in each mode: verdict, cell hash, measures; and hardware less simulation."""
    rows = []
    for step in steps:
        found = {mode: newest(entries, step.number, mode) for mode in MODES}
        row: dict[str, Any] = {"step": step.number, "name": step.name, "title": step.title}
        row |= {mode: _told(entry) for mode, entry in found.items()}
        sim, hardware = (entry["measures"] if entry else {} for entry in found.values())
        row["difference"] = {
            key: round(hardware[key] - sim[key], 4)
            for key in sim.keys() & hardware.keys()
            if sim[key] is not None and hardware[key] is not None
        }
        rows.append(row)
    both = [row for row in rows if row[SIM] and row[HARDWARE]]
    return {
        "suite": "ladder",
        "rows": rows,
        "compared": len(both),
        "same_cell": all(row[SIM]["cell_hash"] == row[HARDWARE]["cell_hash"] for row in both),
    }


def _told(entry: Entry | None) -> dict[str, Any] | None:
    kept = ("verdict", "time", "cell_hash", "log", "failed", "measures")
    return None if entry is None else {key: entry[key] for key in kept}


def _runs(steps: tuple[Step, ...], entries: list[Entry], folder: Path) -> dict[tuple[str, str], Run]:
    """The recordings that the picture shows, by (step, mode)."""
    shown = {name for name, _, _ in PANELS}
    found = {}
    for step in (step for step in steps if step.name in shown):
        for mode in MODES:
            entry = newest(entries, step.number, mode)
            if entry and entry["log"] and entry["measures"] and (folder / entry["log"]).is_file():
                found[step.name, mode] = Run.of(step, gather(folder / entry["log"]))
    return found


# --- curves ----------------------------------------------------------------------------------------------------------


def tracking(run: Run) -> list[Curve]:
    """How far the joint that is farthest off is from where the set-points say, deg, the latency taken out."""
    found = following(run)
    if found is None:
        return []
    t, moving = run.c["inputs.t_ns"] * 1e-9, run.e.moving & run.heard
    asked = [np.interp(t[moving] - found.latency, t, column) for column in run.c["state.q_cmd"].T]
    off = np.abs(np.column_stack(asked) - run.c["inputs.joint.q"][moving]).max(axis=1)
    return [(run.e.t_s[moving], np.degrees(off))]


def way_to_rest(run: Run) -> list[Curve]:
    """Of each stop: the way of the joint with the longest way, from where it is to where it rests, deg."""
    curves = []
    for stop in stops(run.c):
        i = int(np.searchsorted(run.c["inputs.tick"], stop["cycle"]))
        again = np.flatnonzero(run.e.mode_after[i + 1 :] == Mode.ACTIVE)
        there = np.arange(i, i + 1 + int(again[0]) if len(again) else run.e.cycles)
        there = there[run.heard[there]]
        left = np.abs(run.c["inputs.joint.q"][there] - run.c["inputs.joint.q"][there[-1]])
        curves.append((run.e.t_s[there] - run.e.t_s[i], np.degrees(left[:, left[0].argmax()])))
    return curves


def distance(run: Run) -> list[Curve]:
    """To the nearest person, m, with the bounds of what is known."""
    d = run.c["outputs.decision.d_measured"]
    return [(run.e.t_s, np.where(np.isfinite(d), d, np.nan))]


PANELS: tuple[tuple[str, str, Callable[[Run], list[Curve]]], ...] = (
    ("path", "off the set-points [deg]", tracking),
    ("stop", "way to rest after a stop [deg]", way_to_rest),
    ("dummy", "distance to the dummy [m]", distance),
    ("person", "distance to the person [m]", distance),
)


def picture(runs: Mapping[tuple[str, str], Run]) -> bytes:
    """PNG, a panel for each of PANELS that was run, simulation and hardware in one."""
    shown = [panel for panel in PANELS if any((panel[0], mode) in runs for mode in MODES)]
    figure = matplotlib.figure.Figure(figsize=(11, 3.3 * max(1, math.ceil(len(shown) / 2))), layout="constrained")
    for i, (name, label, curves_of) in enumerate(shown):
        axes = figure.add_subplot(math.ceil(len(shown) / 2), 2, i + 1)
        for mode in MODES:
            run = runs.get((name, mode))
            for k, (t, values) in enumerate(curves_of(run) if run else []):
                axes.plot(t, values, color=COLOURS[mode], lw=1, label=None if k else mode)
            if run and curves_of is distance:
                axes.axhline(run.e.log.params.safety.d_min, color="#b3261e", ls="--", lw=1)
        axes.set(title=f"step {name}", ylabel=label, xlabel="s")
        axes.grid(alpha=0.3)
        if axes.lines:
            axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
        if axes.get_legend_handles_labels()[0]:
            axes.legend()
        if curves_of is way_to_rest and axes.lines:
            axes.set_xlim(0, 1.5)
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=100)
    return data.getvalue()


# --- page ------------------------------------------------------------------------------------------------------------


def _html(told: dict[str, Any], png: bytes) -> str:
    both = f"{told['compared']} of {len(told['rows'])} steps were run in simulation and on the hardware"
    same = "with the same cell" if told["same_cell"] else "NOT all with the same cell"
    image = base64.b64encode(png).decode()
    body = [
        "<h1>Ladder: simulation and hardware</h1>",
        f"<p class='verdict {'ok' if told['same_cell'] else 'bad'}'>{both}, {same}</p>",
        f"<figure><img src='data:image/png;base64,{image}' alt='course of four steps'></figure>",
        *(_step(row) for row in told["rows"]),
    ]
    return page("Ladder: simulation and hardware", "".join(body))


def _step(row: dict[str, Any]) -> str:
    """Verdicts, and a table of what was measured."""
    entries = [row[mode] for mode in MODES]
    verdicts = "".join(_verdict(mode, entry) for mode, entry in zip(MODES, entries, strict=True))
    head = f"<h2>{row['step']} {html.escape(row['title'])}</h2><p>{verdicts}</p>"
    keys = [key for key in _keys(entries) if any(entry and entry["measures"].get(key) is not None for entry in entries)]
    lines = [
        f"<tr><td>{key}</td>{''.join(f'<td>{_number(entry, key)}</td>' for entry in entries)}"
        f"<td>{row['difference'].get(key, '')}</td></tr>"
        for key in keys
    ]
    names = f"<tr><th>measure</th><th>{SIM}</th><th>{HARDWARE}</th><th>difference</th></tr>"
    return head + (f"<table>{names}{''.join(lines)}</table>" if lines else "")


def _keys(entries: list[Any]) -> list[str]:
    return list(dict.fromkeys(key for entry in entries if entry for key in entry["measures"]))


def _verdict(mode: str, entry: dict[str, Any] | None) -> str:
    if entry is None:
        return f"{mode}: <span class='s'>not run</span>. "
    why = html.escape("; ".join(entry["failed"]))
    kind = "h" if entry["verdict"] == PASS else "f"
    return f"{mode}: <span class='{kind}'>{entry['verdict']}</span> {entry['time']} {why}. "


def _number(entry: dict[str, Any] | None, key: str) -> str:
    value = entry["measures"].get(key) if entry else None
    return "" if value is None or not math.isfinite(value) else f"{value:g}"
