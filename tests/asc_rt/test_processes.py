"""The order in which the processes of a session end."""

from __future__ import annotations

from pathlib import Path

import pytest

from asc_rt.config import load_cell
from asc_rt.processes import Process, Processes, table


def test_control_ends_first_and_nobody_before_who_listens_to_it(monkeypatch: pytest.MonkeyPatch) -> None:
    processes, ended = Processes(), []
    specs = table(load_cell("fanuc-sim"), Path("ring"), Path("log"))
    processes._running = {name: Process(spec, None) for name, spec in specs.items()}  # type: ignore[arg-type]
    monkeypatch.setattr(processes, "end", ended.append)
    processes.end_all_but_logger()
    assert ended[0] == "control" and "logger" not in ended
    assert sorted(ended) == sorted(specs.keys() - {"logger"})
    assert ended.index("perception") < ended.index("camera") < ended.index("fanuc")
