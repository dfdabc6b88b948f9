"""One picture per calibration that shows whether to believe it: where the data are, what is left over.

Each function draws what its method worked on; `page` adds the numbers and the verdict. Drawn without a display.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from calibration import drift, hand_eye, intrinsics, vision
from calibration.geometry import difference, inverse
from calibration.result import KINDS, POSE, Result

SEEN, EXPECTED = "#1f77b4", "#d62728"
ARROWS = 30  # a residual is drawn this many times longer


def page(result: Result, panels: int) -> tuple[Figure, list[Axes]]:
    """A figure with the verdict on the left and `panels` axes."""
    columns = 1 + -(-panels // 2)
    figure = Figure(figsize=(4.6 * columns, 7.6), layout="constrained")
    grid = figure.add_gridspec(2, columns)
    said = figure.add_subplot(grid[:, 0])
    said.axis("off")
    colour = "#2a7a2a" if result.accepted else EXPECTED
    said.text(0, 1, f"{result.kind}: {'accepted' if result.accepted else 'REFUSED'}", va="top", size=15, color=colour)
    said.text(0, 0.93, "\n".join(_numbers(result)), va="top", size=8.5, family="monospace")
    return figure, [figure.add_subplot(grid[i % 2, 1 + i // 2]) for i in range(panels)]


def _numbers(result: Result) -> list[str]:
    names, over = KINDS[result.kind]
    sigma = dict(zip(over, result.sigma, strict=True))
    lines = [f"frame {result.frame}", ""]
    lines += [
        f"{name:7} {value:12.6g} {unit:3}" + (f" +- {sigma[name]:.2g}" if name in sigma else "")
        for (name, unit), value in zip(names.items(), result.value, strict=True)
    ]
    if names is POSE:
        lines += [f"{name:7} {'':12} rad +- {sigma[name]:.2g}" for name in ("wx", "wy", "wz")]
    numbers = {key: value for key, value in result.quality.items() if isinstance(value, int | float)}
    lines += ["", *(f"{key:17} {value:.4g}" for key, value in numbers.items())]
    lines += ["", f"valid {result.valid_from} to {result.valid_until}", ""]
    wrapped = [fill(f"- {reason}", 50, subsequent_indent="  ") for reason in result.reasons]
    dropped = result.quality.get("dropped", [])
    return lines + wrapped + [fill(f"left out: {line}", 50, subsequent_indent="  ") for line in dropped]


def draw_intrinsics(
    path: Path, result: Result, pictures: intrinsics.Pictures, images: dict[str, np.ndarray], board: vision.Board
) -> None:
    figure, (cover, arrows, typical, worst, halves, histogram) = page(result, 6)
    cells = intrinsics.coverage(pictures)
    cover.imshow(cells, cmap="Greens", extent=(0, pictures.size[0], pictures.size[1], 0), vmin=0)
    for d in pictures.detections:
        cover.plot(*d.pixels.T, ".", ms=1, color="black")
    cover.set_title(f"corners seen: {np.mean(cells > 0):.0%} of the cells")
    K, distortion = result.camera_matrix(), result.distortion()
    expected = [expected_pixels(d, board, K, distortion) for d in pictures.detections]
    left = [vision.residual(e, d.pixels) for e, d in zip(expected, pictures.detections, strict=True)]
    pixels, r = np.concatenate([d.pixels for d in pictures.detections]), np.concatenate(left)
    arrows.quiver(*pixels.T, *(ARROWS * r).T, angles="xy", scale_units="xy", scale=1, width=1.5e-3, color=EXPECTED)
    _picture_axes(arrows, pictures.size, f"residuals, {ARROWS} times longer")
    rms = np.array([np.sqrt(np.mean(np.sum(part**2, axis=1))) for part in left])
    order = np.argsort(rms)
    for axes, i, words in ((typical, int(order[len(order) // 2]), "typical"), (worst, int(order[-1]), "worst")):
        name = pictures.names[i]
        overlay(axes, images[name], pictures.detections[i].pixels, expected[i], f"{words}: {name}, {rms[i]:.2f} px")
    grid, gap = intrinsics.ray_difference(intrinsics.fitted(pictures), board, pictures.size)
    shown = halves.tricontourf(grid[:, 0], grid[:, 1], gap, levels=12, cmap="viridis")
    figure.colorbar(shown, ax=halves, label="px")
    _picture_axes(halves, pictures.size, "rays of two halves of the views differ by")
    histogram.hist(r.ravel(), bins=60, color=SEEN)
    histogram.set(title="residuals", xlabel="px")
    figure.savefig(path, dpi=90)


def expected_pixels(d: vision.Detection, board: vision.Board, K: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """(n, 2) where the corners of a detection should be if the board is where it fits best."""
    return vision.project(board.corners()[d.ids], vision.board_pose(d, board, K, distortion, 1.0)[0], K, distortion)


def overlay(axes: Axes, image: np.ndarray, seen: np.ndarray, expected: np.ndarray, title: str) -> None:
    axes.imshow(image, cmap="gray", vmin=0, vmax=255)
    axes.plot(*seen.T, "+", ms=6, color=SEEN, label="seen")
    axes.plot(*expected.T, "o", ms=5, mfc="none", color=EXPECTED, label="expected")
    axes.legend(loc="lower right", fontsize=7)
    axes.set_title(title, fontsize=10)
    axes.axis("off")


def _picture_axes(axes: Axes, size: tuple[int, int], title: str) -> None:
    axes.set(xlim=(0, size[0]), ylim=(size[1], 0), aspect="equal", title=title)


def draw_hand_eye(
    path: Path, result: Result, solution: hand_eye.Solution, views: hand_eye.Views, noise: hand_eye.RobotNoise,
    shown: Sequence[tuple[str, np.ndarray, vision.Detection, np.ndarray]],
) -> None:  # fmt: skip
    """`shown`: name, picture, corners seen and (n, 2) px where the robot's pose puts them, of some views."""
    figure, axes = page(result, 4 + len(shown))
    Z, X = solution.T_base_cam, solution.T_flange_board
    predicted = inverse(Z) @ views.flange @ X
    r = difference(views.board, predicted)
    axes[0].plot(1e3 * r[:, :3], "o-", ms=3, lw=0.5, label=["x", "y", "z"])
    axes[0].set(title="board against what robot and result say", ylabel="mm", xlabel="view, the last ones held out")
    axes[1].plot(np.degrees(r[:, 3:]), "o-", ms=3, lw=0.5, label=["x", "y", "z"])
    axes[1].set(ylabel="deg", xlabel="view")
    for a in axes[:2]:
        a.legend(fontsize=7)
        a.axvline(len(views) - hand_eye.HOLD_OUT - 0.5, color="grey", lw=0.8)
    normal = hand_eye.whitened_residuals(solution, views, noise)
    axes[2].hist(normal.ravel(), bins=30, density=True, color=SEEN)
    x = np.linspace(-4, 4, 80)
    axes[2].plot(x, np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi), color=EXPECTED)
    axes[2].set(title="residuals over their sigma, and what is expected", xlabel="sigma")
    places = views.flange[:, :3, 3]
    axes[3].scatter(places[:, 0], places[:, 1], c=places[:, 2], cmap="viridis")
    axes[3].plot(*Z[:2, 3], "^", color=EXPECTED, ms=9)
    axes[3].plot(0, 0, "s", color="black")
    axes[3].set(title="flange (dots), camera (triangle), base (square), from above", xlabel="x m", ylabel="y m")
    axes[3].set_aspect("equal", adjustable="datalim")
    for a, (name, image, detection, expected) in zip(axes[4:], shown, strict=True):
        overlay(a, image, detection.pixels, expected, name)
    figure.savefig(path, dpi=90)


def draw_tool(path: Path, result: Result, flange: np.ndarray) -> None:
    figure, (gaps, places) = page(result, 2)
    tips = flange[:, :3, :3] @ np.array(result.value) + flange[:, :3, 3]
    r = 1e3 * (tips - tips.mean(0))
    gaps.plot(r, "o-", ms=4, lw=0.5, label=["x", "y", "z"])
    gaps.legend(fontsize=7)
    gaps.set(title="where each touch puts the point", ylabel="mm", xlabel="touch")
    for tip, T in zip(tips, flange, strict=True):
        places.plot([T[0, 3], tip[0]], [T[2, 3], tip[2]], lw=0.8, color=SEEN)
    places.plot(tips[:, 0], tips[:, 2], ".", color=EXPECTED)
    places.set(title="flange to tip, from the side", xlabel="x m", ylabel="z m", aspect="equal")
    figure.savefig(path, dpi=90)


def draw_payload(path: Path, result: Result, left: np.ndarray) -> None:
    """`left`: (n, dof) Nm that the payload and the biases leave unexplained."""
    figure, (per_joint, per_pose) = page(result, 2)
    per_joint.boxplot(left)
    per_joint.set(title="torque left unexplained", xlabel="joint", ylabel="Nm")
    per_pose.plot(left, "o-", ms=3, lw=0.5)
    per_pose.set(xlabel="pose", ylabel="Nm")
    figure.savefig(path, dpi=90)


def draw_time_offset(path: Path, result: Result, offsets: np.ndarray, costs: np.ndarray, left: np.ndarray) -> None:
    """`costs` over trial `offsets` (s), and `left` (n, 3) m that the best one leaves."""
    figure, (cost, gaps) = page(result, 2)
    cost.plot(1e3 * offsets, costs, color=SEEN)
    cost.axvline(1e3 * result.value[0], color=EXPECTED, lw=0.8)
    cost.set(title="how badly the traces fit", xlabel="offset, ms", ylabel="rms, m", yscale="log")
    gaps.plot(1e3 * left, lw=0.6)
    gaps.set(title="left over at the best offset", xlabel="sample", ylabel="mm")
    figure.savefig(path, dpi=90)


def draw_drift(
    path: Path, found: drift.Drift, frames: dict[str, drift.Frame], scenes: list[drift.Scene], T_base_cam: np.ndarray,
    K: np.ndarray, distortion: np.ndarray,
) -> None:  # fmt: skip
    """The first frames, with the outline of the robot as it is drawn, and how far the points lie from it."""
    shown = list(frames.items())[:3]
    figure = Figure(figsize=(5 * len(shown), 7.6), layout="constrained")
    verdict = (
        "; ".join(found.reasons) or f"shift {1e3 * found.shift:.1f} mm, outside {1e3 * found.outside:.1f} mm: good"
    )
    figure.suptitle(fill(verdict, 100), color=EXPECTED if found.reasons else "#2a7a2a", fontsize=11)
    for i, ((name, frame), scene) in enumerate(zip(shown, scenes, strict=False)):
        v, u, flat = drift.grid(frame.depth.shape, K, distortion)
        shape = len(np.unique(v)), len(np.unique(u))
        z = frame.depth[v, u]
        reached, _ = drift.expected(scene, T_base_cam, flat / np.linalg.norm(flat, axis=1, keepdims=True))
        gap = scene.distance((flat * z[:, None]) @ T_base_cam[:3, :3].T + T_base_cam[:3, 3])[0]
        seen, left = figure.add_subplot(2, len(shown), 1 + i), figure.add_subplot(2, len(shown), 1 + len(shown) + i)
        seen.imshow(np.where(z > 0, z, np.nan).reshape(shape), cmap="gray_r")
        seen.contour(np.isfinite(reached).reshape(shape), levels=[0.5], colors=EXPECTED, linewidths=1)
        seen.set_title(f"{name}: depth, and the robot as drawn")
        near = np.where((z > 0) & (np.abs(gap) < 2 * drift.MARGIN), 1e3 * gap, np.nan).reshape(shape)
        colours = left.imshow(near, cmap="coolwarm", vmin=-1e3 * drift.MARGIN, vmax=1e3 * drift.MARGIN)
        figure.colorbar(colours, ax=left, label="mm from the robot's surface")
        for axes in (seen, left):
            axes.axis("off")
    figure.savefig(path, dpi=90)
