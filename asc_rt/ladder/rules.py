"""The judges of the ladder: the recording of a step in, findings out. Beside them every rule of the audit must hold.

A judge is pure: it looks at the columns of the record and at what the simulated plant said, and at the limits of the
step. What could not be looked at because it did not happen (no motion, nobody near) does not hold: a step that shows
nothing is not passed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from asc_rt.core.types import Mode, RobotFlag, StopReason
from asc_rt.ladder.steps import Action, People, Step
from logs.audit_evidence import Column, Evidence
from logs.audit_finding import Finding
from logs.audit_rules import braking_time
from logs.summary import Truth, stops

COLUMNS = (
    "state.goal.id", "state.reached_id", "inputs.joint.flags", "outputs.decision.monitor.present",
    "outputs.decision.monitor.robot_speed",
)  # fmt: skip
READY = RobotFlag.READY | RobotFlag.SERVO_ON
BAD = RobotFlag.EMERGENCY_STOP | RobotFlag.FAULTED
PROTECTIVE = frozenset({"INFEASIBLE", "SEPARATION", "START_INSIDE"})  # a person beside the arm may cause these
LATENCIES_S = np.arange(0.0, 0.4, 0.002)  # among which the set-points' delay is looked for


@dataclass(frozen=True, slots=True)
class Run:
    """One recorded run of a step. `c`: columns by path of the field."""

    step: Step
    e: Evidence
    c: dict[str, Column]
    truth: Truth

    @classmethod
    def of(cls, step: Step, e: Evidence) -> Run:
        return cls(step, e, e.c | e.log.columns(*COLUMNS), Truth(e.log, e.c["inputs.t_ns"]))

    @property
    def active(self) -> Column:
        """Cycles that worked towards a goal, or held one."""
        found: Column = self.e.mode_after == Mode.ACTIVE
        return found

    @property
    def heard(self) -> Column:
        found: Column = self.c["inputs.joint.present"] == 1
        return found

    @property
    def q(self) -> Column:
        """Measured, of cycles with a sample, rad."""
        found: Column = self.c["inputs.joint.q"][self.heard]
        return found

    @property
    def torque(self) -> bool:
        return self.e.log.params.control == "torque"

    @property
    def latency(self) -> float:
        """What the profile says, s."""
        return self.e.log.params.robot.command_latency_ns * 1e-9

    def limit(self, key: str) -> float:
        return self.step.limits[key]


Rule = Callable[[Run], Finding]
RULES: dict[str, tuple[Rule, tuple[str, ...]]] = {}  # name -> the rule, and the limits that it needs


def rule(name: str, *limits: str) -> Callable[[Callable[[Run], Finding]], Rule]:
    def note(judge: Rule) -> Rule:
        RULES[name] = judge, limits
        return judge

    return note


def judge(run: Run) -> list[Finding]:
    """Every rule of the step."""
    return [RULES[name][0](run) for name in run.step.rules]


def _no(name: str, why: str) -> Finding:
    return Finding(name, False, why)


# --- nothing moves ---------------------------------------------------------------------------------------------------


@rule("heard", "lost_share")
def heard(run: Run) -> Finding:
    """The robot is heard in every period, ready, and without a fault of its own."""
    name, flags = "heard", run.c["inputs.joint.flags"][run.heard]
    if not len(flags):
        return _no(name, "the robot was never heard")
    lost = int((~run.heard).sum() + np.maximum(run.c["inputs.missed_ticks"], 0)[run.heard].sum())
    share, limit = lost / len(run.heard), run.limit("lost_share")
    bad, unready = int(((flags & BAD) != 0).sum()), int(((flags & READY) != READY).sum())
    detail = f"{lost} of {len(run.heard)} samples lost, {bad} of a faulted robot, {unready} of one that is not ready"
    return Finding(name, share <= limit and not bad and not unready, detail, False, share, limit)


@rule("unarmed")
def unarmed(run: Run) -> Finding:
    """Nobody armed the cell."""
    armed = int(run.e.moving.sum())
    return Finding("unarmed", armed == 0, f"{armed} of {run.e.cycles} cycles armed")


@rule("still", "still_deg")
def still(run: Run) -> Finding:
    """The arm itself, not only its set-point, stays where it is."""
    name, limit = "still", run.limit("still_deg")
    if not len(run.q):
        return _no(name, "the robot was never heard")
    travel = np.degrees(np.ptp(run.q, axis=0))
    worst, joint = float(travel.max()), run.e.log.params.robot.joints[int(travel.argmax())]
    return Finding(name, worst <= limit, f"largest travel {worst:.4f} deg, {joint}", False, worst, limit, "deg")


@rule("plausible pose", "margin_deg", "truth_deg")
def plausible(run: Run) -> Finding:
    """Every joint is inside its range, off its ends, and where the plant, if it tells, says that it is."""
    name, robot = "plausible pose", run.e.log.params.robot
    if not len(run.q):
        return _no(name, "the robot was never heard")
    room = np.degrees(np.minimum(run.q - np.array(robot.q_min), np.array(robot.q_max) - run.q))
    least, joint = float(room.min()), robot.joints[int(room.min(axis=0).argmin())]
    told = [q for q in run.truth.q if len(q) == run.q.shape[1]]
    off = float(np.degrees(np.abs(told[len(told) // 2] - run.q[len(run.q) // 2]).max())) if told else 0.0
    pose = ", ".join(f"{name} {angle:.2f}" for name, angle in zip(robot.joints, np.degrees(run.q[-1]), strict=True))
    detail = f"{pose} deg; {least:.1f} deg from the end of its range: {joint}"
    detail += f"; {off:.3f} deg off what the plant says" if told else "; no plant to compare with"
    holds = least >= run.limit("margin_deg") and off <= run.limit("truth_deg")
    return Finding(name, holds, detail, False, least, run.limit("margin_deg"), "deg")


@rule("armed and held", "active_s")
def held(run: Run) -> Finding:
    """Armed for as long as asked, and the set-point at rest all the while."""
    name, limit = "armed and held", run.limit("active_s")
    seconds = float(run.active.sum()) * run.e.log.params.period
    moved = float(np.degrees(np.ptp(run.c["state.q_cmd"][run.active], axis=0).max())) if run.active.any() else 0.0
    slack = run.limit("still_deg") if run.torque else 1e-6  # torque: the state is the measured one
    detail = f"armed for {seconds:.2f} s, the set-point moved {moved:.6f} deg"
    return Finding(name, seconds >= limit and moved <= slack, detail, False, seconds, limit, "s")


# --- motion ----------------------------------------------------------------------------------------------------------


@rule("goals", "goals")
def goals(run: Run) -> Finding:
    """So many goals were reached."""
    reached, wanted = int(run.c["state.reached_id"].max(initial=0)), run.limit("goals")
    return Finding("goals", reached >= wanted, f"{reached} of {wanted:g} goals reached", False, reached, wanted)


@rule("speed", "speed_share", "speed_m_s")
def slow(run: Run) -> Finding:
    """The arm moves, and no joint, and no point of the arm, faster than this step allows."""
    name, limits = "speed", np.array(run.e.log.params.robot.dq_max)
    share = float((np.abs(run.c["state.dq_cmd"]) / limits).max(initial=0.0))
    watched = run.c["outputs.decision.monitor.present"] == 1
    fastest = float(run.c["outputs.decision.monitor.robot_speed"][watched].max(initial=0.0))
    detail = f"largest {share:.3f} of the joints' limits, {fastest:.3f} m/s of any point of the arm"
    if share == 0.0 or not watched.any():
        return _no(name, f"{detail}: it did not move, or nothing watched it")
    holds = share <= run.limit("speed_share") and fastest <= run.limit("speed_m_s")
    return Finding(name, holds, detail, False, fastest, run.limit("speed_m_s"), "m/s")


@rule("one joint at a time", "still_deg", "swing_deg")
def one_joint(run: Run) -> Finding:
    """Goal by goal, the joint that is meant moves as far as asked, and no other does."""
    name, n = "one joint at a time", run.e.log.params.n
    travel = []
    for goal in range(1, 2 * n + 1):
        cycles = run.active & run.heard & (run.c["state.goal.id"] == goal) & (run.c["state.reached_id"] < goal)
        if not cycles.any():
            return _no(name, f"goal {goal} of {2 * n} was never worked on")
        travel.append(np.degrees(np.ptp(run.c["inputs.joint.q"][cycles], axis=0)))
    meant = np.array([row[goal // 2] for goal, row in enumerate(travel)])
    others = np.array([np.delete(row, goal // 2).max() for goal, row in enumerate(travel)])
    least, most = float(meant.min()), float(others.max())
    detail = f"the joint meant moves {least:.2f} deg at least, others {most:.3f} deg at most"
    holds = least >= run.limit("swing_deg") and most <= run.limit("still_deg")
    return Finding(name, holds, detail, False, most, run.limit("still_deg"), "deg")


@dataclass(frozen=True, slots=True)
class Following:
    """How the arm follows its set-points: it is where they were `latency` ago, but for `worst` and `rms`."""

    latency: float  # s
    worst: float  # rad
    rms: float  # rad


def following(run: Run) -> Following | None:
    """By the delay that explains the measured joints best. None: it did not move, or takes torques (then the state that
    is decided with is the measured one)."""
    moving = run.e.moving & run.heard
    if run.torque or not moving.any() or not np.abs(run.c["state.dq_cmd"]).any():
        return None
    t = run.c["inputs.t_ns"] * 1e-9
    seen, q, asked = t[moving], run.c["inputs.joint.q"][moving], run.c["state.q_cmd"]
    best: Following | None = None
    for latency in LATENCIES_S:
        off = np.column_stack([np.interp(seen - latency, t, column) for column in asked.T]) - q
        rms = float(np.sqrt(np.mean(off**2)))
        if best is None or rms < best.rms:
            best = Following(float(latency), float(np.abs(off).max()), rms)
    return best


@rule("follows", "tracking_deg", "latency_share")
def follows(run: Run) -> Finding:
    """The arm is where the set-points say, not later than the profile's latency explains."""
    name, found = "follows", following(run)
    if found is None and run.torque and run.e.moving.any():
        return Finding(name, True, "torque control: there is no set-point to follow", skipped=True)
    if found is None:
        return _no(name, "the arm never moved")
    worst, limit = math.degrees(found.worst), run.limit("tracking_deg")
    most = run.latency * run.limit("latency_share")
    detail = (
        f"{worst:.3f} deg off at most, {found.latency * 1e3:.0f} ms after the set-points (at most {most * 1e3:.0f})"
    )
    return Finding(name, worst <= limit and found.latency <= most, detail, False, worst, limit, "deg")


# --- stops -----------------------------------------------------------------------------------------------------------

WANTED = {
    Action.STOP: frozenset({"OPERATOR_STOP"}),
    Action.BLIND: frozenset(reason.name for reason in StopReason if reason.is_of_people and not reason.is_fault),
}


@rule("stops as asked", "stops")
def stopped(run: Run) -> Finding:
    """The stops that the step is about, and no other."""
    found = [stop["final_reason"] for stop in stops(run.c)]
    wanted = WANTED.get(run.step.task.action, frozenset())
    allowed = wanted | (frozenset() if run.step.people is People.NOBODY else PROTECTIVE)
    asked, strange = sum(reason in wanted for reason in found), sorted({r for r in found if r not in allowed})
    detail = f"{len(found)} stops, {asked} as asked ({run.limit('stops'):g} wanted)"
    detail += f"; not asked for: {', '.join(strange)}" if strange else ""
    return Finding("stops as asked", asked >= run.limit("stops") and not strange, detail, False, asked)


@dataclass(frozen=True, slots=True)
class Stop:
    """One stop of the measured arm beside what its limits explain; the joint that uses most of what it may."""

    cycle: int
    speed_share: float  # of the joints' limits when it began
    seconds: float
    seconds_allowed: float
    travel: float  # rad, of the joint
    travel_allowed: float


def measured_stops(run: Run) -> list[Stop]:
    """From the decision to stop until the arm stays within `still_deg` of where it comes to rest.

    Model: time of the set-points' stop (jerk-limited, audit_rules.braking_time) and one command latency; way of each
    joint: speed x latency, and v' (a / J + T(v') / 2) with v' = |v| + a^2 / 2J, the S-curve from v' to rest.
    """
    ticks, q = run.c["inputs.tick"], run.c["inputs.joint.q"]
    found = []
    for stop in stops(run.c):
        i = int(np.searchsorted(ticks, stop["cycle"]))
        again = np.flatnonzero(run.e.moving[i:] & (run.e.mode[i:] == Mode.STOPPED))  # armed again
        end = i + int(again[0]) if len(again) else run.e.cycles
        there = np.flatnonzero(run.heard[i:end]) + i
        if len(there):
            found.append(_stop(run, i, there, q[there]))
    return found


def _stop(run: Run, i: int, there: Column, q: Column) -> Stop:
    robot, still = run.e.log.params.robot, math.radians(run.limit("still_deg"))
    A, J = np.array(robot.ddq_max), np.array(robot.dddq_max)
    v, a = np.abs(run.c["state.dq_cmd"][i]), np.abs(run.c["state.ddq_cmd"][i])
    v1 = v + a * a / (2 * J)
    curve = np.where(v1 * J < A * A, 2 * np.sqrt(v1 / J), v1 / A + A / J)
    latency = run.latency * run.limit("latency_share")
    allowed = v1 * (a / J + curve / 2) + v * latency + math.radians(run.limit("travel_deg"))
    travel = np.abs(q[-1] - q[0])
    worst = int((travel / allowed).argmax())
    away = np.flatnonzero(np.abs(q - q[-1]).max(axis=1) > still)
    rest = there[min(int(away[-1]) + 1, len(there) - 1)] if len(away) else there[0]
    return Stop(
        cycle=i,
        speed_share=float((v / np.array(robot.dq_max)).max()),
        seconds=float(run.e.t_s[rest] - run.e.t_s[i]),
        seconds_allowed=braking_time(run.e, i) + latency + run.limit("rest_s"),
        travel=float(travel[worst]),
        travel_allowed=float(allowed[worst]),
    )


@rule("stopping distance", "still_deg", "travel_deg", "rest_s", "latency_share", "least_speed_share", "stops")
def stopping_distance(run: Run) -> Finding:
    """Every stop is from speed; the measured arm rests in the time and on the way that the model says."""
    name, found, least = "stopping distance", measured_stops(run), run.limit("least_speed_share")
    fast = [stop for stop in found if stop.speed_share >= least]
    if len(fast) < run.limit("stops"):
        return _no(
            name, f"{len(fast)} of {len(found)} stops from {least:g} of the speed limits; {run.limit('stops'):g}"
        )
    worst = max(found, key=lambda stop: max(stop.travel / stop.travel_allowed, stop.seconds / stop.seconds_allowed))
    detail = (
        f"{len(found)} stops; at worst {worst.seconds:.3f} of {worst.seconds_allowed:.3f} s, "
        f"{worst.travel:.4f} of {worst.travel_allowed:.4f} rad, from {worst.speed_share:.2f} of the speed limits"
    )
    holds = all(s.seconds <= s.seconds_allowed and s.travel <= s.travel_allowed for s in found)
    return Finding(name, holds, detail, False, worst.travel, worst.travel_allowed, "rad", run.e.at(worst.cycle))


@rule("stays stopped")
def stays(run: Run) -> Finding:
    """After the sensor is gone the arm stops and stays stopped."""
    name, found = "stays stopped", stops(run.c)
    if not found:
        return _no(name, "nothing stopped it")
    first = int(np.searchsorted(run.c["inputs.tick"], found[0]["cycle"]))
    again = int(run.active[first + 1 :].sum())
    return Finding(name, again == 0, f"{found[0]['reason']}; armed again for {again} cycles")


# --- people and tools ------------------------------------------------------------------------------------------------


@rule("separation kept", "near_m")
def kept(run: Run) -> Finding:
    """Somebody was near enough to matter, and the arm never came closer than d_min by its own motion. (That the arm as
    measured does not is a rule of the audit; here is what the plant says, if it tells.)"""
    name, d = "separation kept", run.c["outputs.decision.d_measured"][run.active]
    nearest, d_min = float(d.min(initial=math.inf)), run.e.log.params.safety.d_min
    caused = run.truth.violations(d_min) if len(run.truth.distance) else 0
    truth = f", {caused} times too near by the arm's doing" if len(run.truth.distance) else ""
    detail = f"nearest while armed {nearest:.3f} m, with the bounds of what is known{truth}"
    if not nearest <= run.limit("near_m"):
        return _no(name, f"{detail}: nobody was within {run.limit('near_m'):g} m of the arm, so nothing is shown")
    return Finding(name, caused == 0, detail, False, nearest, d_min, "m")


@rule("tool", "tools")
def tool(run: Run) -> Finding:
    """What is decided with is the tool that the changer tells; none is changed under way; so many were mounted."""
    name, changer = "tool", run.e.log.params.changer
    told, mount = run.c["inputs.joint.tool_id"], run.c["state.tool"]
    if not changer.mounts:
        other = int((told[run.heard] != 0).sum())
        return Finding(name, other == 0, f"one tool, no changer; {other} samples tell of another tool")
    changed = np.diff(mount) != 0
    moved = int((changed & run.e.moving[1:]).sum())
    used = {changer.mounts[int(i)].tool.name for i in np.unique(mount[run.active])}
    numbers = np.array([m.number for m in changer.mounts])[mount]
    # what is told is decided with in the same cycle: the next record's state has it
    wrong = int((changer.told_by_robot & (numbers[1:] != told[:-1]) & run.active[:-1] & run.heard[:-1]).sum())
    detail = f"moved with {', '.join(sorted(used)) or 'none'}; {wrong} cycles with another than told, {moved} changed"
    holds = not wrong and not moved and len(used) >= run.limit("tools")
    return Finding(name, holds, detail, False, len(used), run.limit("tools"))
