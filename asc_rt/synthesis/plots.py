"""Pictures beside a certificate: the distributions of M and M_dot, and the worst poses as stick figures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from asc_rt.core.kinematics import forward
from asc_rt.core.robot_model import RobotModel
from asc_rt.core.types import IntVector, Matrix
from asc_rt.synthesis.certificate import Certificate, Worst
from asc_rt.synthesis.certify import Result
from asc_rt.synthesis.statistics import EDGES, quantile

SHOWN = 0.999  # of the states are inside the axis
BARS = 60


def save(result: Result, path: Path) -> list[Path]:
    """Writes PATH-distribution.png and PATH-poses.png; their names."""
    files = [path.with_name(f"{path.stem}-distribution.png"), path.with_name(f"{path.stem}-poses.png")]
    distribution(result).savefig(files[0], dpi=80)
    poses(result.certificate, result.model).savefig(files[1], dpi=70)
    return files


def distribution(result: Result) -> Figure:
    c, found = result.certificate, result.statistics.histograms
    figure = Figure(figsize=(10, 3.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    _bars(left, found["ball"], "zero-centred radius (paper)", "0.6")
    _bars(left, found["M"], "one-sided radius", "tab:blue")
    left.set(
        xlabel="M, m/s²",
        ylabel="share of states per m/s²",
        title=f"M from {c.sampled.M_min:.3g} to {c.sampled.M_max:.3g}",
    )
    _bars(right, found["steepest"], "greatest |rate| of the zero-centred radius (paper)", "0.6")
    _bars(right, found["falling"], "fastest fall of the one-sided radius", "tab:red")
    right.set(xlabel="M_dot, m/s³", ylabel="share of states per m/s³", title=f"M_dot* = {c.sampled.M_dot_star:.4g}")
    for axes in (left, right):
        axes.legend(fontsize=8)
    figure.suptitle(f"{c.robot.name} with {c.tool.name}, {c.control}, {c.sampled.samples} states, seed {c.seed}")
    return figure


def _bars(axes: Axes, histogram: IntVector, label: str, colour: str) -> None:
    """The histogram's fixed bins, gathered into bars of equal width between two quantiles."""
    low, high = quantile(histogram, 1.0 - SHOWN), quantile(histogram, SHOWN)
    bars = np.linspace(low, high, BARS + 1)
    cumulative = np.concatenate(([0.0], np.cumsum(histogram) / histogram.sum()))
    density = np.diff(np.interp(bars, EDGES, cumulative)) / np.diff(bars)
    axes.stairs(density, bars, label=label, color=colour, fill=colour == "0.6", alpha=0.6 if colour == "0.6" else 1.0)


def poses(certificate: Certificate, model: RobotModel) -> Figure:
    figure = Figure(figsize=(12, 7.5), layout="constrained")
    for i, worst in enumerate(certificate.worst):
        axes = figure.add_subplot(2, 3, i + 1, projection="3d")
        _stick(axes, worst, model)
    figure.suptitle(f"{certificate.robot.name} with {certificate.tool.name}: worst states; person red, speed as arrow")
    return figure


def _stick(axes: Any, worst: Worst, model: RobotModel) -> None:
    motion = forward(model.chain, np.array(worst.q), np.array(worst.dq))
    line: Matrix = np.vstack((np.zeros(3), motion.origin))
    axes.plot(*line.T, "-o", color="0.3", markersize=3)
    capsules = model.capsules
    for i, joint in enumerate(capsules.joint):
        ends = np.array((capsules.p0[i], capsules.p1[i]))
        placed = ends @ motion.rotation[joint].T + motion.origin[joint] if joint >= 0 else ends
        mine = model.capsule_names[i] == worst.capsule
        colour, width = ("tab:blue", 5.0) if mine else ("0.75", 2.0)
        axes.plot(*placed.T, color=colour, linewidth=width, solid_capstyle="round")
        if mine:
            middle = placed.mean(axis=0)
            speed = motion.velocity[joint] + np.cross(motion.omega[joint], middle - motion.origin[joint])
            axes.quiver(*middle, *(0.15 * speed), color="tab:blue")
    axes.plot(*np.array([worst.point]).T, "o", color="tab:red")
    span = np.vstack((line, [worst.point]))
    centre, half = 0.5 * (span.min(axis=0) + span.max(axis=0)), 0.55 * float(np.ptp(span, axis=0).max())
    axes.set(xlim=(centre[0] - half, centre[0] + half), ylim=(centre[1] - half, centre[1] + half))
    axes.set_zlim(centre[2] - half, centre[2] + half)
    axes.set_title(f"{worst.why}: {worst.value:.4g}\n{worst.capsule}, M = {worst.M:.3g} m/s²", fontsize=9)
    axes.tick_params(labelsize=6)
