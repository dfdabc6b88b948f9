"""What the viewer shows and how: entities, colours, and the one arrangement made for this cell."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from asc_rt.core.params import Params

Array = np.ndarray[Any, Any]
Colour = tuple[int, int, int]

APPLICATION = "asc"
TIMELINE = "session"  # seconds since the first cycle

# --- colours ---------------------------------------------------------------------------------------------------------

GREEN, AMBER, RED = (52, 199, 89), (255, 204, 0), (255, 59, 48)
BLUE, ORANGE, GREY, PALE, VIOLET = (64, 156, 255), (255, 149, 0), (142, 142, 147), (120, 200, 235), (191, 110, 255)
PHI_SCALE = 0.25  # ASSUMED: |phi| at which a colour is at its end; phi* at 0.5 m and rest is about -0.25

MODES = {"IDLE": GREY, "HOLD": PALE, "ACTIVE": GREEN, "STOPPING": ORANGE, "STOPPED": AMBER, "FAULT": RED, "ENDED": GREY}
FILTER = {"PASS": GREEN, "FILTERED": AMBER, "INFEASIBLE": RED, "BAD_INPUT": RED, "STOPPED": GREY}


def phi_colours(phi: Array) -> Array:
    """(..., 4) of 0..255: green below 0, amber at 0, red above."""
    share = np.where(np.isnan(phi), 1.0, np.clip(phi, -PHI_SCALE, PHI_SCALE) / PHI_SCALE)[..., None]
    low, middle, high = (np.array([*colour, 255.0]) for colour in (GREEN, AMBER, RED))
    mixed = np.where(share < 0.0, middle + share * (middle - low), middle + share * (high - middle))
    colours: Array = np.round(mixed).astype(np.uint8)
    return colours


# --- plots -----------------------------------------------------------------------------------------------------------

# entity -> (title with unit, series (name, colour, width))
PLOTS: dict[str, tuple[str, list[tuple[str, Colour, float]]]] = {
    "distance": (
        "distance robot - person, m: judged = set-point and predicted person",
        [("measured", BLUE, 2.5), ("judged", PALE, 1.0), ("d_min", RED, 1.5)],
    ),
    "phi": ("safety index phi, worst pair (above 0 it has to fall)", [("phi", VIOLET, 2.0), ("0", RED, 1.0)]),
    "d_dot": ("d_dot of the nearest pair, m/s", [("d_dot", BLUE, 1.5), ("0", GREY, 1.0)]),
    "M": ("M of the nearest pair, m/s2 (red: floor)", [("M", BLUE, 1.5), ("M_floor", RED, 1.0)]),
    "M_dot": ("M_dot of the nearest pair, m/s3", [("M_dot", BLUE, 1.5)]),
    "age": ("age of the human data, ms (red: limit)", [("age", BLUE, 1.5), ("limit", RED, 1.0)]),
    "monitor": (
        "speed and separation, m: distance to where the person was seen, protective distance S_p",
        [("distance", BLUE, 2.0), ("S_p", RED, 1.5)],
    ),
    "cycle": ("one cycle, ms (red: period)", [("wake to write", BLUE, 1.5), ("period", RED, 1.0)]),
}
TRUE_DISTANCE = "plot/distance_true"
NEAR_MISSES = "plot/near_misses"
DISTANCES = ["+ /plot/distance", f"+ /{TRUE_DISTANCE}", f"+ /{NEAR_MISSES}"]
CONTROL = [("reference, rad/s2", GREY, 3.0), ("safe", BLUE, 1.5), ("sent", ORANGE, 1.5)]


def log_styles(recording: rr.RecordingStream, joints: tuple[str, ...]) -> None:
    """Names and colours of every line and state: they never change."""
    lines = {f"plot/{name}": series for name, (_, series) in PLOTS.items()}
    lines |= {f"plot/u/{joint}": CONTROL for joint in joints}
    lines[TRUE_DISTANCE] = [("simulator", GREY, 1.0)]
    for entity, series in lines.items():
        names, colours, widths = zip(*series, strict=True)
        style = rr.SeriesLines(names=list(names), colors=list(colours), widths=list(widths))
        recording.log(entity, style, static=True)
    marker = rr.SeriesPoints(names="near miss", colors=RED, markers="Circle", marker_sizes=5.0)
    recording.log(NEAR_MISSES, marker, static=True)
    for name, states in (("mode", MODES), ("safety_filter", FILTER)):
        style_of = rr.StateConfiguration(values=list(states), colors=[(*colour, 255) for colour in states.values()])
        recording.log(f"state/{name}", style_of, static=True)


# --- arrangement -----------------------------------------------------------------------------------------------------

# ASSUMED: the arm stands on a pedestal of this height in all cells so far; only drawn.
FLOOR_Z = -0.6
EYE_DISTANCE, EYE_HEIGHT = 2.25, 0.8  # m; ASSUMED, like LOOK_AT: arm and upper body of a standing person fill the view
LOOK_AT = (0.35, 0.12)  # m, out from the base towards the person, and up
WINDOW_S = 4.0  # seconds before and after the cursor in the detailed plots
LIVE_S = 60.0  # what the plots of the whole session show while it goes on


def layout(
    params: Params,
    session_s: tuple[float, float] | None,
    joint: int = 0,
    towards: float = 0.0,
    picture: bool = False,
    cameras: Sequence[str] = (),
) -> rrb.Blueprint:
    """Left: the scene, the whole of it, what happened. Right: the seconds around the cursor.

    `joint`: index of the one whose control is in front. `towards`: direction of the person from the base, rad from x;
    the eye looks across it. `session_s`: begin and end of what is shown; None: it goes on, and the cursor follows the
    newest cycle. `picture`: without menus. `cameras`: entities with images, shown beside the scene.
    """
    live = session_s is None
    window = _around_cursor(-2.0 * WINDOW_S, 0.0) if live else _around_cursor(-WINDOW_S, WINDOW_S)
    session = _around_cursor(-LIVE_S, 0.0) if session_s is None else _absolute(*session_s)
    reach = 1.2 * params.safety.activation_distance
    whole = _plot("distance, over all that is shown, m", DISTANCES, session, (-0.1, reach))
    eyes = [rrb.Spatial2DView(name=entity, origin=f"/{entity}") for entity in cameras]
    scene = rrb.Horizontal(_scene(towards), rrb.Vertical(*eyes), column_shares=[3.0, 1.0]) if eyes else _scene(towards)
    left = rrb.Vertical(scene, whole, _states(session), _events(), row_shares=[6.0, 1.4, 1.7, 1.7])
    single = {name: _plot(title, [f"+ /plot/{name}"], window) for name, (title, _) in PLOTS.items()}
    single["distance"] = _plot(PLOTS["distance"][0], DISTANCES, window, (-0.1, reach / 2), legend=True)
    control = rrb.Tabs(
        *(_plot(f"u {name}", [f"+ /plot/u/{name}"], window, legend=True) for name in params.robot.joints),
        active_tab=joint,
    )
    small = rrb.Grid(single["M"], single["M_dot"], single["monitor"], single["age"], single["cycle"], grid_columns=2)
    right = rrb.Vertical(
        single["distance"], single["phi"], control, single["d_dot"], small, row_shares=[1.6, 1.2, 1.3, 1.0, 1.8]
    )
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=[1.3, 1.0]),
        rrb.TopPanel(state="hidden" if picture else "expanded"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following" if live else "paused"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        auto_views=False,
    )


def _scene(towards: float) -> rrb.Spatial3DView:
    out, across = np.array([np.cos(towards), np.sin(towards)]), np.array([np.sin(towards), -np.cos(towards)])
    target = LOOK_AT[0] * out
    eye = target + EYE_DISTANCE * across
    return rrb.Spatial3DView(
        name="arm: measured; see-through: judged; lines: pairs, green phi < 0, red phi > 0",
        origin="/",
        contents=["+ /arm/**", "+ /cell/**", "+ /tf/**", "+ /tf_static"],
        background=(26, 28, 32),
        line_grid=rrb.LineGrid3D(
            spacing=0.5, plane=rr.components.Plane3D.XY.with_distance(FLOOR_Z), color=(255, 255, 255, 25)
        ),
        spatial_information=rrb.SpatialInformation(target_frame="base"),
        eye_controls=rrb.EyeControls3D(
            position=(*eye, EYE_HEIGHT), look_target=(*target, LOOK_AT[1]), eye_up=(0.0, 0.0, 1.0)
        ),
    )


def _around_cursor(start_s: float, end_s: float) -> rrb.TimeAxis:
    at = rrb.TimeRangeBoundary.cursor_relative
    return rrb.TimeAxis(view_range=rr.TimeRange(start=at(seconds=start_s), end=at(seconds=end_s)))


def _absolute(start_s: float, end_s: float) -> rrb.TimeAxis:
    at = rrb.TimeRangeBoundary.absolute
    return rrb.TimeAxis(view_range=rr.TimeRange(start=at(seconds=start_s), end=at(seconds=end_s)))


def _states(window: rrb.TimeAxis) -> rrb.StateTimelineView:
    return rrb.StateTimelineView(name="mode and filter, over all that is shown", origin="/state", time_view=window)


def _events() -> rrb.TextLogView:
    columns = rrb.TextLogColumns(timeline_columns=[TIMELINE], text_log_columns=["LogLevel", "Body"])
    return rrb.TextLogView(name="what happened", origin="/events", columns=columns)


def _plot(
    name: str,
    contents: list[str],
    window: rrb.TimeAxis,
    y: tuple[float, float] | None = None,
    legend: bool = False,
) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        name=name,
        origin="/plot",
        contents=contents,
        axis_x=window,
        axis_y=None if y is None else rrb.ScalarAxis(range=y),
        plot_legend=rrb.PlotLegend(visible=legend, corner=rrb.Corner2D.LeftTop),
    )
