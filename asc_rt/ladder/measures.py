"""What simulation and hardware are compared by, from a recording of a step: JSON-able numbers."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from asc_rt.ladder.rules import Run, following, measured_stops
from logs import latency

STOP_LIMITS = ("still_deg", "travel_deg", "rest_s", "latency_share")


def measures(run: Run) -> dict[str, Any]:
    """None where there is nothing to measure."""
    found, c = following(run), run.c
    spent = (c["timings.t_write_end_ns"] - c["timings.t_wake_ns"]) * 1e-6
    near = c["outputs.decision.d_measured"]
    photon = latency.statistics(latency.photon_to_command_ns(c))
    return {
        "cycles": run.e.cycles,
        "goals": int(c["state.reached_id"].max(initial=0)),
        "tracking_worst_deg": None if found is None else _round(math.degrees(found.worst)),
        "tracking_rms_deg": None if found is None else _round(math.degrees(found.rms)),
        "latency_ms": None if found is None else _round(found.latency * 1e3),
        "wake_to_sent_p50_ms": _round(float(np.percentile(spent, 50))) if len(spent) else None,
        "wake_to_sent_p99_ms": _round(float(np.percentile(spent, 99))) if len(spent) else None,
        "photon_to_command_p50_ms": photon["p50"],
        "photon_to_command_max_ms": photon["max"],
        "min_distance_m": _least(near),
        "min_distance_of_the_plant_m": _least(run.truth.distance),
        **_stops(run),
    }


def _stops(run: Run) -> dict[str, Any]:
    """Of the stop that used most of the way that the model allows."""
    found = measured_stops(run) if set(STOP_LIMITS) <= run.step.limits.keys() else []
    if not found:
        return dict.fromkeys(("stops", "stop_s", "stop_allowed_s", "stop_travel_deg", "stop_travel_allowed_deg"))
    worst = max(found, key=lambda stop: stop.travel / stop.travel_allowed)
    return {
        "stops": len(found),
        "stop_s": _round(worst.seconds),
        "stop_allowed_s": _round(worst.seconds_allowed),
        "stop_travel_deg": _round(math.degrees(worst.travel)),
        "stop_travel_allowed_deg": _round(math.degrees(worst.travel_allowed)),
    }


def _least(values: np.ndarray[Any, Any]) -> float | None:
    finite = values[np.isfinite(values)]
    return _round(float(finite.min())) if len(finite) else None


def _round(value: float) -> float:
    return round(value, 4)
