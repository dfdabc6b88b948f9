"""The rules of the audit: what must hold in any recording. One function each; the table `RULES` is their order.

A rule judges by the record alone and by formulas of its own: it does not ask the code that it judges (but for the
geometry of capsules, in `separation`).
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from asc_rt.core import changer
from asc_rt.core.rows import nearest_measured
from asc_rt.core.system import System
from asc_rt.core.types import CommandKind, EventKind, Health, MessageFault, Mode, Status, StopReason, vector
from asc_rt.synthesis.certificate import CertificateError, covers, parse
from logs import audit_wire, latency, schema
from logs.audit_evidence import SENSOR_COLUMNS, Column, Evidence
from logs.audit_files import closed, completeness, identity, records, seals, signature
from logs.audit_finding import Finding, Rule, skip
from logs.audit_tools import tool
from logs.summary import APPROACH_M_S, stops
from logs.wire import driver_of

ROUNDING = 1e-5  # share of a limit that rounding may take: the gate allows as much
REST_STEP = 1e-9  # rad in one cycle: a set-point that stands still
MARGIN = 1e-5  # m/s2: what the solver may leave of a row
STANDING = 1e-3  # rad/s: below it the arm counts as at rest, as seen by a person beside it. ASSUMED
STOP_SLACK_S = 0.05  # ASSUMED: what a stop may take longer than its own ramp
SPACING = 2.0  # periods: a longer pause that nobody declared is a fault


# --- time ------------------------------------------------------------------------------------------------------------


def timing(e: Evidence) -> Finding:
    """While the arm moves, cycles follow each other by the period; a longer pause must be declared late or missed."""
    name, period = "timing", e.log.params.period_ns
    spacing = np.diff(e.c["inputs.t_ns"])
    if not len(spacing):
        return skip(name, "fewer than two cycles")
    declared = (e.c["inputs.late"][1:] != 0) | (e.c["inputs.missed_ticks"][1:] > 0)
    bad = e.moving[1:] & ((spacing <= 0) | ((spacing > SPACING * period) & ~declared))
    worst = int(spacing.argmax())
    spent = (e.c["timings.t_write_end_ns"] - e.c["timings.t_wake_ns"]) * 1e-6
    p50, p99, most = (float(v) for v in (*np.percentile(spent, (50, 99)), spent.max()))
    largest = float(spacing[worst]) * 1e-6
    detail = (
        f"period {period * 1e-6:g} ms, spacing median {np.median(spacing) * 1e-6:.3f}, largest {largest:.3f} ms; "
        f"wake to sent p50 {p50:.3f}, p99 {p99:.3f}, largest {most:.3f} ms; {int(declared.sum())} cycles late"
    )
    if bad.any():
        detail += f"; {int(bad.sum())} undeclared pauses, first at {e.at(int(bad.argmax()) + 1)}"
    return Finding(name, not bad.any(), detail, False, largest, SPACING * period * 1e-6, "ms", e.at(worst + 1))


def human_age(e: Evidence) -> Finding:
    """In every cycle that works towards a goal every sensor of the cell is heard, in time, healthy and its own."""
    active = e.mode_after == Mode.ACTIVE
    if not active.any():
        return skip("human age", "the arm was never active")
    p = e.log.params.human
    sensors = {name: e.c[f"inputs.sensors.{name}"] for name in SENSOR_COLUMNS}
    listed = np.arange(sensors["id"].shape[1]) < e.c["inputs.sensors.count"][:, None]
    age, oldest = sensors["age_ns"], sensors["age_ns"] + sensors["sigma_ns"]
    good = (
        listed & (sensors["fault"] == MessageFault.NONE) & (sensors["seq"] > 0) & (sensors["health"] != Health.FAULT)
        & (oldest <= p.age_limit_ns) & (age >= -p.future_limit_ns - sensors["sigma_ns"])
        & (sensors["sigma_ns"] <= p.clock_limit_ns) & (sensors["coverage"] >= p.least_coverage)
        & (sensors["says_nothing"] == 0)
    )  # fmt: skip
    usable = e.c["inputs.human.present"] == 1
    for sensor in p.sensors:
        own = (sensors["id"] == sensor.id) & (sensors["calibration_hash"] == sensor.calibration_hash)
        usable &= (good & own).any(axis=1)
    bad = active & ~usable
    if len(bad):
        bad[-1] = False  # what the last cycle led to is not in the record
    eldest = np.where(listed, oldest, 0).max(axis=1)
    worst = int(np.where(active, eldest, np.iinfo(np.int64).min).argmax())
    detail = "every sensor heard, healthy and in time in every active cycle"
    if bad.any():
        detail = f"{int(bad.sum())} active cycles without a usable sensor, first at {e.at(int(bad.argmax()))}"
    limit_ms = p.age_limit_ns * 1e-6
    return Finding("human age", not bad.any(), detail, False, eldest[worst] * 1e-6, limit_ms, "ms", e.at(worst))


def reaction(e: Evidence) -> Finding:
    """No set-point of an active cycle rests on people seen longer ago than the age limit and one period."""
    active = {name: e.c[name][e.mode_after == Mode.ACTIVE] for name in latency.COLUMNS}
    delay = latency.photon_to_command_ns(active)
    if not len(delay):
        return skip("reaction", "no active cycle knew of people")
    limit_ns = e.log.params.human.age_limit_ns + e.log.params.period_ns
    late = int((delay > limit_ns).sum())
    told = latency.statistics(delay)
    e.notes["photon_to_command_ms"] = told
    detail = f"photon to command p50 {told['p50']:.1f}, p99 {told['p99']:.1f}, largest {told['max']:.1f} ms"
    if late:
        detail += f"; {late} cycles over the age limit and one period"
    return Finding("reaction", not late, detail, False, told["max"], limit_ns * 1e-6, "ms")


# --- limits ----------------------------------------------------------------------------------------------------------


def _within(
    e: Evidence, name: str, share: Column, unit: str, values: Column, limits: Column, start: int = 0
) -> Finding:
    """`share` of its limit that each joint uses in each cycle, (cycles, joints). More than 1 breaks it; NaN does."""
    if not len(share):
        return skip(name, "no cycles")
    used = np.where(np.isnan(share), np.inf, share)
    cycle, joint = np.unravel_index(int(used.argmax()), used.shape)
    holds = bool(used[cycle, joint] <= 1.0 + ROUNDING)
    worst, limit = abs(float(values[cycle, joint])), float(limits[joint])
    where = f"{e.log.params.robot.joints[joint]} at {e.at(int(cycle) + start)}"
    margin = 1.0 - float(used[cycle, joint])
    shown = max(margin, 0.0) if holds else margin
    detail = f"greatest {worst:.4g} of {limit:.4g} {unit}, {where}; margin {shown:.1%}"
    return Finding(name, holds, detail, False, worst, limit, unit, where)


def position(e: Evidence) -> Finding:
    """The measured joints stay inside their range."""
    robot = e.log.params.robot
    low, high = np.array(robot.q_min), np.array(robot.q_max)
    heard, half = e.c["inputs.joint.present"] == 1, (high - low) / 2
    off = np.where(heard[:, None], e.c["inputs.joint.q"] - (low + high) / 2, 0.0)
    return _within(e, "joint position", np.abs(off) / half, "rad from the middle", off, half)


def speed(e: Evidence) -> Finding:
    limits = np.array(e.log.params.robot.dq_max)
    dq = e.c["state.dq_cmd"]
    return _within(e, "joint speed", np.abs(dq) / limits, "rad/s", dq, limits)


def acceleration(e: Evidence) -> Finding:
    limits = np.array(e.log.params.robot.ddq_max)
    ddq = e.c["state.ddq_cmd"]
    return _within(e, "joint acceleration", np.abs(ddq) / limits, "rad/s2", ddq, limits)


def jerk(e: Evidence) -> Finding:
    """Change of the commanded acceleration from one cycle to the next."""
    if e.log.params.control == "torque":
        return skip("joint jerk", "a torque-controlled arm has no jerk limit")
    limits = np.array(e.log.params.robot.dddq_max)
    jerks = np.diff(e.c["state.ddq_cmd"], axis=0) / e.log.params.period
    jerks[np.diff(e.c["inputs.tick"]) != 1] = 0.0  # across a gap nothing can be said
    return _within(e, "joint jerk", np.abs(jerks) / limits, "rad/s3", jerks, limits, start=1)


def torque(e: Evidence) -> Finding:
    sent = e.c["outputs.command.kind"] == CommandKind.TORQUE
    if not sent.any() or not e.log.params.robot.effort:
        return skip("joint torque", "no torques were sent")
    limits = np.array(e.log.params.robot.effort)
    tau = np.where(sent[:, None], e.c["outputs.command.tau"], 0.0)
    return _within(e, "joint torque", np.abs(tau) / limits, "Nm", tau, limits)


# --- people ----------------------------------------------------------------------------------------------------------


def separation(e: Evidence) -> Finding:
    """The measured arm does not by its own motion come nearer to a person than d_min. (A person who walks up to it
    comes nearer, too; that the arm gives way is for the safety rows.)"""
    d, limit = e.c["outputs.decision.d_measured"], e.log.params.safety.d_min
    if not np.isfinite(d).any():
        return skip("separation", "nobody was near")
    moves = (np.abs(e.c["inputs.joint.dq"]).max(axis=1) > STANDING) & (e.c["inputs.joint.present"] == 1)
    near = np.flatnonzero(moves & (d < limit))
    bad = near[approach(e, near) > APPROACH_M_S]
    worst = int(d.argmin())
    detail = (
        f"nearest {d[worst]:.4f} m, bounds and all; nearer than d_min {limit:g} m in {int((d < limit).sum())} cycles"
    )
    if len(bad):
        detail += f", in {len(bad)} of them by the arm's own motion, first at {e.at(int(bad[0]))}"
    return Finding("separation", not len(bad), detail, False, float(d[worst]), limit, "m", e.at(worst))


def approach(e: Evidence, cycles: Column) -> Column:
    """How fast the arm itself, if people stood still, would come nearer to them in these cycles, m/s."""
    every, h = System(e.log.params), 1e-3
    found = np.zeros(len(cycles))
    for k, i in enumerate(cycles):
        before, x, _ = e.log.layout.unpack(e.log.record(int(i)))
        system = every.holding(changer.told(e.log.params, before, x))
        if x.joint is not None:
            ahead = dataclasses.replace(x, joint=dataclasses.replace(x.joint, q=vector(x.joint.q + h * x.joint.dq)))
            found[k] = (nearest_measured(system, x) - nearest_measured(system, ahead)) / h
    return found


def safety_rows(e: Evidence) -> Finding:
    """What was sent keeps every row of the safety index; where the ramp was shared, the record cannot show it."""
    solved = np.isin(e.c["outputs.decision.status"], (Status.PASS, Status.FILTERED)) & (e.mode_after == Mode.ACTIVE)
    whole = solved & (e.c["outputs.decision.share"] >= 1.0)
    slack = np.where(whole, e.c["least_slack"], np.inf)
    bad = slack < -MARGIN
    phi = np.where(solved, e.c["worst_phi"], -np.inf)
    if not np.isfinite(phi).any():
        return skip("safety rows", "no pair was active")
    worst = int(phi.argmax())
    shared = int((solved & ~whole).sum())
    detail = f"worst phi {phi[worst]:.4g} at {e.at(worst)}; in {shared} cycles the ramp was shared"
    if bad.any():
        detail += f"; {int(bad.sum())} cycles break a row, first at {e.at(int(bad.argmax()))}"
    return Finding("safety rows", not bad.any(), detail, False, float(phi[worst]), 0.0, "", e.at(worst))


# --- stops and motion ------------------------------------------------------------------------------------------------


def stop_times(e: Evidence) -> Finding:
    """Every stop has a cause, and the set-points come to rest within what the limits allow."""
    found = stops(e.c)
    ticks, q = e.c["inputs.tick"], e.c["state.q_cmd"]
    bad = []
    for stop in found:
        i = int(np.searchsorted(ticks, stop["cycle"]))
        end = min(int(np.searchsorted(e.t_s, stop["t_s"] + stop["braking_s"])) + 1, e.cycles - 1)
        allowed = braking_time(e, i) + STOP_SLACK_S
        stop["travel_rad"] = round(float(np.abs(q[end] - q[i]).max()), 6)
        stop["allowed_s"] = round(allowed, 6)
        cut = StopReason[stop["final_reason"]] >= StopReason.ROBOT_NOT_READY  # the robot stops by its own rule
        if stop["reason"] == "NONE" or (stop["braking_s"] > allowed and not cut):
            bad.append(stop)
    e.notes["stops"] = found
    if bad:
        first = bad[0]
        detail = f"{len(bad)} of {len(found)}: {first['reason']} at {first['t_s']} s braked {first['braking_s']} s"
        return Finding("stops", False, f"{detail}, allowed {first['allowed_s']} s")
    longest = max((s["braking_s"] for s in found), default=0.0)
    causes = ", ".join(f"{s['reason']} at {s['t_s']:.3f} s" for s in found[:8])
    detail = f"{len(found)} stops; longest {longest:.3f} s: {causes}" if found else "no stops"
    return Finding("stops", True, detail, False, longest, None, "s")


def braking_time(e: Evidence, i: int) -> float:
    """How long the slowest joint needs to rest from the set-point of cycle i, s: the acceleration to zero first, which
    adds a^2 / 2J to the speed, then an S-curve with or without a plateau."""
    robot, a = e.log.params.robot, np.abs(e.c["state.ddq_cmd"][i])
    A, J = np.array(robot.ddq_max), np.array(robot.dddq_max)
    v = np.abs(e.c["state.dq_cmd"][i]) + a * a / (2 * J)
    curve = np.where(v * J < A * A, 2 * np.sqrt(v / J), v / A + A / J)
    return float((a / J + curve).max())


def no_motion(e: Evidence) -> Finding:
    """Outside ACTIVE and STOPPING the set-point stands still."""
    still = np.abs(np.diff(e.c["state.q_cmd"], axis=0)).max(axis=1, initial=0.0)
    seeded = e.mode[:-1] == Mode.IDLE  # the first set-point is the measured pose
    bad = (still > REST_STEP) & ~e.moving[:-1] & ~seeded
    detail = f"{int((~e.moving).sum())} cycles at rest"
    if bad.any():
        detail = f"{int(bad.sum())} cycles moved, first at {e.at(int(bad.argmax()))}"
    return Finding("no motion at rest", not bad.any(), detail)


def armed(e: Evidence) -> Finding:
    """Every way into ACTIVE is a person's ARM in that cycle."""
    began = (e.mode_after == Mode.ACTIVE) & (e.mode != Mode.ACTIVE)
    room = np.arange(e.c["inputs.events.kind"].shape[1]) < e.c["inputs.events.count"][:, None]
    asked = ((e.c["inputs.events.kind"] == EventKind.ARM) & room).any(axis=1)
    bad = began & ~asked
    detail = f"armed {int(began.sum())} times, each time by the operator"
    if bad.any():
        detail = f"active without ARM at {e.at(int(bad.argmax()))}"
    return Finding("armed by a person", not bad.any(), detail)


# --- wire, certificate, replay ---------------------------------------------------------------------------------------


def wire_bytes(e: Evidence) -> Finding:
    """Every sent packet, decoded independently of the driver, says the recorded command."""
    name = "sent bytes"
    decode = audit_wire.DECODERS.get(driver_of(e.log))
    if decode is None:
        return skip(name, "there is no independent decoder for this driver")
    _, sent = e.packets
    if not sent:
        return skip(name, "no packets were recorded")
    claims = np.flatnonzero((e.c["receipt.present"] == 1) & (e.c["receipt.ok"] == 1))
    if not len(claims):
        return skip(name, "nothing was sent")
    nothing = audit_wire.SetPoint(-1, False, (math.inf,) * e.log.params.n)
    told = [decode(sent.get(t_ns, b"")) or nothing for t_ns in e.c["receipt.t_tx_ns"][claims].tolist()]
    off = np.abs(np.array([point.q for point in told]) - e.c["outputs.command.q"][claims]).max(axis=1)
    off[np.array([point.seq for point in told]) != e.c["receipt.seq"][claims]] = math.inf
    if (bad := ~(off <= audit_wire.ROUNDING)).any():
        at = e.at(int(claims[bad.argmax()]))
        return Finding(name, False, f"{at}: the packet says something else", moment=at)
    worst = int(off.argmax())
    detail = f"{len(claims)} set-points decode to the recorded commands, {off[worst]:.1e} rad off at most"
    return Finding(name, True, detail, False, float(off[worst]), audit_wire.ROUNDING, "rad", e.at(int(claims[worst])))


def certificate(e: Evidence) -> Finding:
    """A certificate was there and covered what was decided with, for every tool that the arm moved with."""
    used = np.unique(e.c["state.tool"][e.moving])
    findings = [_certified(e, int(mount)) for mount in (used if len(used) else [0])]
    wrong = [found for found in findings if not found.holds]
    return (wrong or findings)[0] if len(findings) == 1 or wrong else _all_of(findings)


def _all_of(findings: list[Finding]) -> Finding:
    return dataclasses.replace(findings[0], detail="; ".join(found.detail for found in findings))


def _certified(e: Evidence, mount: int) -> Finding:
    """Of one tool: arm, its limits of the day, tool, index, ranges."""
    name, p = "certificate", e.log.params.holding(mount)
    simulated = e.log.session.get("simulated") == "true"
    file = f"{schema.CERTIFICATE}-{p.tool.name}" if mount else schema.CERTIFICATE
    if file not in e.log.attachments:
        missing = f"none for tool {p.tool.name} on {p.robot.name}"
        return skip(name, f"{missing}, in simulation") if simulated else Finding(name, False, missing)
    try:
        found = parse(e.log.attachments[file], file)
    except CertificateError as error:
        return Finding(name, False, str(error))
    if reasons := covers(found, p):
        told = f"it did not cover the session: {'; '.join(reasons)}"
        return skip(name, f"{told}; in simulation") if simulated else Finding(name, False, told)
    b = found.boundary
    share = f"{b.feasible} of {b.states} states on phi = 0 feasible"
    return Finding(name, True, f"covers tool {p.tool.name} on {p.robot.name}, k {found.k:g}, {share}")


def replayed(e: Evidence) -> Finding:
    """The same code decides the same again."""
    r = e.replay
    if r is None or not r.cycles:
        return skip("replay", "no cycle was run again")
    how = "bytes" if r.fingerprint_match else f"not exact: another machine, tolerance {r.tolerance:g}"
    detail = f"{r.cycles} of {e.cycles} cycles run again ({how}), {r.mismatches} differ"
    if r.first_difference is not None:
        first = r.first_difference
        detail += f"; first: cycle {first.cycle}, {first.field}: {first.logged} -> {first.replayed}"
    return Finding("replay", r.mismatches == 0, detail)


def wire(e: Evidence) -> Finding:
    """Raw packets through the driver's codec give the record, and the record gives the packets."""
    r = e.replay
    if r is None:
        return skip("wire", "no cycle was run again")
    how = f"of {r.cycles} cycles decoded again" if r.wire_decoded else "present (this driver's codec cannot be asked)"
    detail = f"packets {how}, {r.wire_mismatches} mismatches" + (f"; first: {r.wire_first}" if r.wire_first else "")
    return Finding("wire", r.wire_mismatches == 0, detail)


RULES: tuple[Rule, ...] = (
    identity, seals, signature, closed, records, completeness, timing, human_age, reaction, position, speed,
    acceleration, jerk, torque, tool, separation, safety_rows, stop_times, no_motion, armed, wire_bytes, wire,
    certificate, replayed,
)  # fmt: skip
