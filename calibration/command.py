"""`asc calibrate ...`: from files to a result file. Each command reads, calls its pure method, writes and shows."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

if TYPE_CHECKING:
    from calibration.result import Result

Show = Callable[[dict[str, Any], bool], None]
Refuse = Callable[[str], NoReturn]
AsJson = Annotated[bool, typer.Option("--json", help="one JSON object as the last line of stdout")]


def register(app: typer.Typer, show: Show, refuse: Refuse) -> None:
    """Add `calibrate` with its commands; `show` prints a result, `refuse` ends the program for bad input."""
    group = typer.Typer(
        help="Calibration results: accepted or refused with the reason. Example: asc calibrate check cam.json",
        no_args_is_help=True,
    )
    app.add_typer(group, name="calibrate")

    @group.command()
    def check(
        file: Annotated[Path, typer.Argument(metavar="FILE", help="result file")],
        camera: Annotated[str | None, typer.Option(help="serial number of the camera at hand")] = None,
        mode: Annotated[str | None, typer.Option(help="mode it runs in, for example 1280x720")] = None,
        as_json: AsJson = False,
    ) -> None:
        """May this result be used today, with this device? Example: asc calibrate check cam.json --camera 1234"""
        from calibration.result import CalibrationError, load, read

        try:
            result = read(file)
        except CalibrationError as error:
            refuse("\n".join(error.lines))
        reasons: tuple[str, ...] = ()
        try:
            load(file, serials={} if camera is None else {"camera": camera}, mode=mode)
        except CalibrationError as error:
            reasons = error.lines
        show(summary(result, file) | {"accepted": not reasons, "reasons": list(reasons)}, as_json)
        raise typer.Exit(1 if reasons else 0)


def summary(result: Result, file: Path) -> dict[str, Any]:
    """What scripts rely on, of any kind."""
    keys = ("rms", "chi2_dof", "holdout", "coverage")
    return {
        "kind": result.kind,
        "frame": result.frame,
        "value": list(result.value),
        "covariance": [list(row) for row in result.covariance],
        **{key: result.quality.get(key) for key in keys},
        "accepted": result.accepted,
        "reasons": list(result.reasons),
        "hash": result.digest.hex(),
        "valid_until": result.valid_until,
        "file": str(file),
    }
