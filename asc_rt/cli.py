"""`asc`: the command line. Exit codes: 0 as it should be, 1 what was checked does not hold, 2 bad usage or bad input.

Results go to stdout, with --json as one object on the last line; everything else goes to stderr. Libraries are imported
by the command that needs them: `asc --help` must not wait for them.
"""

from __future__ import annotations

import json
import math
import os
import sys
import time
from contextlib import suppress
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from asc_rt.synthesis import command as synthesis
from calibration import command as calibration
from logs import commands

DEFAULT_CELL = "fanuc-sim"
BAD_INPUT = 2

app = typer.Typer(
    help="Safe robot cell: control, record, replay, view. Not a safety-rated function.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

CellName = Annotated[str, typer.Argument(metavar="[CELL]", help="name under asc_rt/cells, or path to a cell file")]
Overrides = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="put over the cell file; may be repeated")
]
AsJson = Annotated[bool, typer.Option("--json", help="one JSON object as the last line of stdout")]


class Device(StrEnum):
    FANUC = "fanuc"
    CAN = "can"
    HUMAN = "human"
    CAMERA = "camera"


class Benchmark(StrEnum):
    STEP = "step"
    CYCLE = "cycle"
    SAMPLING = "sampling"
    PERCEPTION = "perception"
    LOG = "log"
    ALL = "all"


@app.command()
def run(
    cell: CellName = DEFAULT_CELL,
    duration: Annotated[float | None, typer.Option(help="seconds; without it until Ctrl-C", metavar="S")] = None,
    log: Annotated[
        Path | None, typer.Option(help="recording to write; default: a new file in the cell's log.dir")
    ] = None,
    overrides: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Run a cell: controller, logger and, in a simulated cell, robot and person. Example: asc run --duration 20"""
    from asc_rt.certified import require
    from asc_rt.config import load_cell
    from asc_rt.supervisor import run_cell

    if duration is not None and not (math.isfinite(duration) and duration > 0):
        _refuse(f"--duration: {duration:g} s is not possible; more than 0")
    config = load_cell(cell, overrides or [])
    require(config)
    path = log or config.log_dir / f"{config.name}-{time.strftime('%Y%m%d-%H%M%S')}.mcap"
    if path.exists():
        _refuse(f"--log: {path} exists; recordings are never overwritten")
    session = run_cell(config, path, duration)
    from logs.summary import summarise

    if log is None:
        _point_latest(path)
    result = summarise(path)
    result["exit_reason"] = session.exit_reason(result["exit_reason"])
    result["processes_lost"] = session.deaths
    result["cpu_share"] = session.cpu_share
    if "driver" in session.end:
        result["driver"] = session.end["driver"]
    _show(result, as_json)
    raise typer.Exit(0 if session.completed and not result["robot_caused_violations"] else 1)


@app.command()
def sim(
    device: Device,
    cell: CellName = DEFAULT_CELL,
    port: Annotated[int | None, typer.Option(help="UDP port of the robot; default: the cell's driver.port")] = None,
    strict: Annotated[bool, typer.Option("--strict", help="fanuc: exit 1 if the client broke the protocol")] = False,
    faults: Annotated[
        Path | None, typer.Option(help="fanuc, can: script of faults, TOML with [[faults]]", metavar="FILE")
    ] = None,
    overrides: Overrides = None,
) -> None:
    """One simulated device alone, for a controller elsewhere. Example: asc sim fanuc --port 60015"""
    from asc_rt.config import load_cell
    from asc_rt.processes import run_device

    changes = [*(overrides or []), *([f"driver.port={port}"] if port is not None else [])]
    config = load_cell(cell, changes)
    options = [*(["--strict"] if strict else []), *(["--faults", str(faults)] if faults else [])]
    raise typer.Exit(run_device(config, device.value, options))


@app.command()
def perceive(
    cell: CellName = DEFAULT_CELL,
    remote: Annotated[
        bool, typer.Option("--remote", help="the cell runs on another machine: its [bus.remote]")
    ] = False,
    background: Annotated[
        bool, typer.Option("--background", help="commission: learn what the cameras see in the empty cell")
    ] = False,
    arm: Annotated[
        str, typer.Option("--arm-deg", metavar="Q1,Q2,...", help="where the arm stands meanwhile, as its pendant shows")
    ] = "",
    add: Annotated[
        bool, typer.Option("--add", help="with the arm elsewhere, to learn what it hid the first time")
    ] = False,
    overrides: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """The perception process alone. Example: asc perceive fanuc-sim"""
    from asc_rt.config import load_cell
    from asc_rt.processes import run_perception

    config = load_cell(cell, overrides or [])
    if config.perception is None:
        _refuse(f"{config.path}: perception: missing; a cell that sees has a table [perception]")
    if not background:
        raise typer.Exit(run_perception(config, remote))
    from asc_rt.perception.commission import CommissionError, commission

    try:
        result = commission(config, arm, add)
    except CommissionError as error:
        _refuse(str(error))
    _show(result, as_json)
    raise typer.Exit(0 if result["ok"] else 1)


@app.command()
def keys(cell: CellName = DEFAULT_CELL, overrides: Overrides = None, as_json: AsJson = False) -> None:
    """Certificates for a cell of several machines: one for the cell, one for each sensor. Example: asc keys CELL"""
    from asc_rt import bus_keys
    from asc_rt.config import load_cell

    config = load_cell(cell, overrides or [])
    if config.remote is None:
        _refuse(f"{config.path}: bus.remote: missing; its endpoint is where the cell listens for other machines")
    try:
        made = bus_keys.make(config.remote.keys, config.remote.host, [s.name for s in config.params.human.sensors])
    except OSError as error:
        _refuse(f"{config.remote.keys}: {error.strerror}: {error.filename}; remove the folder to make all keys anew")
    _show({"made": [str(path) for path in made]}, as_json)


@app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []})
def trials(ctx: typer.Context) -> None:
    """Seeded trials in simulation, beside the same without the filter. Example: asc trials table1 -n 20"""
    from asc_rt.trials import run_trials

    raise typer.Exit(run_trials(ctx.args))


@app.command()
def view(
    log: Annotated[
        Path | None, typer.Argument(metavar="LOG", help="recording; with --live the cell, if not the newest")
    ] = None,
    live: Annotated[bool, typer.Option("--live", help="the running cell instead of a recording")] = False,
    save: Annotated[Path | None, typer.Option(help="write a .rrd file instead of opening the viewer")] = None,
    shot: Annotated[Path | None, typer.Option(help="write a picture, .png; needs no display")] = None,
    at: Annotated[
        float | None, typer.Option(help="moment of the picture, seconds; default: the nearest approach", metavar="S")
    ] = None,
    web: Annotated[bool, typer.Option("--web", help="serve the viewer to a browser on this machine")] = False,
    overrides: Overrides = None,
) -> None:
    """Open a recording, or the running cell, in Rerun. Example: asc view runs/latest.mcap"""
    if not live:
        from logs.view import view as view_log

        if log is None:
            _refuse("LOG is missing: name a recording, or --live for the running cell")
        if overrides:
            _refuse("--set belongs to --live: a recording carries its own values")
        view_log(log, save=save, shot=shot, at=at, web=web)
        return
    from asc_rt.config import load_cell
    from logs.view_live import live as view_live
    from logs.view_live import newest_ring

    if save or shot or at is not None:
        _refuse("--live can be neither saved nor shot: use the recording")
    ring, name = newest_ring()
    view_live(load_cell(str(log or name), overrides or []).params, ring, web)


@app.command()
def bench(
    what: Annotated[
        Benchmark,
        typer.Argument(
            help="step: the decision alone; cycle: in a loop at the cell's period; sampling: states that "
            "certify draws in a second; perception: from a depth picture to people; log: what recording costs the "
            "loop and the logger"
        ),
    ] = Benchmark.ALL,
    cell: Annotated[str, typer.Option(help="cell whose robot and period are used")] = DEFAULT_CELL,
    as_json: AsJson = False,
) -> None:
    """Measure decision, loop, sampling and recording, beside their goals. Example: asc bench cycle"""
    _limit_blas()
    from asc_rt.bench import run as run_bench

    result = run_bench(what.value, cell)
    if as_json:
        _show(result, as_json)
        return
    print(result["machine"])
    for line in result["missing"]:
        print(f"real-time set-up lacks {line}", file=sys.stderr)
    for row in result["rows"]:
        print(f"{row['name']:24} {row['value']:10.1f} {row['unit']} {row['ratio']:8.2f} of {row['reference']:g}")


@app.command()
def export(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="recording of a cell on CAN")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="candump .log, .asc or .blf")],
) -> None:
    """Write the frames of a recording as a standard CAN log. Example: asc export runs/latest.mcap can.log"""
    from drivers.base import DriverError, Exportable
    from logs.recording import open_recording
    from logs.wire import codec_of, driver_of, packets

    if out.exists():
        _refuse(f"{out} exists; it is not overwritten")
    recording = open_recording(log)
    driver = codec_of(recording)
    if not isinstance(driver, Exportable):
        _refuse(f"{log}: driver {driver_of(recording)!r} has no format for other tools")
    rx, tx = packets(recording)
    both = [("rx", t_ns, data) for t_ns, data in rx.items()] + [("tx", t_ns, data) for t_ns, data in tx.items()]
    try:
        count = driver.export(sorted(both, key=lambda packet: packet[1]), str(out))
    except (ValueError, DriverError) as error:
        _refuse(f"{log}: {error}")
    print(f"{count} frames in {out}")


@app.command()
def drives(
    cell: CellName = DEFAULT_CELL,
    reset: Annotated[
        list[int] | None, typer.Option(help="axis whose fault is looked after; may be repeated", metavar="AXIS")
    ] = None,
    supported: Annotated[
        bool, typer.Option("--supported", help="the arm is held: an axis without brake falls when it is reset")
    ] = False,
    assign: Annotated[
        int | None, typer.Option(help="node number for the one drive that has none", metavar="NODE")
    ] = None,
    overrides: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """How each drive is; reset a fault, number a new drive. Nothing may run. Example: asc drives CELL --reset 3"""
    from asc_rt.config import load_cell
    from asc_rt.service import serve

    if assign is not None and reset:
        _refuse("--assign and --reset: one at a time")
    checks = serve(load_cell(cell, overrides or []), reset or [], supported, assign)
    if checks is None:
        _refuse(f"{cell}: the drives of this robot are not served from here")
    _tell_checks(checks, as_json)


@app.command()
def doctor(cell: CellName = DEFAULT_CELL, as_json: AsJson = False) -> None:
    """Is this PC, and this cell, fit to run? Example: asc doctor fanuc-sim"""
    from asc_rt.doctor import examine

    _tell_checks(examine(cell), as_json)


def main() -> NoReturn:
    """Entry point of `asc`."""
    code = _run()
    with suppress(BrokenPipeError):
        sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # some libraries print about themselves when the interpreter is torn down


def _run() -> int:
    try:
        app()
    except SystemExit as leaving:
        return leaving.code if isinstance(leaving.code, int) else BAD_INPUT
    except Exception as error:
        lines = _lines(error)
        if lines is None:
            raise
        for line in lines:
            print(f"error: {line}", file=sys.stderr)
        return BAD_INPUT
    return 0


def _lines(error: Exception) -> list[str] | None:
    """What to tell of an error that is the input's fault; None: it is ours."""
    from asc_rt.bus import BusError
    from asc_rt.config import ConfigError
    from asc_rt.ring import RingError
    from asc_rt.supervisor import StartError
    from logs.mcap_scan import LogError

    if isinstance(error, ConfigError):
        return list(error.lines)
    if isinstance(error, BusError | RingError):
        return [f"{error}; {error.hint}" if error.hint else str(error)]
    if isinstance(error, StartError | LogError):
        return [str(error)]
    if isinstance(error, OSError) and error.filename:
        return [f"{error.filename}: {error.strerror}"]
    return None


def _point_latest(log: Path) -> None:
    """`latest.mcap` beside the recordings is the newest one."""
    link = log.with_name("latest.mcap")
    link.unlink(missing_ok=True)
    link.symlink_to(log.name)


def _refuse(line: str) -> NoReturn:
    print(f"error: {line}", file=sys.stderr)
    raise typer.Exit(BAD_INPUT)


def _show(result: dict[str, Any], as_json: bool) -> None:
    if as_json:
        print(json.dumps(result, allow_nan=False))
        return
    for key, value in result.items():
        print(f"{key:24} {_text(value)}")


def _tell_checks(result: dict[str, Any], as_json: bool) -> NoReturn:
    if as_json:
        _show(result, as_json)
    else:
        for check in result["checks"]:
            fix = "" if check["ok"] else f" | do: {check['fix']}"
            print(f"{'ok  ' if check['ok'] else 'FAIL'} {check['name']}: {check['detail']}{fix}")
    raise typer.Exit(0 if result["ok"] else 1)


def _text(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, dict):
        return ", ".join(f"{key} {_text(item)}" for key, item in value.items())
    if isinstance(value, list):
        return "; ".join(_text(item) for item in value) or "none"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _limit_blas() -> None:
    """Replay and benchmarks must run as the control process does."""
    from asc_rt import realtime

    realtime.one_blas_thread()


commands.register(app, _show, _refuse, lambda: _limit_blas())
synthesis.register(app, _show, _refuse)
calibration.register(app, _show, _refuse)

if __name__ == "__main__":
    main()
