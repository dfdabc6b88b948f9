"""Guided capture: what the pictures so far lack, and what to show next."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from calibration import intrinsics, vision
from calibration.files import PICTURES
from calibration.hand_eye import LEAST_ROTATION_DEG, rotation_spread
from calibration.intrinsics import CELLS, LEAST_COVERAGE, LEAST_TILT_DEG, Pictures
from calibration.result import Result
from calibration.vision import Board

ENOUGH = 24  # views; every fourth is held out
ENOUGH_ON_ARM = 24
LEAST_SPAN = 0.1  # m that the board should travel along each axis of the camera
PERIOD = 0.5  # s between looks at the folder
PLACES = (("top left", "top", "top right"), ("left", "middle", "right"), ("bottom left", "bottom", "bottom right"))


def advice(pictures: Pictures, board: Board) -> list[str]:
    """What to show next, most urgent first; empty: enough."""
    lines = []
    cells = intrinsics.coverage(pictures) > 0
    if cells.mean() < LEAST_COVERAGE:
        lines.append(f"show the board at the {_emptiest(cells)} of the picture: coverage {cells.mean():.0%}")
    tilt = seen_tilt(pictures, board)
    if tilt < LEAST_TILT_DEG:
        lines.append(f"tilt it more, about both axes: {tilt:.0f} of {LEAST_TILT_DEG:.0f} deg")
    if (n := len(pictures.detections)) < ENOUGH:
        lines.append(f"more views: {n} of {ENOUGH}")
    return lines


def advice_on_arm(pictures: Pictures, board: Board, lens: Result) -> list[str]:
    """The same for a board that the arm carries before the camera of `lens`."""
    lines, n = [], len(pictures.detections)
    if n >= 2:
        K, distortion = lens.camera_matrix(), lens.distortion()
        T = np.array([vision.board_pose(d, board, K, distortion, 1.0)[0] for d in pictures.detections])
        if (spread := rotation_spread(T[:, :3, :3])) < 1.3 * LEAST_ROTATION_DEG:
            lines.append(f"turn the flange farther, about two axes: {spread:.0f} of {1.3 * LEAST_ROTATION_DEG:.0f} deg")
        low, high = T[:, :3, 3].min(0), T[:, :3, 3].max(0)
        for name, span in zip(("left and right", "up and down", "near and far"), high - low, strict=True):
            if span < LEAST_SPAN:
                lines.append(f"move it more {name}: {1e3 * span:.0f} of {1e3 * LEAST_SPAN:.0f} mm")
    if n < ENOUGH_ON_ARM:
        lines.append(f"more views: {n} of {ENOUGH_ON_ARM}, each with its line in the table of poses")
    return lines


def _emptiest(cells: np.ndarray) -> str:
    """The ninth of the picture with the fewest cells seen."""
    rows, columns = (np.arange(n) * 3 // n for n in CELLS)
    share = [[cells[np.ix_(rows == i, columns == j)].mean() for j in range(3)] for i in range(3)]
    i, j = divmod(int(np.argmin(share)), 3)
    return PLACES[i][j]


def seen_tilt(pictures: Pictures, board: Board) -> float:
    """deg between the most different boards, with a lens of 60 deg that is only good enough for this."""
    if len(pictures.detections) < 2:
        return 0.0
    width, height = pictures.size
    K = np.array([[0.9 * width, 0, width / 2], [0, 0.9 * width, height / 2], [0, 0, 1]])
    return intrinsics.tilt([vision.board_pose(d, board, K, np.zeros(5), 1.0)[0] for d in pictures.detections])


def watch(folder: Path, board: Board, advise: Callable[[Pictures], list[str]]) -> None:
    """Look at pictures as a camera's program puts them into `folder`, until there is enough; Ctrl-C ends it sooner."""
    folder.mkdir(parents=True, exist_ok=True)
    images: dict[str, np.ndarray] = {}
    say(f"put pictures into {folder}; Ctrl-C calibrates with what is there")
    try:
        while True:
            fresh = _fresh(folder, images)
            if fresh:
                images |= fresh
                pictures = intrinsics.look(images, board)
                for name in fresh:
                    said = [line for line in pictures.dropped if line.startswith(f"{name}: ")]
                    say(said[0] if said else f"{name}: good")
                lines = advise(pictures)
                say("; ".join(lines) if lines else "enough")
                if not lines:
                    return
            time.sleep(PERIOD)
    except KeyboardInterrupt:
        say("calibrating with what is there")


def _fresh(folder: Path, known: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Pictures that are new and whole: one that is still being written cannot be read yet, and is tried again."""
    found = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in PICTURES and path.name not in known:
            image = vision.read(path)
            if image is not None:
                found[path.name] = image
    return found


def say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
