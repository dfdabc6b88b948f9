"""Photon to command: from the capture of what a cycle knew of people to the sending of its set-point."""

from __future__ import annotations

from typing import Any

import numpy as np

Column = np.ndarray[Any, Any]

COLUMNS = (
    "inputs.t_ns", "inputs.human.present", "inputs.sensors.age_ns", "inputs.sensors.count",
    "outputs.command.present", "receipt.present", "receipt.t_tx_ns",
)  # fmt: skip
BIN_MS = 10.0


def photon_to_command_ns(c: dict[str, Column]) -> Column:
    """Of every cycle that knew of people and sent a set-point, by the oldest capture of all sensors."""
    ages = c["inputs.sensors.age_ns"]
    listed = np.arange(ages.shape[1]) < c["inputs.sensors.count"][:, None]
    oldest = np.where(listed, ages, np.iinfo(np.int64).min).max(axis=1)
    sent = (c["inputs.human.present"] == 1) & (c["outputs.command.present"] == 1) & (c["receipt.present"] == 1)
    delay: Column = (c["receipt.t_tx_ns"] - c["inputs.t_ns"] + oldest)[sent & listed.any(axis=1)]
    return delay


def statistics(ns: Column) -> dict[str, Any]:
    """JSON-able, ms: percentiles, and how many cycles from each bound to the next (`histogram`: [lower bound, n])."""
    if not len(ns):
        return {"p50": None, "p99": None, "max": None, "histogram": []}
    ms = ns * 1e-6
    bins, counts = np.unique(np.floor(ms / BIN_MS), return_counts=True)
    p50, p99 = np.percentile(ms, [50, 99])
    return {
        "p50": round(float(p50), 3),
        "p99": round(float(p99), 3),
        "max": round(float(ms.max()), 3),
        "histogram": [[float(b * BIN_MS), int(n)] for b, n in zip(bins, counts, strict=True)],
    }
