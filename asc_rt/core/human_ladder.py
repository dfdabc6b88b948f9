"""The ladder: what is known of people -> full speed, slow, stop, or the end of the session.

Every expected sensor is judged on its own and the worst of them counts; one that is silent is not "nobody there".

| a sensor's                                                   | slow            | stop            | fault             |
| ------------------------------------------------------------ | --------------- | --------------- | ----------------- |
| first message has not come                                   |                 | HUMAN_MISSING   |                   |
| age and clock error together are over slow_age / age_limit   | HUMAN_STALE     | HUMAN_STALE     |                   |
| health is DEGRADED / FAULT                                   | HUMAN_UNHEALTHY | HUMAN_UNHEALTHY |                   |
| message has no capsule and no "nobody is there"              |                 | HUMAN_UNHEALTHY |                   |
| coverage is under slow_coverage / least_coverage             | HUMAN_COVERAGE  | HUMAN_COVERAGE  |                   |
| clock may be off by more than clock_limit                    |                 | HUMAN_UNSYNCED  |                   |
| newest message cannot be read, or is not its own             |                 | HUMAN_INVALID   |                   |
| newest message is duplicated or reordered                    |                 | HUMAN_INVALID   |                   |
| coordinate, velocity, radius or bound is not a number        |                 | HUMAN_INVALID   |                   |
| newest message has another schema version                    |                 |                 | HUMAN_SCHEMA      |
| newest message has another clock, or a stamp in the future   |                 |                 | HUMAN_CLOCK       |
| newest message has another calibration than the cell         |                 |                 | HUMAN_CALIBRATION |

Slow is the task's slow speed: the rows hold at any speed, and old data grow the people anyway. Lost messages need no
rung of their own: they show as age. What heals by itself stops; what a person has to mend ends the session.
"""

from __future__ import annotations

from typing import NamedTuple

from asc_rt.core.params import HumanParams, SensorParams
from asc_rt.core.people import is_finite, seen
from asc_rt.core.types import CycleInputs, Health, MessageFault, SensorReport, StopReason

NONE = StopReason.NONE
REFUSED = {
    MessageFault.UNREADABLE: StopReason.HUMAN_INVALID,
    MessageFault.ORDER: StopReason.HUMAN_INVALID,
    MessageFault.SENDER: StopReason.HUMAN_INVALID,
    MessageFault.SCHEMA: StopReason.HUMAN_SCHEMA,
    MessageFault.CLOCK: StopReason.HUMAN_CLOCK,
}


class Verdict(NamedTuple):
    """The worst reason for each; NONE: no reason."""

    slow: StopReason
    stop: StopReason  # or end the session: StopReason.is_fault


def judge(params: HumanParams, x: CycleInputs) -> Verdict:
    """The worst of all expected sensors. One that is not in the inputs is missing."""
    reports = {report.id: report for report in x.sensors}
    found = [_of_sensor(params, sensor, reports.get(sensor.id)) for sensor in params.sensors]
    if x.human is None:
        found.append(Verdict(NONE, StopReason.HUMAN_MISSING))
    elif not is_finite(seen(x.human)):
        found.append(Verdict(NONE, StopReason.HUMAN_INVALID))
    return Verdict(max(verdict.slow for verdict in found), max(verdict.stop for verdict in found))


def _of_sensor(params: HumanParams, sensor: SensorParams, report: SensorReport | None) -> Verdict:
    if report is None:
        return Verdict(NONE, StopReason.HUMAN_MISSING)
    if report.fault is not MessageFault.NONE:
        return Verdict(NONE, REFUSED[report.fault])
    if report.seq == 0:
        return Verdict(NONE, StopReason.HUMAN_MISSING)
    if report.age_ns < -(params.future_limit_ns + report.sigma_ns):
        return Verdict(NONE, StopReason.HUMAN_CLOCK)
    if report.calibration_hash != sensor.calibration_hash:
        return Verdict(NONE, StopReason.HUMAN_CALIBRATION)
    oldest_ns = report.age_ns + report.sigma_ns
    stops = {
        StopReason.HUMAN_STALE: oldest_ns > params.age_limit_ns,
        StopReason.HUMAN_UNHEALTHY: report.health is Health.FAULT or report.says_nothing,
        StopReason.HUMAN_COVERAGE: not report.coverage >= params.least_coverage,
        StopReason.HUMAN_UNSYNCED: not 0 <= report.sigma_ns <= params.clock_limit_ns,
    }
    slows = {
        StopReason.HUMAN_STALE: oldest_ns > params.slow_age_ns,
        StopReason.HUMAN_UNHEALTHY: report.health is not Health.OK,
        StopReason.HUMAN_COVERAGE: not report.coverage >= params.slow_coverage,
    }
    return Verdict(_worst(slows), _worst(stops))


def _worst(found: dict[StopReason, bool]) -> StopReason:
    return max((reason for reason, is_so in found.items() if is_so), default=NONE)
