"""`asc certify` as a script sees it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NoReturn

import pytest
import typer
from typer.testing import CliRunner

from asc_rt.config import ConfigError
from asc_rt.synthesis import command
from asc_rt.synthesis.certificate import load

pytestmark = pytest.mark.timeout(300)
PANDA = ["--robot", "panda", "--tool", "ee2", "--control", "torque"]
KEYS = {
    "robot", "tool", "control", "samples", "seconds", "M_min", "M_max", "M_dot_star", "M_nonpositive", "k", "k_paper",
    "coverage", "confidence", "joint_limited_feasible", "certificate",
}  # fmt: skip


class Refused(Exception):
    pass


def refuse(line: str) -> NoReturn:
    raise Refused(line)


def run(*arguments: str) -> tuple[int, dict[str, Any]]:
    app, shown = typer.Typer(), []
    command.register(app, lambda result, as_json: shown.append(result), refuse)
    result = CliRunner().invoke(app, list(arguments))
    if isinstance(result.exception, Refused | ConfigError):
        raise result.exception
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, shown[0] if shown else {}


def test_a_certificate_its_plots_and_the_promised_keys(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "panda.json"
    arguments = ("--torque-box", "--human-speed", "0", "--human-acceleration", "0", "--coverage", "0.9")
    code, result = run(*PANDA, *arguments, "--samples", "2000", "-o", str(out))
    assert code == 0
    assert result.keys() >= KEYS
    json.dumps(result, allow_nan=False)
    assert (result["robot"], result["tool"], result["control"], result["samples"]) == ("panda", "ee2", "torque", 2000)
    assert result["certificate"] == str(out)
    assert load(out).certified
    pictures = sorted(p.name for p in out.parent.glob("*.png"))
    assert pictures == ["panda-distribution.png", "panda-poses.png"]
    assert all((out.parent / name).read_bytes()[:4] == b"\x89PNG" for name in pictures)


def test_not_certified_is_exit_1_and_the_file_says_so(tmp_path: Path) -> None:
    out = tmp_path / "c.json"
    code, result = run(*PANDA, "--samples", "500", "--coverage", "0.99999", "-o", str(out))
    assert code == 1
    assert result["reasons"]
    assert not load(out).certified


def test_a_cell_gives_the_figures() -> None:
    given = {
        "index": "phi-star", "samples": 10, "seed": 0, "k": None, "required": 0.9, "d_range": None, "d_min": None,
        "v_max": 2.0, "speed": None, "human_speed": 1.6, "torque_box": False, "human_acceleration": None,
        "links": "tool",
    }  # fmt: skip
    request = command.make_request(None, "bat", None, "fanuc-sim-truth", **given)
    assert (request.robot.name, request.tool.name, request.control) == ("lrmate_200id", "bat", "acceleration")
    assert (request.k, request.d_min, request.period) == (3.0, 0.1, 0.008)
    assert (request.ranges.d_low, request.ranges.d_high, request.ranges.speed_share) == (0.1, 1.0, 0.5)
    assert command.make_request(None, None, None, "fanuc-sim-truth", **{**given, "k": 7.0}).k == 7.0
    assert command.make_request(None, None, None, "fanuc-sim-truth", **{**given, "index": "phi-b"}).k is None


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "--robot and --tool are missing"),
        ([*PANDA, "--samples", "0"], "--samples: 0"),
        ([*PANDA, "--d", "0", "0.8"], "d from 0 m"),
        ([*PANDA, "--d", "0.5", "0.2"], "d up to 0.2 m"),
        ([*PANDA, "--d", "nan", "0.2"], "nan is not a number"),
        ([*PANDA, "--k", "0"], "--k: 0"),
        ([*PANDA, "--k", "inf"], "inf is not a number"),
        ([*PANDA, "--coverage", "1"], "--coverage: 1"),
        ([*PANDA, "--index", "phi"], "--index: 'phi' is unknown"),
        ([*PANDA, "--links", "hand"], "--links: 'hand' is unknown"),
        ([*PANDA, "--speed", "2"], "speed share 2"),
        ([*PANDA[:4], "--control", "jerk"], "--control: 'jerk' is unknown"),
        (["--robot", "pandas", "--tool", "ee1"], "'pandas' is unknown"),
        (["--robot", "panda", "--tool", "spoon"], "'spoon' is unknown"),
        (["--robot", "lrmate_200id", "--tool", "drill", "--control", "torque"], "torque limit"),
        (["--robot", "lrmate_200id", "--tool", "drill", "--torque-box"], "--torque-box: needs"),
        ([*PANDA, "--cluster", "tcp://127.0.0.1:1", "--samples", "10"], "--cluster"),
    ],
)
def test_bad_input_is_one_line(arguments: list[str], said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("asc_rt.synthesis.cluster.CONNECT_TIMEOUT_S", 0.2)
    with pytest.raises((Refused, ConfigError)) as caught:
        run(*arguments)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
