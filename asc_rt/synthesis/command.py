"""`asc certify`: sample M and its rate, synthesise the index, write the certificate and its plots."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

if TYPE_CHECKING:
    from asc_rt.core.params import Params, RobotParams, ToolParams
    from asc_rt.synthesis.certify import Request, Result

Show = Callable[[dict[str, Any], bool], None]
Refuse = Callable[[str], NoReturn]

DEFAULT_COVERAGE = 0.995  # where the worst case cannot be certified
DEFAULT_D_MIN = 0.05  # m, the paper's
DEFAULT_D = (0.05, 0.8)  # m
DEFAULT_V_MAX = 1.0  # m/s, the paper's
DEFAULT_HUMAN_SPEED = 1.6  # m/s, walking (ISO 13855)
DEFAULT_HUMAN_ACCELERATION = 3.0  # m/s2, ASSUMED as in the shipped cell
DEFAULT_M_FLOOR = 0.3  # m/s2, as in the shipped cell
DEFAULT_ETA = 1.0  # 1/s
PERIODS = {"torque": 0.001, "acceleration": 0.008}  # s


def register(app: typer.Typer, show: Show, refuse: Refuse) -> None:
    """`show` prints a result, `refuse` ends the program for bad input."""

    @app.command()
    def certify(
        robot: Annotated[str | None, typer.Option(help="a folder of asc_rt/robots; default: the cell's")] = None,
        tool: Annotated[str | None, typer.Option(help="a file of asc_rt/robots/tools; default: the cell's")] = None,
        control: Annotated[str | None, typer.Option(help="torque or acceleration; default: the cell's")] = None,
        cell: Annotated[str | None, typer.Option(help="take k, distances, period and speed from this cell")] = None,
        samples: Annotated[int, typer.Option(help="states to draw")] = 100_000,
        index: Annotated[str, typer.Option(help="phi-star or phi-b (stopping distance)")] = "phi-star",
        seed: Annotated[int, typer.Option(min=0)] = 0,
        k: Annotated[
            float | None, typer.Option(help="certify this k (phi-b: deceleration a), not the found one")
        ] = None,
        coverage: Annotated[float, typer.Option(help="least share of feasible states on phi = 0")] = DEFAULT_COVERAGE,
        d_range: Annotated[tuple[float, float] | None, typer.Option("--d", help="separation distance, m")] = None,
        d_min: Annotated[float | None, typer.Option(help="m")] = None,
        v_max: Annotated[float, typer.Option(help="approach speed, m/s")] = DEFAULT_V_MAX,
        speed: Annotated[float | None, typer.Option(help="share of the joint speeds, 0..1")] = None,
        human_speed: Annotated[float, typer.Option(help="m/s")] = DEFAULT_HUMAN_SPEED,
        human_acceleration: Annotated[float | None, typer.Option(help="m/s2")] = None,
        links: Annotated[str, typer.Option(help="robot capsules sampled: tool, or all that move")] = "tool",
        torque_box: Annotated[
            bool, typer.Option("--torque-box", help="leave the joint limits out, as the paper")
        ] = False,
        limits_from: Annotated[
            Path | None, typer.Option("--limits-from", help="recording whose robot told its own joint limits")
        ] = None,
        out: Annotated[
            Path | None, typer.Option("-o", "--out", help="certificate to write; default: under runs/")
        ] = None,
        cluster: Annotated[str | None, typer.Option(help="Dask scheduler, tcp://HOST:PORT; default: local")] = None,
        as_json: Annotated[bool, typer.Option("--json", help="one JSON object as the last line of stdout")] = False,
    ) -> None:
        """Certify an arm with a tool. Example: asc certify --robot panda --tool ee1 --control torque"""
        from asc_rt.core.robot_model import ModelError
        from asc_rt.synthesis.cluster import ClusterError
        from asc_rt.synthesis.sampling import RangeError
        from logs.mcap_scan import LogError

        given = {
            "index": index, "samples": samples, "seed": seed, "k": k, "required": coverage, "d_range": d_range,
            "d_min": d_min, "v_max": v_max, "speed": speed, "human_speed": human_speed, "torque_box": torque_box,
            "human_acceleration": human_acceleration, "links": links,
        }  # fmt: skip
        try:
            request = make_request(robot, tool, control, cell, **given)
            if limits_from is not None:
                request = replace(request, robot=_told_limits(request.robot, limits_from))
            result = run(request, cluster)
        except (RangeError, ModelError, ClusterError, LogError) as error:
            refuse(str(error))
        file = write(result, out or Path("runs") / f"{request.robot.name}-{request.tool.name}.json")
        for reason in result.certificate.reasons:
            typer.echo(f"not certified: {reason}", err=True)
        show(summary(result, file), as_json)
        raise typer.Exit(0 if result.certificate.certified else 1)


def make_request(robot: str | None, tool: str | None, control: str | None, cell: str | None, **given: Any) -> Request:
    """The request of a command line. RangeError, ConfigError."""
    from asc_rt.config import load_cell
    from asc_rt.synthesis.certificate import Index
    from asc_rt.synthesis.certify import Request
    from asc_rt.synthesis.sampling import RangeError, Ranges

    base = load_cell(cell).params if cell else None
    if base is None and (robot is None or tool is None):
        raise RangeError("--robot and --tool are missing; or name a cell with --cell")
    if control not in (None, *PERIODS):
        raise RangeError(f"--control: {control!r} is unknown; torque or acceleration")
    if given["index"] not in list(Index):
        raise RangeError(f"--index: {given['index']!r} is unknown; phi-star or phi-b")
    if given["links"] not in ("tool", "all"):
        raise RangeError(f"--links: {given['links']!r} is unknown; tool or all")
    _check_numbers(given)
    arm, held = _arm_and_tool(robot, tool, base)
    level = control or (base.control if base else "acceleration")
    if given["torque_box"] and level != "torque":
        raise RangeError("--torque-box: needs --control torque")
    d_min = _first(given["d_min"], base and base.safety.d_min, DEFAULT_D_MIN)
    d_low, d_high = given["d_range"] or ((d_min, base.safety.activation_distance) if base else DEFAULT_D)
    ranges = Ranges(
        d_low=d_low,
        d_high=d_high,
        v_max=given["v_max"],
        speed_share=_first(given["speed"], base and base.task.speed, 1.0),
        human_speed=given["human_speed"],
        human_acceleration=_first(
            given["human_acceleration"], base and base.safety.human_acceleration, DEFAULT_HUMAN_ACCELERATION
        ),
        joint_limits=not given["torque_box"],
        links=given["links"],
    )
    request = Request(
        arm, held, level, Index(given["index"]), ranges, d_min, DEFAULT_M_FLOOR, DEFAULT_ETA, PERIODS[level],
        given["samples"], given["seed"], given["required"], given["k"],
    )  # fmt: skip
    if base is None:
        return request
    k = base.safety.k if request.k is None and request.index is Index.PHI_STAR else request.k
    return replace(request, M_floor=base.safety.M_floor, eta=base.safety.eta, period=base.period, k=k)


def _arm_and_tool(robot: str | None, tool: str | None, base: Params | None) -> tuple[RobotParams, ToolParams]:
    """By their names, or the cell's; a tool that only the cell has is the sphere around its tools."""
    from asc_rt.config import load_arm

    mounts = {mount.tool.name: mount.tool for mount in base.changer.mounts} if base else {}
    if base and robot in (None, base.robot.name) and tool in mounts:
        return load_arm(base.robot.name, base.tool.name)[0], mounts[tool]
    return load_arm(robot or (base.robot.name if base else ""), tool or (base.tool.name if base else ""))


def _told_limits(robot: RobotParams, recording: Path) -> RobotParams:
    """`robot` with the acceleration, jerk and torque that were decided with there, and its own speed, which is the
    greater one: nothing that the arm may do is left out. RangeError: another robot; LogError: the file."""
    from asc_rt.synthesis.certificate import limits_of, with_limits
    from asc_rt.synthesis.sampling import RangeError
    from logs.recording import open_recording

    told = open_recording(recording).params.robot
    if told.name != robot.name:
        raise RangeError(f"--limits-from: {recording} is of {told.name}, not of {robot.name}")
    return with_limits(robot, replace(limits_of(told), dq_max=robot.dq_max))


def run(request: Request, cluster: str | None) -> Result:
    from tqdm import tqdm

    from asc_rt.synthesis import certify, sampling
    from asc_rt.synthesis import cluster as dask

    certify.certify(replace(request, samples=2))  # compiles, or loads what was compiled: not to be timed

    def bar(parts: Iterable[Any], count: int) -> Iterable[Any]:
        return tqdm(parts, total=count, unit=" chunks", disable=None, leave=False)

    with dask.cluster(cluster) if cluster else nullcontext(sampling.threads) as workers:
        return certify.certify(request, workers, bar)


def write(result: Result, path: Path) -> Path:
    """The certificate at `path` and its plots beside it."""
    from asc_rt.synthesis import plots
    from asc_rt.synthesis.certificate import to_json

    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(to_json(result.certificate), encoding="utf-8")
    plots.save(result, path)
    return path


def summary(result: Result, file: Path) -> dict[str, Any]:
    c, s, b = result.certificate, result.certificate.sampled, result.certificate.boundary
    return {
        "robot": c.robot.name,
        "tool": c.tool.name,
        "control": c.control,
        "index": c.index.value,
        "samples": s.samples,
        "seconds": round(result.seconds, 3),
        "cpu_seconds": round(result.cpu_seconds, 3),
        "M_min": s.M_min,
        "M_max": s.M_max,
        "M_ball_min": s.ball_min,
        "M_ball_max": s.ball_max,
        "M_dot_star": s.M_dot_star,
        "M_falling_max": s.falling_max,
        "rho": s.rho,
        "M_nonpositive": s.M_nonpositive,
        "M_ball_nonpositive": s.ball_nonpositive,
        "under_floor": s.under_floor,
        "k": c.k,
        "k_paper": c.k_paper,
        "k_bound": c.k_bound,
        "k_layer": c.k_layer,
        "proven": c.proven,
        "coverage": c.coverage,
        "confidence": c.confidence,
        "coverage_paper": c.coverage_paper,
        "confidence_paper": c.confidence_paper,
        "boundary_states": b.states,
        "joint_limited_feasible": b.feasible / b.states if b.states else None,
        "feasible_least_share": b.least_share,
        "certified": c.certified,
        "reasons": list(c.reasons),
        "certificate": str(file),
    }


def _check_numbers(given: dict[str, Any]) -> None:
    from asc_rt.synthesis.sampling import RangeError

    for key, value in given.items():
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, float) and not math.isfinite(number):
                raise RangeError(f"--{key.replace('_', '-')}: {number} is not a number to work with")
    if given["k"] is not None and not given["k"] > 0.0:
        raise RangeError(f"--k: {given['k']:g} is not possible; above 0")
    if not 0.0 < given["required"] < 1.0:
        raise RangeError(f"--coverage: {given['required']:g} is not possible; above 0, below 1")


def _first(*values: Any) -> Any:
    return next(value for value in values if value is not None)
