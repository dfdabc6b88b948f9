"""From a request to a certificate: sample, synthesise, prove on the grid, pull states onto phi = 0, judge."""

from __future__ import annotations

import importlib.metadata
import math
import time
from dataclasses import dataclass, replace

import numpy as np

from asc_rt.core import robot_model
from asc_rt.core.abstraction import People, separation
from asc_rt.core.params import Params, RobotParams, ToolParams
from asc_rt.core.radius import radii
from asc_rt.core.robot_model import RobotModel
from asc_rt.synthesis import kernel, sampling, synthesis
from asc_rt.synthesis.certificate import Boundary, Certificate, Index, Sampled, Worst, limits_of, part_of, with_limits
from asc_rt.synthesis.draw import Draw, realise
from asc_rt.synthesis.sampling import Progress, Pull, Ranges, Survey, Workers
from asc_rt.synthesis.statistics import Extreme, Statistics

SHARE = 0.9999  # of the states, for which the sampled extremes are claimed to hold; the paper's figure
DOUBT = 1e-6  # of the share of feasible states on phi = 0
LADDER = (1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0, 30.0, 50.0, 80.0, 130.0)  # parameters tried where no worst case holds
SEARCHED = 20_000  # samples that each of them is tried on


@dataclass(frozen=True, slots=True)
class Request:
    robot: RobotParams
    tool: ToolParams
    control: str
    index: Index
    ranges: Ranges
    d_min: float  # m
    M_floor: float  # m/s2
    eta: float  # 1/s
    period: float  # s
    samples: int
    seed: int
    required: float  # least share of feasible states on phi = 0
    k: float | None = None  # to certify instead of the synthesised one (phi_b: a)


@dataclass(frozen=True, slots=True)
class Result:
    certificate: Certificate
    statistics: Statistics  # for the plots
    model: RobotModel
    seconds: float  # that sampling M and its rate took
    cpu_seconds: float  # the same in time of this process on all its cores; a cluster's is not in it


def certify(request: Request, workers: Workers = sampling.threads, progress: Progress = sampling.quietly) -> Result:
    """sampling.RangeError, robot_model.ModelError: what cannot be certified at all."""
    sampling.check(request.ranges, request.d_min, request.samples)
    model = robot_model.load(request.robot, request.tool, request.control)
    draw = sampling.draw_of(model, len(request.tool.capsules), request.ranges)
    r = request
    survey = Survey(model.arm, draw, r.seed, r.samples, r.M_floor, r.ranges.v_max)
    began, spent = time.monotonic(), time.process_time()
    found = sampling.collect(survey, workers, progress)
    seconds, spent = time.monotonic() - began, time.process_time() - spent
    if not found.counts.get("samples"):
        raise sampling.RangeError("no sample lies in the range of d; move the obstacle or widen the range")
    sampled = _sampled(found)
    figures = synthesis.Figures(
        r.d_min, r.ranges.d_low, r.ranges.d_high, r.ranges.v_max, sampled.rho or 0.0, r.period, r.eta
    )
    synthesised = _synthesise(r, sampled, found, figures)
    stopping = r.index is Index.PHI_B
    pull = Pull(model.arm, draw, r.seed, r.samples, r.k or 0.0, r.d_min, r.M_floor, r.ranges.v_max, stopping)
    k = r.k or synthesised or (_by_share(pull, r.required, workers) if sampled.covered else None)
    pulled = sampling.collect(replace(pull, k=k), workers, progress) if k is not None else Statistics()
    certificate = _judge(r, sampled, found, figures, synthesised, k, pulled, _worst(model, draw, found, pulled))
    return Result(certificate, found, model, seconds, spent)


def _sampled(found: Statistics) -> Sampled:
    n = found.counts
    return Sampled(
        samples=n["samples"],
        M_min=found.least["M"].value,
        M_max=found.greatest["M"].value,
        ball_min=found.least["ball"].value,
        ball_max=found.greatest["ball"].value,
        M_dot_star=found.greatest["steepest"].value,
        falling_max=found.greatest["falling"].value,
        rho=found.greatest["ratio"].value if "ratio" in found.greatest else None,
        approaching=n["approaching"],
        covered=n["covered"],
        under_floor=n["under_floor"],
        too_fast=n["too_fast"],
        M_nonpositive=n["M_nonpositive"],
        ball_nonpositive=n["ball_nonpositive"],
    )


def _synthesise(r: Request, sampled: Sampled, found: Statistics, figures: synthesis.Figures) -> float | None:
    """k of phi*, a of phi_b; None: there is none."""
    if sampled.rho is None:
        return None
    if r.index is Index.PHI_B:
        return synthesis.a_bound(found.least["covered_M"].value)
    return synthesis.k_layer(figures)


def _by_share(pull: Pull, required: float, workers: Workers) -> float:
    """Where no parameter holds in the worst case: the one that lets the robot approach fastest with enough feasible
    states on phi = 0 (halfway between what is required and all of them, since few are looked at); else the best."""
    best, most = 0.0, -1.0
    for k in reversed(LADDER) if pull.stopping else LADDER:
        n = sampling.collect(replace(pull, k=k, samples=min(pull.samples, SEARCHED)), workers).counts
        share = n["feasible"] / n["on"] if n["on"] else 0.0
        if share >= 0.5 * (1.0 + required):
            return k
        if share > most:
            best, most = k, share
    return best


def _judge(
    r: Request,
    sampled: Sampled,
    found: Statistics,
    figures: synthesis.Figures,
    synthesised: float | None,
    k: float | None,
    pulled: Statistics,
    worst: tuple[Worst, ...],
) -> Certificate:
    phi_star = r.index is Index.PHI_STAR
    on, feasible = pulled.counts.get("on", 0), pulled.counts.get("feasible", 0)
    share = synthesis.least_share(feasible, on, DOUBT)
    margin = pulled.least["margin"].value if "margin" in pulled.least else None
    boundary = Boundary(on, feasible, pulled.counts.get("floor", 0), share, margin)
    enough = k is not None and synthesised is not None and (k >= synthesised if phi_star else k <= synthesised)
    proof = synthesis.Proof(0, 0, None)
    if phi_star and k is not None and sampled.covered and (sampled.rho or 0.0) * r.period < 1.0:
        M_low, M_high = max(r.M_floor, found.least["covered_M"].value), found.greatest["covered_M"].value
        proof = synthesis.verify(figures, k, M_low, max(M_high, M_low * (1.0 + 1e-9)))
    reasons = _reasons(r, sampled, k, boundary)
    events = 2 if phi_star else 1  # -M_dot / M and M; M alone
    return Certificate(
        robot=part_of(r.robot),
        tool=part_of(r.tool),
        limits=limits_of(r.robot),
        control=r.control,
        index=r.index,
        d_min=r.d_min,
        M_floor=r.M_floor,
        eta=r.eta,
        period=r.period,
        ranges=r.ranges,
        seed=r.seed,
        sampled=sampled,
        boundary=boundary,
        k=k,
        k_paper=synthesis.k_paper(r.ranges.d_high, r.ranges.v_max, r.d_min, sampled.ball_min, sampled.M_dot_star)
        if phi_star
        else None,
        k_bound=synthesis.k_bound(figures) if phi_star and sampled.rho is not None else None,
        k_layer=synthesised,
        proven=enough and (proof.cells > 0 and proof.infeasible == 0 if phi_star else True),
        proof_cells=proof.cells,
        coverage=1.0 - events * (1.0 - SHARE),
        confidence=synthesis.union_bound(sampled.samples, SHARE, events),
        coverage_paper=SHARE,
        confidence_paper=synthesis.paper_confidence(sampled.samples, SHARE),
        required=r.required,
        certified=not reasons,
        reasons=reasons,
        notes=_notes(r, sampled, synthesised, k, boundary),
        worst=worst,
        code=f"asc-rt {importlib.metadata.version('asc-rt')}, numba {importlib.metadata.version('numba')}",
    )


def _reasons(r: Request, sampled: Sampled, k: float | None, b: Boundary) -> tuple[str, ...]:
    out = []
    if sampled.rho is None:
        out.append(
            f"no approaching state has M above its floor, {r.M_floor:g} m/s2, at no more than {r.ranges.v_max:g} m/s"
        )
    elif not b.states:
        out.append(
            f"no sampled state reaches phi = 0 below d = {r.ranges.d_high:g} m with {k:.4g}; more samples or another k"
        )
    elif b.least_share < r.required:
        out.append(
            f"{b.states - b.feasible} of {b.states} states on phi = 0 have no control within the real limits: at least "
            f"{b.least_share:.6f} are feasible, {r.required:g} is required"
            + ("; more samples may do" if b.feasible >= r.required * b.states else "")
        )
    return tuple(out)


def _notes(r: Request, sampled: Sampled, synthesised: float | None, k: float | None, b: Boundary) -> tuple[str, ...]:
    """What a reader must know besides the verdict."""
    n = sampled.approaching
    out = ["the person is a point; run time takes M of the real capsules and stops the robot where phi cannot be kept"]
    if sampled.under_floor:
        out.append(f"{sampled.under_floor} of {n} approaching states have M at or below its floor: fallback, no phi*")
    if sampled.too_fast:
        out.append(f"{sampled.too_fast} of {n} approaching states are faster than {r.ranges.v_max:g} m/s: out of range")
    if b.feasible < b.states:
        out.append(f"{b.states - b.feasible} of {b.states} states on phi = 0 are infeasible: there the robot brakes")
    if k is not None and synthesised is not None and r.k is not None and r.index is Index.PHI_STAR and k < synthesised:
        out.append(f"k = {k:g} is under {synthesised:.4g}, which the worst case of the ranges takes")
    if synthesised is None and sampled.rho is not None:
        out.append(
            f"no parameter is enough for the worst case of the ranges (M down to {sampled.M_min:.4g} m/s2, falling by "
            f"up to {sampled.rho:.4g} of itself per second): the share on phi = 0 is what is judged"
        )
    return tuple(out)


def _worst(model: RobotModel, draw: Draw, found: Statistics, pulled: Statistics) -> tuple[Worst, ...]:
    wanted = (
        ("least M", found.least.get("M")),
        ("greatest M", found.greatest.get("M")),
        ("least zero-centred M", found.least.get("ball")),
        ("fastest fall of M", found.greatest.get("falling")),
        ("fastest relative fall of M", found.greatest.get("ratio")),
        ("least margin on phi = 0", pulled.least.get("margin")),
    )
    return tuple(_state(model, draw, why, extreme) for why, extreme in wanted if extreme is not None)


def _state(model: RobotModel, draw: Draw, why: str, extreme: Extreme) -> Worst:
    s = realise(model.arm, draw, extreme.unit)
    out = np.empty(kernel.COLUMNS)
    kernel.evaluate(model.arm, draw.given, s.people, s.q, s.dq, s.capsule, False, out)
    x, y, z = (float(v) for v in s.people.p0[0])
    a, b, c = (float(v) for v in s.people.v0[0])
    capsule, M = model.capsule_names[s.capsule], float(out[kernel.RADIUS])
    angles, speeds = tuple(map(float, s.q)), tuple(map(float, s.dq))
    return Worst(why, extreme.value, capsule, angles, speeds, (x, y, z), (a, b, c), M)


def recheck(certificate: Certificate, robot: RobotParams, tool: ToolParams) -> list[str]:
    """The recorded worst states computed again by the functions that the cycle calls; why they differ, or empty."""
    arm = robot_model.load(with_limits(robot, certificate.limits), tool, certificate.control)
    out = []
    for w in certificate.worst if certificate.ranges.joint_limits else ():
        if w.capsule not in arm.capsule_names:
            out.append(f"it is stale: {w.why}: the arm has no capsule {w.capsule} any more")
            continue
        point, velocity = np.array([w.point]), np.array([w.velocity])
        people = People(point, point, velocity, velocity, np.zeros(1), np.zeros(1))
        a_h, q, dq = certificate.ranges.human_acceleration, np.array(w.q), np.array(w.dq)
        pairs = separation(arm.chain, arm.capsules, people, q, dq, math.inf, a_h)
        M, _ = radii(arm.arm, people, q, dq, np.zeros(len(q)), a_h, pairs)
        mine = float(M[list(pairs.robot).index(arm.capsule_names.index(w.capsule))])
        if abs(mine - w.M) > 1e-6 * (1.0 + abs(w.M)):
            out.append(f"it is stale: {w.why}: M = {w.M:.9g} m/s2 then, {mine:.9g} now")
    return out


def request_of(params: Params, ranges: Ranges, **others: object) -> Request:
    """The request that certifies a cell as it stands: its k, distances, floor and period."""
    s = params.safety
    base = Request(
        params.robot, params.tool, params.control, Index.PHI_STAR, ranges, s.d_min, s.M_floor, s.eta, params.period,
        samples=100_000, seed=0, required=0.999, k=s.k,
    )  # fmt: skip
    return replace(base, **others)  # type: ignore[arg-type]
