"""What has to be understood whole fits on one screen, and the house stays made of small rooms."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SCREEN = 50
LONGEST_FILE = 400
LONGEST_FUNCTION = 60
SOURCES = [
    path
    for folder in ("asc_rt", "calibration", "drivers", "logs", "sim_hil")
    for path in sorted((ROOT / folder).rglob("*.py"))
    if not path.name.endswith("_pb2.py")
]


def functions(path: Path) -> Iterator[tuple[str, int]]:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            assert node.end_lineno is not None
            yield node.name, node.end_lineno - node.lineno + 1


@pytest.mark.parametrize(("file", "function"), [("asc_rt/cycle.py", "run"), ("asc_rt/core/step.py", "step")])
def test_the_loop_and_the_decision_fit_on_one_screen(file: str, function: str) -> None:
    assert dict(functions(ROOT / file))[function] <= SCREEN


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_files_and_functions_are_short(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= LONGEST_FILE
    assert [name for name, length in functions(path) if length > LONGEST_FUNCTION] == []
