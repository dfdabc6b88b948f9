"""The commands of `asc` that read recordings: replay, recover, audit."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from logs.progress import progress

Show = Callable[[dict[str, Any], bool], None]
Refuse = Callable[[str], NoReturn]

Recording = Annotated[Path, typer.Argument(metavar="LOG", help="recording, .mcap")]
AsJson = Annotated[bool, typer.Option("--json", help="one JSON object as the last line of stdout")]


def register(app: typer.Typer, show: Show, refuse: Refuse, limit_blas: Callable[[], None]) -> None:
    """`show` prints a result, `refuse` ends the program for bad input, `limit_blas` has it compute as the loop does."""
    _register_replay(app, show, refuse, limit_blas)
    _register_recover(app, show, refuse)
    _register_audit(app, show, refuse, limit_blas)


def _register_replay(app: typer.Typer, show: Show, refuse: Refuse, limit_blas: Callable[[], None]) -> None:
    @app.command()
    def replay(
        log: Recording,
        start: Annotated[int, typer.Option("--from", help="number of the first cycle to run again", metavar="N")] = 0,
        jobs: Annotated[int, typer.Option("-j", "--jobs", help="processes; 0: one for each core", min=0)] = 1,
        reverse: Annotated[bool, typer.Option("--reverse", help="last cycle first")] = False,
        diff: Annotated[
            bool, typer.Option("--diff", help="let the session go on from its own states, and tell what differs")
        ] = False,
        overrides: Annotated[
            list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="what if: another value of [safety]")
        ] = None,
        as_json: AsJson = False,
    ) -> None:
        """Run every recorded decision again and compare the bytes. Example: asc replay runs/latest.mcap -j 0"""
        limit_blas()
        if overrides or diff:
            _what_if(log, overrides or [], as_json, show)
            return
        from logs.replay import Order, core_stepper
        from logs.replay import replay as replay_log

        order = Order.REVERSE if reverse else Order.FORWARD
        try:
            report = replay_log(
                log, start, order, stepper=core_stepper, jobs=jobs or os.cpu_count() or 1, progress=progress("cycles")
            )
        except IndexError as error:
            refuse(f"--from: {error}")
        show(report.as_dict(), as_json)
        raise typer.Exit(0 if report.mismatches == 0 and report.wire_mismatches == 0 else 1)


def _register_recover(app: typer.Typer, show: Show, refuse: Refuse) -> None:
    @app.command()
    def recover(
        log: Recording,
        out: Annotated[Path, typer.Option("-o", "--out", help="file to write; must not exist")],
        ring: Annotated[
            Path | None, typer.Option(help="the session's ring, /dev/shm/asc-...: what it still holds is added")
        ] = None,
        key: Annotated[Path | None, typer.Option(help="key that sealed the session; default: your own")] = None,
        as_json: AsJson = False,
    ) -> None:
        """Close a recording that a crash left open. Example: asc recover runs/crashed.mcap -o runs/whole.mcap"""
        from logs.recover import recover as recover_log
        from logs.seal import KeyFileError, default_key_file, load_key

        try:
            signer = load_key(key) if key is not None or default_key_file().exists() else None
        except KeyFileError as error:
            refuse(f"{error}; {error.hint}")
        show(recover_log(log, out, ring, signer).as_dict(), as_json)


def _register_audit(app: typer.Typer, show: Show, refuse: Refuse, limit_blas: Callable[[], None]) -> None:
    @app.command()
    def audit(
        log: Recording,
        page: Annotated[Path | None, typer.Option("--html", help="write the report as one self-contained page")] = None,
        public_key: Annotated[
            Path | None, typer.Option(help="whose seals are trusted, .pub; default: this machine's own")
        ] = None,
        sample: Annotated[
            int, typer.Option("--replay", help="cycles to run again, beside those around stops; 0: all", min=0)
        ] = 2000,
        pictures: Annotated[bool, typer.Option(help="pictures of the events in the page")] = True,
        jobs: Annotated[int, typer.Option("-j", "--jobs", help="processes; 0: one for each core", min=0)] = 1,
        as_json: AsJson = False,
    ) -> None:
        """Every rule that must hold in any recording, and the report. Example: asc audit runs/latest.mcap"""
        limit_blas()
        from logs.audit import audit as audit_log
        from logs.seal import KeyFileError

        try:
            trusted, name = _trusted(public_key)
        except KeyFileError as error:
            refuse(f"{error}; {error.hint}")
        report, evidence = audit_log(
            log,
            trusted,
            name,
            sample=sample or None,
            jobs=jobs or os.cpu_count() or 1,
            reading=progress("MB"),
            progress=progress("cycles"),
        )
        if page is not None:
            _write_page(page, report, evidence, pictures)
        if as_json:
            show(report, True)
        else:
            for line in verdict(report):
                print(line)
        raise typer.Exit(0 if report["holds"] else 1)


def _trusted(path: Path | None) -> tuple[Any, str]:
    """The key that the auditor trusts, and its name; None without one. KeyFileError."""
    from logs.seal import default_key_file, load_public_key

    own = default_key_file().with_name(default_key_file().name + ".pub")
    if path is None and not own.exists():
        return None, ""
    return load_public_key(path or own), f"the key {path}" if path else "this machine's own key"


def _write_page(page: Path, report: dict[str, Any], evidence: Any, pictures: bool) -> None:
    from logs.report import html_report, moments

    taken: list[Any] = []
    note = ""
    if evidence is not None and pictures:
        taken, note = _pictures(evidence.log, moments(evidence))
    page.write_text(html_report(report, evidence, taken, note), encoding="utf-8")


def _pictures(log: Any, wanted: list[Any]) -> tuple[list[Any], str]:
    """A picture of each moment, and why there are no more."""
    from logs.report import Picture
    from logs.view import ViewError, picture

    taken: list[Any] = []
    try:
        for moment in progress("pictures")(wanted):
            taken.append(Picture(moment, picture(log, moment.t_s)))
    except ViewError as error:
        return taken, str(error)
    return taken, ""


def verdict(report: dict[str, Any]) -> list[str]:
    """A report in words."""
    words = {True: "ok  ", False: "FAIL"}
    lines = [
        f"{'--  ' if rule.get('skipped') else words[rule['holds']]} {rule['name']:18} {rule['detail']}"
        for rule in report["rules"]
    ]
    held = "every rule holds" if report["holds"] else "NOT IN ORDER"
    return [*lines, f"{held}; report {report['report_sha256'][:16]}"]


def _what_if(path: Path, overrides: list[str], as_json: bool, show: Show) -> None:
    """Exit code 0: a difference is what was asked for."""
    from asc_rt.config import what_if as changed
    from logs.recording import open_recording
    from logs.replay import core_stepper
    from logs.whatif import what_if

    log = open_recording(path)
    params = changed(log.params, overrides) if overrides else log.params
    found = what_if(log, core_stepper(params), params, progress=progress("cycles"))
    first = found.first
    result = {
        "cycles": found.cycles,
        "mismatches": found.differing,
        "exact": found.differing == 0,
        "first_difference": None if first is None else {k: v for k, v in first.items() if k != "t_s"},
        **found.as_dict(),
    }
    if as_json:
        show(result, True)
        return
    for line in told(result):
        print(line)


def told(found: dict[str, Any]) -> list[str]:
    """A what-if in words."""
    first = found["first"]
    if first is None:
        return [f"{found['cycles']} cycles, nothing differs"]
    where = f"cycle {first['cycle']}, {first['t_s']:.3f} s"
    lines = [
        f"{found['differing']} of {found['cycles']} cycles differ",
        f"first: {where}: {first['field']}: {first['logged']} -> {first['replayed']}",
    ]
    lines += [f"stop   {line}" for line in found["stops"]] or ["stops  none, before and now"]
    if found["ended"]:
        lines.append(f"ended  {found['ended']}")
    for name, change in found["fields"].items():
        largest = "" if change["largest"] is None else f"by up to {change['largest']:.3g} (cycle {change['at']})"
        lines.append(f"{name:36} {change['cycles']:8} cycles {largest}")
    return lines
