"""`asc recover` and `asc audit` as a script uses them: exit codes, one JSON object, one line for bad input."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from asc_rt import cli
from logs import seal
from logs.reader import open_log

ROOT = Path(__file__).parents[2]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """Run `asc ARGUMENTS` in this process: exit code and stdout."""
    monkeypatch.setattr(cli, "_limit_blas", lambda: None)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))

    def invoke(*arguments: str) -> tuple[int, str]:
        result = CliRunner().invoke(cli.app, list(arguments))
        return result.exit_code, result.stdout

    return invoke


def last_json(out: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(out.splitlines()[-1])
    return found


def test_audit_tells_the_verdict_and_writes_the_page(
    run: Any, core_session: tuple[Path, list[Any]], tmp_path: Path
) -> None:
    page = tmp_path / "report.html"
    options = ["--html", str(page), "--no-pictures", "--replay", "5", "--json"]
    code, out = run("audit", str(core_session[0]), *options)
    report = last_json(out)
    assert (code, report["holds"]) == (0, True)
    assert report["report_sha256"] in page.read_text()


def test_audit_trusts_the_key_that_it_is_given_and_this_machines_own_without_one(
    run: Any, core_session: tuple[Path, list[Any]], tmp_path: Path
) -> None:
    log, public = str(core_session[0]), tmp_path / "their.pub"
    theirs = seal.Ed25519PublicKey.from_public_bytes(bytes.fromhex(open_log(log).seals.public_key))
    public.write_bytes(seal.public_pem(theirs))
    assert run("audit", log, "--public-key", str(public), "--replay", "5")[0] == 0
    seal.load_key()  # now this machine has one, and it is another
    code, out = run("audit", log, "--replay", "5")
    assert code == 1
    assert "FAIL seals" in out
    assert run("audit", log, "--public-key", "none.pub")[0] == 2


def test_an_altered_file_is_exit_code_1_and_no_recording_2(run: Any, core_session: tuple[Path, list[Any]]) -> None:
    data = bytearray(core_session[0].read_bytes())
    data[len(data) // 2] ^= 1
    core_session[0].write_bytes(data)
    code, out = run("audit", str(core_session[0]), "--json")
    assert (code, last_json(out)["crc_ok"]) == (1, False)


def test_recover_tells_what_it_did(run: Any, recording: Any, tmp_path: Path) -> None:
    path = recording.write(recording.packed(recording.cycles(12)), close=False)
    whole = tmp_path / "whole.mcap"
    code, out = run("recover", str(path), "-o", str(whole), "--json")
    found = last_json(out)
    assert code == 0
    assert {"records", "cycles", "bytes_cut", "seals_valid"} <= set(found)
    assert (found["cycles"], found["bytes_cut"], found["seals_valid"]) == (12, 0, False)
    assert not open_log(whole).truncated


def test_a_what_if_is_told_in_words_and_as_json(run: Any, core_session: tuple[Path, list[Any]]) -> None:
    code, out = run("replay", str(core_session[0]), "--set", "safety.d_min_m=0.2")
    assert code == 0
    assert "first: cycle " in out
    code, out = run("replay", str(core_session[0]), "--set", "safety.d_min_m=0.2", "--json")
    found = last_json(out)
    assert {"cycles", "mismatches", "exact", "first_difference", "fields", "stops", "waveforms"} <= set(found)
    assert last_json(run("replay", str(core_session[0]), "--diff", "--json")[1])["exact"] is True


@pytest.mark.timeout(300)
@pytest.mark.parametrize("command", [["replay"], ["replay", "-j", "2"], ["audit", "--replay", "5"]])
def test_replay_and_audit_run_as_a_user_runs_them(
    core_session: tuple[Path, list[Any]], tmp_path: Path, command: list[str]
) -> None:
    """In a process of their own: BLAS must be limited before anything that the command line imports loads numpy."""
    name, *options = command
    words = [sys.executable, "-m", "asc_rt", name, str(core_session[0]), *options, "--json"]
    environment = {"PATH": "/usr/bin", "HOME": str(tmp_path)}
    done = subprocess.run(words, capture_output=True, text=True, cwd=ROOT, env=environment, timeout=280)
    assert done.returncode == 0, done.stderr
    found = last_json(done.stdout)
    assert found["holds"] if name == "audit" else (found["exact"], found["mismatches"]) == (True, 0)
