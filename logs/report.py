"""The audit as one HTML file that needs nothing else: verdict first, then rules, plots and pictures.

Plots are drawn here as SVG: a few polylines do not need a library.
"""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from asc_rt.core.types import Mode
from logs.audit_evidence import Column, Evidence
from logs.latency import BIN_MS, photon_to_command_ns, statistics

WIDTH, HEIGHT, LEFT, BOTTOM = 1000, 150, 64, 22  # px
BINS = 900  # across a plot; each shows its least and greatest value, so that no peak is lost
EVENTS = 6  # moments with a picture
MODE_COLOURS = {
    Mode.IDLE: "#9aa0a6", Mode.HOLD: "#c9ccd1", Mode.ACTIVE: "#4c9f70", Mode.STOPPING: "#e0a030",
    Mode.STOPPED: "#d06a3a", Mode.FAULT: "#c03030", Mode.ENDED: "#6a7078",
}  # fmt: skip
_STYLE = """
body{font:15px/1.45 system-ui,sans-serif;color:#1d2126;max-width:1080px;margin:24px auto;padding:0 16px}
h1{font-size:24px;margin:0 0 4px}h2{font-size:18px;margin:28px 0 8px}
.verdict{padding:12px 16px;border-radius:6px;font-weight:600;color:#fff}.ok{background:#2f7d52}.bad{background:#b3261e}
table{border-collapse:collapse;width:100%}td,th{padding:5px 8px;border-bottom:1px solid #e3e6ea;text-align:left;
vertical-align:top}.h{color:#2f7d52;font-weight:600}.f{color:#b3261e;font-weight:600}.s{color:#7a8087}
.mono{font-family:ui-monospace,monospace;font-size:12.5px;word-break:break-all}figure{margin:10px 0}
figcaption{color:#555b63;font-size:13px}img{max-width:100%;border:1px solid #e3e6ea}
"""


class Line(NamedTuple):
    name: str
    values: Column
    colour: str


class Moment(NamedTuple):
    """Something to look at; `t_s` since the first cycle."""

    t_s: float
    text: str


class Picture(NamedTuple):
    moment: Moment
    png: bytes


def moments(e: Evidence) -> list[Moment]:
    """What an auditor wants to see first: the nearest approach, then every stop."""
    found = []
    d = e.c["outputs.decision.d_measured"]
    if np.isfinite(d).any():
        i = int(d.argmin())
        found.append(Moment(float(e.t_s[i]), f"nearest approach, {d[i]:.3f} m"))
    found += [Moment(stop["t_s"], f"stop: {stop['reason']}") for stop in e.notes.get("stops", [])]
    return found[:EVENTS]


def html_report(report: dict[str, Any], e: Evidence | None, pictures: Sequence[Picture] = (), note: str = "") -> str:
    """The whole page. `note`: why there are no pictures."""
    verdict = "every rule holds" if report["holds"] else "NOT IN ORDER: " + ", ".join(
        rule["name"] for rule in report["rules"] if not rule["holds"]
    )  # fmt: skip
    head = [
        f"<h1>Audit of {_text(report['log'])}</h1>",
        f"<p>{_text(_summary(report))}</p>",
        f"<p class='verdict {'ok' if report['holds'] else 'bad'}'>{_text(verdict)}</p>",
    ]
    body = ["<h2>Rules</h2>", _rules(report["rules"])]
    if e is not None and e.cycles > 1:
        body += ["<h2>Course of the session</h2>", *_plots(e)]
    body += [_figure(picture) for picture in pictures]
    if note:
        body.append(f"<p class='s'>No pictures: {_text(note)}</p>")
    body += ["<h2>What it is about</h2>", _table(report.get("session", {})), "<h2>Attachments</h2>"]
    body += [_table(report.get("attachments", {})), _limits(report)]
    return page(f"Audit of {report['log']}", "".join([*head, *body]))


def page(title: str, body: str) -> str:
    """One HTML file that needs nothing else."""
    return (
        f"<!doctype html><html lang='en'><meta charset='utf-8'><title>{_text(title)}</title>"
        f"<style>{_STYLE}</style><body>{body}</body></html>\n"
    )


def _summary(report: dict[str, Any]) -> str:
    if "duration_s" not in report:
        return "The file is damaged or altered; nothing in it can be believed."
    near = report["min_distance_m"]
    nearest = "nobody near" if near is None else f"nearest approach {near:.3f} m"
    return f"{report['cycles']} cycles, {report['duration_s']:.1f} s, {len(report['stops'])} stops, {nearest}"


def _rules(rules: list[dict[str, Any]]) -> str:
    rows = []
    for rule in rules:
        kind, word = (
            ("s", "not judged") if rule.get("skipped") else ("h", "holds") if rule["holds"] else ("f", "BROKEN")
        )
        rows.append(
            f"<tr><td>{_text(rule['name'])}</td><td class='{kind}'>{word}</td><td>{_text(rule['detail'])}</td></tr>"
        )
    return f"<table><tr><th>rule</th><th></th><th>finding</th></tr>{''.join(rows)}</table>"


def _table(values: dict[str, Any]) -> str:
    rows = (f"<tr><td>{_text(k)}</td><td class='mono'>{_text(v)}</td></tr>" for k, v in values.items())
    return f"<table>{''.join(rows)}</table>"


def _limits(report: dict[str, Any]) -> str:
    """What this report does not say."""
    skipped = ", ".join(report.get("not_judged", [])) or "none"
    return (
        "<h2>Limits of this report</h2><p>It judges what the controller recorded: sensors and robot are believed as "
        f"far as they agree. Rules not judged: {_text(skipped)}. It is evidence, not a safety function.</p>"
        f"<p class='mono'>recording SHA-256 {_text(report.get('sha256', 'unknown'))}<br>report SHA-256 "
        f"{_text(report['report_sha256'])}</p>"
    )


def _figure(picture: Picture) -> str:
    data = base64.b64encode(picture.png).decode()
    caption = f"{picture.moment.t_s:.3f} s: {_text(picture.moment.text)}"
    return (
        f"<figure><img src='data:image/png;base64,{data}' alt='{caption}'><figcaption>{caption}</figcaption></figure>"
    )


def _text(value: object) -> str:
    return html.escape(str(value), quote=True)


# --- plots -----------------------------------------------------------------------------------------------------------


def _plots(e: Evidence) -> list[str]:
    p, c = e.log.params, e.c
    robot, marks = p.robot, moments(e)
    age = np.where(c["inputs.human.present"] == 1, c["inputs.human_age_ns"] * 1e-6, np.nan)
    spent = (c["timings.t_write_end_ns"] - c["timings.t_wake_ns"]) * 1e-6
    speed = (np.abs(c["state.dq_cmd"]) / np.array(robot.dq_max)).max(axis=1)
    acceleration = (np.abs(c["state.ddq_cmd"]) / np.array(robot.ddq_max)).max(axis=1)
    shares = [Line("speed", speed, "#1f5fa8"), Line("acceleration", acceleration, "#c77d1e")]
    distance = Line("measured distance", c["outputs.decision.d_measured"], "#1f5fa8")
    return [
        _modes(e),
        plot("distance to the nearest person [m]", e.t_s, [distance], p.safety.d_min, "d_min", marks),
        plot("greatest phi of all pairs", e.t_s, [Line("phi", c["worst_phi"], "#7a3fa0")], 0.0, "0", marks),
        plot("share of the limits that the commands use",
             e.t_s, shares, 1.0, "limit", marks),
        plot("age of the person's state [ms]",
             e.t_s, [Line("age", age, "#2f7d52")], p.human.age_limit_ns * 1e-6, "limit", marks),
        plot("wake to sent [ms]", e.t_s, [Line("cycle", spent, "#555b63")], p.period_ns * 1e-6, "period", marks),
        _photon_to_command(e),
    ]  # fmt: skip


def _photon_to_command(e: Evidence) -> str:
    """How often it took how long from a capture to the set-point that rests on it."""
    found = statistics(photon_to_command_ns(e.c))["histogram"]
    title = f"photon to command, cycles per {BIN_MS:g} ms"
    if not found:
        return ""
    first, last = found[0][0], found[-1][0] + BIN_MS
    most, width = max(count for _, count in found), (WIDTH - LEFT - 8) * BIN_MS / (last - first)
    bars = []
    for begin, count in found:
        height = (HEIGHT - BOTTOM) * count / most
        x, y = LEFT + (WIDTH - LEFT - 8) * (begin - first) / (last - first), HEIGHT - BOTTOM - height
        what = f"{begin:g} to {begin + BIN_MS:g} ms: {count}"
        bars.append(
            f"<rect x='{x:.1f}' y='{y:.1f}' width='{max(width - 1, 1):.1f}' height='{height:.1f}' fill='#1f5fa8'>"
            f"<title>{what}</title></rect>"
        )
    ends = "".join(
        f"<text x='{x}' y='{HEIGHT - 6}' font-size='12' text-anchor='{anchor}' fill='#555b63'>{value:g} ms</text>"
        for x, value, anchor in ((LEFT, first, "start"), (WIDTH - 8, last, "end"))
    )
    return (
        f"<figure><figcaption>{title}</figcaption><svg viewBox='0 0 {WIDTH} {HEIGHT}' role='img'>"
        f"{''.join(bars)}{ends}</svg></figure>"
    )


def plot(title: str, t_s: Column, lines: Sequence[Line], limit: float, name: str, marks: Sequence[Moment] = ()) -> str:
    """Time to the right; the limit dashed; a mark at each moment."""
    finite = np.concatenate([line.values[np.isfinite(line.values)] for line in lines] + [np.array([limit])])
    low, high = float(min(finite.min(), 0.0)), float(finite.max())
    if high - low < 1e-9:
        high = low + 1.0
    high += 0.05 * (high - low)
    span = max(float(t_s[-1]), 1e-9)

    def x(t: float) -> float:
        return LEFT + (WIDTH - LEFT - 8) * t / span

    def y(value: float) -> float:
        return HEIGHT - BOTTOM - (HEIGHT - BOTTOM - 10) * (value - low) / (high - low)

    parts = [_axes(span, x), f"<text x='4' y='{y(low) + 4:.0f}'>{low:.3g}</text><text x='4' y='16'>{high:.3g}</text>"]
    for mark in marks:
        parts.append(
            f"<line x1='{x(mark.t_s):.1f}' x2='{x(mark.t_s):.1f}' y1='10' y2='{HEIGHT - BOTTOM}' stroke='#b3261e' "
            f"stroke-opacity='.5'><title>{_text(mark.text)}</title></line>"
        )
    parts.append(
        f"<line x1='{LEFT}' x2='{WIDTH - 8}' y1='{y(limit):.1f}' y2='{y(limit):.1f}' stroke='#b3261e' "
        f"stroke-dasharray='5 4'/>"
        f"<text x='{WIDTH - 8}' y='{y(limit) - 3:.1f}' text-anchor='end' fill='#b3261e'>{name}</text>"
    )
    parts += [_polyline(t_s, line, x, y) for line in lines]
    legend = ", ".join(f"<tspan fill='{line.colour}'>{_text(line.name)}</tspan>" for line in lines)
    return _svg(f"<text x='{LEFT}' y='12'>{_text(title)}: {legend}</text>" + "".join(parts), HEIGHT)


def _polyline(t_s: Column, line: Line, x: Any, y: Any) -> str:
    """Least and greatest value of each bin; gaps where there is none."""
    edges = np.unique(np.linspace(0, len(t_s), min(BINS, len(t_s)) + 1).astype(int))
    runs: list[list[str]] = [[]]
    for start, end in zip(edges[:-1], edges[1:], strict=True):
        values = line.values[start:end]
        values = values[np.isfinite(values)]
        if not len(values):
            if runs[-1]:
                runs.append([])
            continue
        runs[-1] += [f"{x(float(t_s[start])):.1f},{y(float(v)):.1f}" for v in (values.min(), values.max())]
    return "".join(
        f"<polyline points='{' '.join(run)}' fill='none' stroke='{line.colour}' stroke-width='1.3'/>"
        for run in runs
        if run
    )


def _modes(e: Evidence) -> str:
    """A band that shows the mode over time."""
    mode, t_s = e.mode, e.t_s
    starts = np.flatnonzero(np.append(True, mode[1:] != mode[:-1]))
    ends = np.append(starts[1:], len(mode) - 1)
    span, parts = max(float(t_s[-1]), 1e-9), []
    for start, end in zip(starts, ends, strict=True):
        name = Mode(int(mode[start]))
        left, right = (LEFT + (WIDTH - LEFT - 8) * float(t_s[i]) / span for i in (start, end))
        parts.append(
            f"<rect x='{left:.1f}' y='18' width='{max(right - left, 0.8):.1f}' height='16' fill='{MODE_COLOURS[name]}'>"
            f"<title>{name.name} from {float(t_s[start]):.3f} s</title></rect>"
        )
    used = [Mode(int(m)) for m in np.unique(mode)]
    legend = ", ".join(f"<tspan fill='{MODE_COLOURS[m]}'>{m.name}</tspan>" for m in used)
    return _svg(f"<text x='{LEFT}' y='12'>mode: {legend}</text>" + "".join(parts), 40)


def _axes(span: float, x: Any) -> str:
    step = 10 ** math.floor(math.log10(span / 4))
    step *= next(k for k in (1, 2, 5, 10) if span / (k * step) <= 10)
    ticks = (k * step for k in range(int(span / step) + 1))
    marks = (
        f"<line x1='{x(t):.1f}' x2='{x(t):.1f}' y1='{HEIGHT - BOTTOM}' y2='{HEIGHT - BOTTOM + 4}' stroke='#888'/>"
        f"<text x='{x(t):.1f}' y='{HEIGHT - 6}' text-anchor='middle'>{t:g} s</text>"
        for t in ticks
    )
    frame = f"<line x1='{LEFT}' x2='{WIDTH - 8}' y1='{HEIGHT - BOTTOM}' y2='{HEIGHT - BOTTOM}' stroke='#888'/>"
    return frame + "".join(marks)


def _svg(content: str, height: int) -> str:
    return (
        f"<figure><svg viewBox='0 0 {WIDTH} {height}' width='100%' font-size='11' font-family='system-ui,sans-serif' "
        f"fill='#1d2126'>{content}</svg></figure>"
    )
