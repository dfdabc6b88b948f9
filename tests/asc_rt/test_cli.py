"""The command line: what is wrong is said in one line each on stderr, with exit code 2 and no traceback."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from asc_rt import bench, cli
from asc_rt.config import load_cell

ROOT = Path(__file__).parents[2]
COMMANDS: dict[str, Any] = get_command(cli.app).commands  # type: ignore[attr-defined]


@pytest.fixture
def asc(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Any:
    """Run a command in this process: (exit code, stdout, lines of stderr)."""

    def call(*words: str) -> tuple[int, str, list[str]]:
        monkeypatch.setattr(sys, "argv", ["asc", *words])
        monkeypatch.setattr(cli, "_limit_blas", lambda: None)
        code = cli._run()
        out, err = capsys.readouterr()
        return code, out, err.splitlines()

    return call


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help_with_an_example(name: str) -> None:
    assert f"Example: asc {name}" in COMMANDS[name].help


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["run", "fanuc-sm"], "did you mean 'fanuc-sim'"),
        (["run", "no/such.toml"], "no such cell file"),
        (["run", "--duration", "-3"], "-3 s"),
        (["run", "--duration", "nan"], "nan s"),
        (["run", "--set", "safety.d_min_m=-0.1"], "-0.1 m is out of range"),
        (["run", "--set", "safety"], "key=value"),
        (["run", "--log", "README.md"], "never overwritten"),
        (["run", "--set", "tool=ee1"], "certificates/lrmate_200id-ee1.json: missing"),
        (["run", "--set", "safety.k=2"], "safety.k = 2 is under the certified 3"),
        (["sim", "fanuc", "--port", "99999"], "port"),
        (["replay", "no-such.mcap"], "no-such.mcap"),
        (["replay", "README.md"], "README.md"),
        (["view", "no-such.mcap"], "no-such.mcap"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "says",
)
def test_bad_input_is_one_line_and_exit_code_2(asc: Any, words: list[str], says: str) -> None:
    code, out, err = asc(*words)
    assert code == 2
    assert out == ""
    assert len(err) == 1 and err[0].startswith("error: ") and says in err[0]


def test_the_cell_that_runs_without_a_name_sees() -> None:
    cell = load_cell(cli.DEFAULT_CELL)
    assert cell.simulated and cell.perception is not None
    assert cell.sim["human"]["rate_hz"] == 0, "nobody tells it where people are"


def test_every_fault_of_a_cell_is_told(asc: Any) -> None:
    code, _, err = asc("run", "--set", "safety.d_min_m=-1", "--set", "task.spede=1")
    assert code == 2
    assert len(err) == 2 and all(line.startswith("error: ") for line in err)


@pytest.mark.parametrize("words", [["nonsense"], ["sim", "toaster"], ["run", "--nonsense"], ["bench", "nothing"]])
def test_bad_usage_is_exit_code_2(asc: Any, words: list[str]) -> None:
    code, out, err = asc(*words)
    assert code == 2 and out == "" and any("Error" in line for line in err)


def test_a_bus_port_in_use_is_told_before_anything_starts(asc: Any, tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = "tcp/127.0.0.1:{1}".format(*taken.getsockname())
        log = tmp_path / "log.mcap"
        code, _, err = asc("run", "--set", f"bus.endpoint={endpoint}", "--log", str(log))
    assert code == 2
    assert len(err) == 1 and endpoint in err[0] and "in use" not in err[0].partition(";")[0]
    assert not log.exists() and not [name for name in os.listdir("/dev/shm") if str(os.getpid()) in name]


def test_doctor_names_what_it_checked_and_what_to_do(asc: Any) -> None:
    code, out, _ = asc("doctor", "--json")
    told = json.loads(out)
    assert code == (0 if told["ok"] else 1)
    assert {"processor", "priority", "memory lock", "shared memory", "cell"} <= {c["name"] for c in told["checks"]}
    assert all(check["ok"] or check["fix"] for check in told["checks"])


def test_drives_tells_what_cannot_be_served(asc: Any) -> None:
    code, _, err = asc("drives", "fanuc-sim-truth")
    assert code == 2 and "not served from here" in err[0]
    code, _, err = asc("drives", "openarm-sim", "--reset", "3", "--assign", "3")
    assert code == 2 and "one at a time" in err[0]
    code, out, _ = asc("drives", "openarm-sim", "--set", "driver.channel=nobody-serves-this", "--reset", "3", "--json")
    checks = json.loads(out.splitlines()[-1])["checks"]
    assert code == 1 and [check["name"] for check in checks if not check["ok"]] == ["robot"]
    assert checks[-1]["name"] == "robot" and checks[-1]["fix"]


def test_doctor_tells_every_fault_of_a_cell(asc: Any, tmp_path: Path) -> None:
    bad = tmp_path / "bad.toml"
    bad.write_text((ROOT / "asc_rt/cells/fanuc-sim-truth.toml").read_text().replace("d_min_m = 0.10", "d_min_m = -1"))
    code, out, _ = asc("doctor", str(bad), "--json")
    (cell,) = [check for check in json.loads(out)["checks"] if check["name"] == "cell"]
    assert code == 1 and not cell["ok"] and "-1 m" in cell["detail"]


def test_bench_measures_scenes_with_the_number_of_pairs_that_it_claims() -> None:
    params = load_cell("fanuc-sim-truth").params
    for pairs in bench.PAIRS[:2]:
        scene = bench.Scene(params, pairs)
        counts = set()
        for _ in range(30):
            state, x = scene.next()
            after, out = bench.step(scene.system, state, x)
            counts.add(out.decision.pair_count)
        assert counts == {pairs}
        assert after.mode.name == "ACTIVE" and any(abs(after.dq_cmd) > 0.01)


def test_bench_step_has_its_rows(asc: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "REPETITIONS", 20)
    code, out, _ = asc("bench", "step", "--json")
    told = json.loads(out)
    assert code == 0 and told["machine"]
    parts = [(part, n, kind) for part in ("pairs", "free", "whole") for n in (1, 10, 50) for kind in ("median", "p99")]
    assert [row["name"] for row in told["rows"]] == ["_".join(map(str, p)) for p in parts] + ["start", "start_memory"]
    assert all(row["unit"] == "us" for row in told["rows"][:18])
    assert all(row["value"] > 0 and row["ratio"] > 0 for row in told["rows"])


def test_the_control_process_refuses_a_bad_cell_in_one_line() -> None:
    command = [sys.executable, "-m", "asc_rt.control", "fanuc-sm", "--ring", "none"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1 and "did you mean 'fanuc-sim'" in done.stderr
