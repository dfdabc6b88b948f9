"""A certificate: which index was synthesised for which arm and tool, on which ranges, from which samples, and whether
it holds. JSON on disk; everything that it depends on is in it by value or by hash."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import types
import typing
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from asc_rt.core.params import Params, RobotParams, ToolParams
from asc_rt.synthesis.sampling import Ranges

FORMAT = 2
# Of the method: raise it when M, its rate, the index or the sampling changes, so that older certificates become stale.
# tests/synthesis/test_shipped.py computes the shipped ones' worst states again and tells when.
METHOD = 1


ROUNDING = 1e-6  # share of a limit: what float32 on the wire and degrees may take


class CertificateError(Exception):
    """A certificate file that is none: says which and why."""


class Index(StrEnum):
    PHI_STAR = "phi-star"
    PHI_B = "phi-b"


@dataclass(frozen=True, slots=True)
class Part:
    """A robot, its joint limits left out, or a tool."""

    name: str
    sha256: str


@dataclass(frozen=True, slots=True)
class Limits:
    """Joint limits that M was computed with, as of the profile or the smaller ones that the robot told."""

    dq_max: tuple[float, ...]  # rad/s
    ddq_max: tuple[float, ...]  # rad/s2
    dddq_max: tuple[float, ...]  # rad/s3
    effort: tuple[float, ...]  # Nm; (): takes positions


@dataclass(frozen=True, slots=True)
class Worst:
    """A state worth looking at, and why."""

    why: str
    value: float
    capsule: str
    q: tuple[float, ...]  # rad
    dq: tuple[float, ...]  # rad/s
    point: tuple[float, float, float]  # m, the person
    velocity: tuple[float, float, float]  # m/s
    M: float  # m/s2 in this state, against a person with the acceleration of the ranges


@dataclass(frozen=True, slots=True)
class Sampled:
    """Figures of the samples."""

    samples: int
    M_min: float  # m/s2, one-sided radius
    M_max: float
    ball_min: float  # m/s2, zero-centred radius, the paper's
    ball_max: float
    M_dot_star: float  # m/s3, greatest rate of the zero-centred radius either way, the paper's
    falling_max: float  # m/s3, fastest fall of the one-sided radius
    rho: float | None  # 1/s, greatest -M_dot / M of the covered states; None: no state is covered
    approaching: int  # states in which the robot's own nearest point approaches
    covered: int  # of them: M above its floor and v within its range; what the index is synthesised for
    under_floor: int
    too_fast: int
    M_nonpositive: int
    ball_nonpositive: int


@dataclass(frozen=True, slots=True)
class Boundary:
    """States pulled onto phi = 0, with the real limits."""

    states: int
    feasible: int
    under_floor: int  # on phi = 0 with M under its floor: handed to the fallback, not counted in `states`
    least_share: float  # of the feasible ones, wrong by at most DOUBT
    margin_min: float | None


@dataclass(frozen=True, slots=True)
class Certificate:
    robot: Part
    tool: Part
    limits: Limits
    control: str  # "acceleration" or "torque"
    index: Index
    d_min: float  # m
    M_floor: float  # m/s2
    eta: float  # 1/s
    period: float  # s
    ranges: Ranges
    seed: int
    sampled: Sampled
    boundary: Boundary
    k: float | None  # what is certified: k of phi*, or the deceleration a of phi_b, m/s2; None: nothing was found
    k_paper: float | None  # by the paper's formula, from ball_min and M_dot_star
    k_bound: float | None  # by the tight bound, continuous time
    k_layer: float | None  # with the layer of one period: what is needed for the worst case
    proven: bool  # no infeasible cell of (d, v, M) at k, the layer included
    proof_cells: int
    coverage: float  # share of states for which all sampled extremes hold, by the union bound
    confidence: float
    coverage_paper: float  # the same by the paper's claim
    confidence_paper: float
    required: float  # least share of feasible states on phi = 0 that was asked for
    certified: bool
    reasons: tuple[str, ...]  # why not
    notes: tuple[str, ...]
    worst: tuple[Worst, ...]
    code: str  # version of the program
    format: int = FORMAT
    method: int = METHOD


def hash_of(part: RobotParams | ToolParams) -> str:
    """SHA-256 of a robot's or a tool's parameters, the URDF text included. Joint limits are compared by value."""
    limits = {field.name for field in dataclasses.fields(Limits)}
    values = {key: value for key, value in dataclasses.asdict(part).items() if key not in limits}
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def limits_of(robot: RobotParams) -> Limits:
    return Limits(robot.dq_max, robot.ddq_max, robot.dddq_max, robot.effort)


def with_limits(robot: RobotParams, limits: Limits) -> RobotParams:
    """`robot` as it was certified."""
    return dataclasses.replace(robot, **dataclasses.asdict(limits))


def part_of(part: RobotParams | ToolParams) -> Part:
    return Part(part.name, hash_of(part))


def covers(certificate: Certificate, params: Params) -> list[str]:
    """Why `certificate` does not cover a cell with `params`; empty: it does."""
    c, p, s, r = certificate, params, params.safety, certificate.ranges
    if (c.format, c.method) != (FORMAT, METHOD):
        return [f"it is stale: made by method {c.method}, format {c.format}; now {METHOD}, {FORMAT}"]
    out = [] if c.certified else [f"it does not certify: {'; '.join(c.reasons)}"]
    for kind, mine, mounted in (("robot", c.robot, p.robot), ("tool", c.tool, p.tool)):
        if mine.name != mounted.name:
            out.append(f"it is for {kind} {mine.name}, not for {mounted.name}")
        elif mine.sha256 != hash_of(mounted):
            out.append(f"it is stale: the data of {kind} {mine.name} have changed since")
    out += _weaker(c.limits, p.robot)
    for wrong, text in (
        (c.control != p.control, f"it is for {c.control} control, the cell has {p.control} control"),
        (c.index != s.index, f"it is for index {c.index}, the cell uses {s.index}"),
        (
            c.k is not None and c.index is Index.PHI_STAR and s.k < c.k,
            f"safety.k = {s.k:g} is under the certified {c.k or 0.0:g}",
        ),
        (
            c.k is not None and c.index is Index.PHI_B and s.brake > c.k,
            f"safety.brake_m_s2 = {s.brake:g} is above the certified {c.k or 0.0:g}",
        ),
        (not _same(s.d_min, c.d_min), f"safety.d_min_m = {s.d_min:g}, certified for {c.d_min:g}"),
        (
            s.activation_distance > r.d_high,
            f"safety.activation_m = {s.activation_distance:g} is beyond the certified range, d up to {r.d_high:g} m",
        ),
        (s.v_max > r.v_max, f"safety.v_max_m_s = {s.v_max:g} is above the certified {r.v_max:g}"),
        (s.M_floor < c.M_floor, f"safety.M_floor = {s.M_floor:g} is under the certified {c.M_floor:g}"),
        (s.eta > c.eta, f"safety.eta = {s.eta:g} is above the certified {c.eta:g}"),
        (
            s.human_acceleration > r.human_acceleration,
            f"safety.human_acceleration_m_s2 = {s.human_acceleration:g} is above the certified "
            f"{r.human_acceleration:g}",
        ),
        (p.task.speed > r.speed_share, f"task.speed = {p.task.speed:g} is above the certified {r.speed_share:g}"),
        (p.period > c.period, f"a period of {p.period * 1e3:g} ms is above the certified {c.period * 1e3:g} ms"),
        (not r.joint_limits, "it leaves the joint limits out (the paper's U); no arm has none"),
    ):
        if wrong:
            out.append(text)
    return out


def _weaker(certified: Limits, robot: RobotParams) -> list[str]:
    """Where the arm can do less than M was computed with. More acceleration, jerk or torque only enlarges U, and with
    it M; more speed leads to states that were not sampled."""
    out = []
    for key, unit, more_is_safe in (
        ("dq_max", "rad/s", False), ("ddq_max", "rad/s2", True), ("dddq_max", "rad/s3", True), ("effort", "Nm", True),
    ):  # fmt: skip
        for joint, (then, now) in enumerate(zip(getattr(certified, key), getattr(robot, key), strict=False)):
            off = (then - now if more_is_safe else now - then) / then
            if off > ROUNDING:
                side = "under" if more_is_safe else "above"
                name = robot.joints[joint]
                out.append(f"{key} of {name} is {now:.4g} {unit}, {side} the certified {then:.4g}")
                break
    return out


def refusals(params: Params, folder: Path) -> list[str]:
    """Why no certificate in `folder` covers `params`, with what to do; empty: one does."""
    file = folder / file_name(params.robot.name, params.tool.name)
    do = f"asc certify --cell CELL --tool {params.tool.name} -o {file}"
    if not file.is_file():
        return [f"{file}: missing; no certificate for tool {params.tool.name} on {params.robot.name}; make one: {do}"]
    try:
        found = load(file)
    except CertificateError as error:
        return [f"{error}; make a new one: {do}"]
    return [f"{file}: {reason}" for reason in covers(found, params)]


def file_name(robot: str, tool: str) -> str:
    return f"{robot}-{tool}.json"


def _same(a: float, b: float) -> bool:
    return abs(a - b) <= 1e-9


# --- file ------------------------------------------------------------------------------------------------------------


def to_json(certificate: Certificate) -> str:
    return json.dumps(dataclasses.asdict(certificate), indent=1, allow_nan=False) + "\n"


def load(path: Path) -> Certificate:
    """CertificateError: unreadable, not JSON, or not a certificate of this format."""
    try:
        return parse(path.read_bytes(), str(path))
    except OSError as error:
        raise CertificateError(f"{path}: cannot be read: {error.strerror}") from error


def parse(data: bytes, name: str) -> Certificate:
    """The content of a file called `name`. CertificateError: not JSON, or not a certificate of this format."""
    try:
        tree = json.loads(data)
    except ValueError as error:
        raise CertificateError(f"{name}: not JSON: {error}") from error
    try:
        return typing.cast(Certificate, _build(Certificate, tree))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise CertificateError(f"{name}: not a certificate of format {FORMAT}: {error}") from error


def _build(kind: Any, value: Any) -> Any:
    if dataclasses.is_dataclass(kind):
        hints = typing.get_type_hints(kind)
        if set(value) != set(hints):
            odd = ", ".join(sorted(set(value) ^ set(hints)))
            raise KeyError(f"{getattr(kind, '__name__', kind)}: unknown or missing {odd}")
        return typing.cast(Any, kind)(**{name: _build(hint, value[name]) for name, hint in hints.items()})
    if isinstance(kind, types.UnionType):
        (present,) = (arg for arg in typing.get_args(kind) if arg is not type(None))
        return None if value is None else _build(present, value)
    if typing.get_origin(kind) is tuple:
        return tuple(_build(typing.get_args(kind)[0], item) for item in value)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if isinstance(kind, type) and issubclass(kind, StrEnum):
        return kind(value)
    if not isinstance(value, kind):
        raise TypeError(f"{value!r} where a {kind.__name__} belongs")
    return value
