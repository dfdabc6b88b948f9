"""Show a session in Rerun: a recording in a window, a browser, a file or a picture; or the running cell, live.

    view("runs/x.mcap")                                  a window; needs a display
    view("runs/x.mcap", web=True)                        for a browser on this machine
    view("runs/x.mcap", save=Path("x.rrd"))              to look at later
    view("runs/x.mcap", shot=Path("x.png"), at=16.2)     a picture; needs no display

The viewer listens on this machine only, and reports nothing to anybody.
"""

from __future__ import annotations

import json
import math
import tempfile
from pathlib import Path

import numpy as np
import rerun as rr
from tqdm import tqdm

from logs import schema
from logs.mcap_scan import LogError
from logs.recording import Recording, open_recording
from logs.view_columns import Canvas, in_blocks, new_recording
from logs.view_events import Chronicle, Event, draw_events, draw_near_misses, ending, focus, nearest_moments
from logs.view_layout import TRUE_DISTANCE, WINDOW_S, layout
from logs.view_process import ViewError, browser_arguments, free_port, need_display, screenshot, viewer

__all__ = ["ViewError", "view", "write_rrd"]

# Cycles that the scene shows at most: ten minutes at 125 Hz, 150 MB. The plots always have them all.
SCENE_CYCLES = 75_000
PICTURE_S = 60.0  # of the session before and after the moment of a picture


def view(
    path: str | Path, save: Path | None = None, shot: Path | None = None, at: float | None = None, web: bool = False
) -> None:
    """Show the recording `path`. `at`: moment of the picture, s since the start; default: when robot and person were
    nearest. LogError: the file; ViewError: it cannot be shown here, or there is nothing to show."""
    log = open_recording(path)
    start_ns, end_ns = _extent(log)
    if at is not None and shot is None:
        raise ViewError("--at S is the moment of a picture: it needs --shot FILE.png")
    if at is not None and not 0.0 <= at <= (end_ns - start_ns) * 1e-9:  # also refuses NaN
        raise ViewError(f"--at {at:g}: the recording goes from 0 to {(end_ns - start_ns) * 1e-9:.3f} s")
    moment_ns = round(at * 1e9) + start_ns if at is not None else nearest_moments(log).worst_ns
    if save is not None:
        write_rrd(log, save, moment_ns)
    if shot is not None:
        shot.write_bytes(picture(log, (moment_ns - start_ns) * 1e-9))
    if save is None and shot is None:
        _show(log, moment_ns, web)


def write_rrd(log: Recording, path: Path, moment_ns: int, part: Recording | None = None) -> None:
    """The recording with its layout, as the viewer's own file. `moment_ns`: what the eye is set up for, on the clock of
    the record. `part`: all that is drawn, for a picture, without menus. ViewError: no cycles in it."""
    start_ns = _extent(log)[0]
    whole, log, picture = log, part or log, part is not None
    first_ns, end_ns = _extent(log)
    with open(path, "wb"):  # an error of the path is ours to tell, in one line
        pass
    recording = new_recording(log.path.stem)
    recording.save(path)
    seen = focus(log, moment_ns, round(WINDOW_S * 1e9))
    cameras = [topic.removeprefix("/cell/") for topic in _cameras(log)]
    shown_s = ((first_ns - start_ns) * 1e-9, (end_ns - start_ns) * 1e-9)
    recording.send_blueprint(layout(log.params, shown_s, seen.joint, seen.towards, picture, cameras))
    canvas = Canvas(recording, log.params, start_ns, math.ceil(log.cycles / SCENE_CYCLES))
    chronicle = Chronicle(canvas)
    events: list[Event] = []
    with tqdm(total=log.cycles, unit=" cycles", disable=None) as bar:
        for block in in_blocks(log.batches()):
            now, following = block[:-1], block[1:]
            canvas.draw(now, following)
            events += chronicle.draw(now, following)
            bar.update(len(now))
    _draw_truth(canvas, log, first_ns, end_ns)
    _draw_cameras(canvas, log, first_ns, end_ns)
    events += draw_near_misses(canvas, nearest_moments(log))
    events.append(ending(whole))
    draw_events(canvas, events)
    recording.flush()
    recording.disconnect()


def _draw_truth(canvas: Canvas, log: Recording, start_ns: int, end_ns: int) -> None:
    """The distance in the simulator's physics, beside what the controller believed."""
    try:
        rows = [json.loads(message.data) for message in log.messages(schema.TRUTH.topic)]
        distance = np.array([r["distance_m"] for r in rows], float)  # None, nobody there, becomes a gap
        t_ns = np.array([r["t_ns"] for r in rows], np.int64)
    except (ValueError, TypeError, KeyError) as error:
        raise LogError(f"{log.path}: {schema.TRUTH.topic} holds something else than the plant's truth") from error
    within = (t_ns >= start_ns) & (t_ns <= end_ns)  # the simulator is there before the controller, and after it
    if within.any():
        columns = rr.Scalars.columns(scalars=distance[within])
        canvas.recording.send_columns(TRUE_DISTANCE, [canvas.time(t_ns[within])], columns)


def _draw_cameras(canvas: Canvas, log: Recording, start_ns: int, end_ns: int) -> None:
    """What the cameras saw; depth images in metres."""
    for topic in _cameras(log):
        for message in log.messages(topic):
            if start_ns <= message.t_ns <= end_ns:
                image = schema.CompressedImage.FromString(message.data)
                canvas.image(topic.removeprefix("/cell/"), message.t_ns, image.format, image.data)


def _cameras(log: Recording) -> list[str]:
    """Topics with images."""
    found = (topic for topic in log.topics if topic.startswith(schema.CAMERAS))
    return sorted(topic for topic in found if not topic.endswith(schema.CALIBRATION))


def _extent(log: Recording) -> tuple[int, int]:
    """Monotonic ns of the first and the last cycle."""
    if log.cycles < 2:
        raise ViewError(f"{log.path}: nothing to show: {log.cycles or 'no'} cycles in it")
    dtype = log.layout.dtype
    first, last = (np.frombuffer(log.record(i), dtype)[0]["inputs.t_ns"] for i in (0, log.cycles - 1))
    return int(first), int(last)


def picture(log: Recording, at_s: float) -> bytes:
    """PNG of the moment `at_s` after the start, with PICTURE_S before and after it: an hour is not drawn for one
    moment. ViewError."""
    start_ns = _extent(log)[0]
    moment_ns = start_ns + round(at_s * 1e9)
    with tempfile.TemporaryDirectory(prefix="asc-view-") as folder:
        rrd = Path(folder, f"{log.path.stem}.rrd")
        write_rrd(log, rrd, moment_ns, log.around(moment_ns, round(PICTURE_S * 1e9)))
        return screenshot(rrd, moment_ns - start_ns)


def _show(log: Recording, moment_ns: int, web: bool) -> None:
    """In a window or for a browser, until it is closed or Ctrl-C."""
    port = free_port()
    if not web:
        need_display("--web, --save FILE.rrd or --shot FILE.png")
    with tempfile.TemporaryDirectory(prefix="asc-view-") as folder:
        rrd = Path(folder, f"{log.path.stem}.rrd")
        write_rrd(log, rrd, moment_ns)
        with viewer(str(rrd), "--port", str(port), *(browser_arguments(port) if web else [])) as running:
            running.wait()
