"""`asc calibrate ...`: from files to a result file. Each command reads, calls its pure method, writes and shows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

if TYPE_CHECKING:
    from calibration.result import Result

Show = Callable[[dict[str, Any], bool], None]
Refuse = Callable[[str], NoReturn]
AsJson = Annotated[bool, typer.Option("--json", help="one JSON object as the last line of stdout")]
Out = Annotated[
    Path | None, typer.Option("-o", "--out", metavar="FILE", help="result file to write; default: the method's name")
]
Pictures = Annotated[Path, typer.Argument(metavar="PICTURES", help="folder of pictures of the board")]
BoardSize = Annotated[str, typer.Option("--board", help="squares of the ChArUco board, columns x rows")]
Square = Annotated[float, typer.Option("--square-m", help="side of one square, MEASURED on the print, m")]
Robot = Annotated[str, typer.Option(help="robot of asc_rt/robots")]
Camera = Annotated[str, typer.Option(help="serial number of the camera")]
Operator = Annotated[str, typer.Option(help="who calibrates")]
Days = Annotated[int, typer.Option(help="days until it expires")]
Watch = Annotated[
    bool, typer.Option("--watch", help="look at pictures as they arrive in the folder, say what to show next")
]
VALID_DAYS = 90


def register(app: typer.Typer, show: Show, refuse: Refuse) -> None:
    """Add `calibrate` with its commands; `show` prints a result, `refuse` ends the program for bad input."""
    group = typer.Typer(
        help="Calibration: results with error bars, accepted or refused with the reason; a picture shows why. "
        "Example: asc calibrate intrinsics PICTURES --square-m 0.03",
        no_args_is_help=True,
    )
    app.add_typer(group, name="calibrate")
    end = Ending(show, refuse)
    _add_intrinsics(group, end)
    _add_hand_eye(group, end)
    _add_tool(group, end)
    _add_payload(group, end)
    _add_time_offset(group, end)
    _add_drift(group, end)
    _add_check(group, end)


@dataclass(frozen=True, slots=True)
class Ending:
    """How every command ends: bad input 2, a refused result 1 (written too, it says why), an accepted one 0."""

    show: Show
    refuse: Refuse

    def run(self, work: Callable[[Path], Result], kind: str, out: Path | None, as_json: bool) -> None:
        from calibration.result import CalibrationError

        path = out or Path(f"{kind}.json")
        if path.exists():
            self.refuse(f"{path}: exists; calibrations are never overwritten: name another by -o, or move it away")
        if not path.parent.is_dir():
            self.refuse(f"{path.parent}: no folder")
        try:
            result = work(path)
        except CalibrationError as error:
            self.refuse("\nerror: ".join(error.lines))
        result.save(path)
        self.show(summary(result, path) | {"report": str(picture(path))}, as_json)
        raise typer.Exit(0 if result.accepted else 1)


def picture(path: Path) -> Path:
    """The report of a result file."""
    return path.with_suffix(".png")


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


def _add_intrinsics(group: typer.Typer, end: Ending) -> None:
    @group.command()
    def intrinsics(
        pictures: Pictures,
        square_m: Square,
        board: BoardSize = "9x6",
        camera: Camera = "",
        operator: Operator = "",
        days: Days = VALID_DAYS,
        watch: Watch = False,
        out: Out = None,
        as_json: AsJson = False,
    ) -> None:
        """Lens and focal length of a camera. Example: asc calibrate intrinsics PICTURES --square-m 0.03 -o lens.json"""

        def work(path: Path) -> Result:
            from calibration import guide, jobs

            print_ = jobs.board(board, square_m)
            if watch:
                guide.watch(pictures, print_, lambda seen: guide.advice(seen, print_))
            return jobs.intrinsics(pictures, print_, jobs.Label(camera, "", operator, days), picture(path))

        end.run(work, "intrinsics", out, as_json)


def _add_hand_eye(group: typer.Typer, end: Ending) -> None:
    @group.command("hand-eye")
    def hand_eye(
        pictures: Pictures,
        poses: Annotated[Path, typer.Option(help="CSV: picture and T_base_flange of each: x_m y_m z_m qx qy qz qw")],
        lens: Annotated[Path, typer.Option("--intrinsics", help="result file of this camera and mode")],
        square_m: Square,
        board: BoardSize = "9x6",
        touch: Annotated[
            Path | None, typer.Option(help="CSV of the check: x_m y_m z_m touched, cx_m cy_m cz_m seen by the camera")
        ] = None,
        robot_mm: Annotated[float, typer.Option(help="sigma of one flange pose of the robot, mm")] = 0.5,
        robot_deg: Annotated[float, typer.Option(help="sigma of one flange pose of the robot, deg")] = 0.03,
        robot_serial: Annotated[str, typer.Option(help="serial number of the robot")] = "",
        operator: Operator = "",
        days: Days = VALID_DAYS,
        watch: Watch = False,
        out: Out = None,
        as_json: AsJson = False,
    ) -> None:
        """Where the camera stands: T_base_cam, the board on the flange. Example:
        asc calibrate hand-eye PICTURES --poses poses.csv --intrinsics lens.json --square-m 0.03"""

        def work(path: Path) -> Result:
            from calibration import guide, jobs
            from calibration.result import load

            noise, print_ = jobs.robot_noise(robot_mm, robot_deg), jobs.board(board, square_m)
            if watch:
                seen_through = load(lens, "intrinsics")
                guide.watch(pictures, print_, lambda seen: guide.advice_on_arm(seen, print_, seen_through))
            label = jobs.Label("", robot_serial, operator, days)
            files = jobs.HandEyeFiles(pictures, poses, lens, touch)
            return jobs.hand_eye(files, print_, noise, label, picture(path))

        end.run(work, "hand-eye", out, as_json)


def _add_tool(group: typer.Typer, end: Ending) -> None:
    @group.command()
    def tool(
        poses: Annotated[
            Path, typer.Argument(metavar="POSES", help="CSV of T_base_flange with the tip on one fixed point")
        ],
        touch_mm: Annotated[float, typer.Option(help="sigma of one touch, mm")] = 0.5,
        robot_serial: Annotated[str, typer.Option(help="serial number of the robot")] = "",
        operator: Operator = "",
        days: Days = VALID_DAYS,
        out: Out = None,
        as_json: AsJson = False,
    ) -> None:
        """Tool centre point from touches of one point. Example: asc calibrate tool touches.csv -o tool.json"""

        def work(path: Path) -> Result:
            from calibration import jobs

            return jobs.tool(poses, touch_mm, jobs.Label("", robot_serial, operator, days), picture(path))

        end.run(work, "tool", out, as_json)


def _add_payload(group: typer.Typer, end: Ending) -> None:
    @group.command()
    def payload(
        loaded: Annotated[Path, typer.Argument(metavar="LOADED", help="CSV at rest: q1_rad.. tau1_Nm.. of each pose")],
        empty: Annotated[
            Path | None, typer.Option(help="the same poses without the payload; default: the robot's model")
        ] = None,
        robot: Robot = "lrmate_200id",
        operator: Operator = "",
        days: Days = VALID_DAYS,
        out: Out = None,
        as_json: AsJson = False,
    ) -> None:
        """Mass and centre of mass of a tool, for its file. Example: asc calibrate payload loaded.csv"""

        def work(path: Path) -> Result:
            from calibration import jobs

            return jobs.payload(loaded, empty, robot, jobs.Label("", "", operator, days), picture(path))

        end.run(work, "payload", out, as_json)


def _add_time_offset(group: typer.Typer, end: Ending) -> None:
    @group.command("time-offset")
    def time_offset(
        robot: Annotated[
            Path, typer.Argument(metavar="ROBOT", help="recording of asc run (.mcap), or CSV of t_s x_m y_m z_m")
        ],
        camera: Annotated[Path, typer.Argument(metavar="CAMERA", help="CSV of t_s x_m y_m z_m as the camera saw it")],
        tool: Annotated[
            Path | None, typer.Option(help="tool result: the camera follows its tip; default: the flange's origin")
        ] = None,
        span_s: Annotated[float, typer.Option(help="offsets that are looked at, +- s")] = 0.3,
        serial: Annotated[str, typer.Option("--camera-serial", help="serial number of the camera")] = "",
        operator: Operator = "",
        days: Days = VALID_DAYS,
        out: Out = None,
        as_json: AsJson = False,
    ) -> None:
        """The camera's clock against the robot's. Example: asc calibrate time-offset run.mcap cam.csv"""

        def work(path: Path) -> Result:
            from calibration import jobs

            label = jobs.Label(serial, "", operator, days)
            return jobs.time_offset(robot, camera, tool, span_s, label, picture(path))

        end.run(work, "time-offset", out, as_json)


def _add_drift(group: typer.Typer, end: Ending) -> None:
    @group.command()
    def drift(
        depth: Annotated[Path, typer.Argument(metavar="DEPTH", help="folder of depth pictures of the robot, 16 bits")],
        joints: Annotated[Path, typer.Option(help="CSV: picture and q1_rad.. of the moment of each")],
        lens: Annotated[Path, typer.Option("--intrinsics", help="result file of this camera and mode")],
        eye: Annotated[Path, typer.Option("--hand-eye", help="result file to be checked")],
        robot: Robot = "lrmate_200id",
        tool: Annotated[str, typer.Option(help="tool of asc_rt/robots/tools that it carries")] = "bare",
        unit_mm: Annotated[float, typer.Option(help="depth of one count, mm")] = 1.0,
        margin_mm: Annotated[float, typer.Option(help="margin of the self-filter, mm; half of it is the limit")] = 40.0,
        out: Annotated[Path, typer.Option("-o", "--out", help="picture to draw")] = Path("drift.png"),
        as_json: AsJson = False,
    ) -> None:
        """Daily: has the camera moved? Example:
        asc calibrate drift DEPTH --joints q.csv --intrinsics lens.json --hand-eye eye.json"""
        from calibration import jobs
        from calibration.result import CalibrationError

        if not (0.01 <= unit_mm <= 10 and 5 <= margin_mm <= 200):
            end.refuse(f"--unit-mm {unit_mm:g}, --margin-mm {margin_mm:g}: 0.01 to 10, and 5 to 200")
        try:
            given = jobs.DriftFiles(depth, joints, lens, eye)
            found = jobs.drift(given, robot, tool, 1e-3 * unit_mm, 1e-3 * margin_mm, out)
        except CalibrationError as error:
            end.refuse("\nerror: ".join(error.lines))
        known = not found.absent > jobs.drift_method.MOST_ABSENT  # a robot that is not there has no shift
        numbers = {
            "shift_mm": 1e3 * found.shift if known else None,
            "outside_mm": 1e3 * found.outside if known else None,
            "limit_mm": margin_mm / 2,
            "absent": found.absent,
            "points": found.points,
        }
        end.show(numbers | {"ok": not found.reasons, "reasons": list(found.reasons), "report": str(out)}, as_json)
        raise typer.Exit(1 if found.reasons else 0)


def _add_check(group: typer.Typer, end: Ending) -> None:
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
            end.refuse("\nerror: ".join(error.lines))
        reasons: tuple[str, ...] = ()
        try:
            load(file, serials={} if camera is None else {"camera": camera}, mode=mode)
        except CalibrationError as error:
            reasons = error.lines
        end.show(summary(result, file) | {"accepted": not reasons, "reasons": list(reasons)}, as_json)
        raise typer.Exit(1 if reasons else 0)
