"""The README tells the truth: its commands exist with these options, its files are there, its figures of CI too."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from typer.main import get_command

from asc_rt.cli import app

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


def commands() -> list[list[str]]:
    """Every command line in the code blocks, without its comment, split at `&&`."""
    blocks = re.findall(r"^```[a-z]*\n(.*?)^```", README, re.MULTILINE | re.DOTALL)
    lines = [part for block in blocks for line in block.splitlines() for part in line.split("&&")]
    return [words for line in lines if (words := _words(line))]


def _words(line: str) -> list[str]:
    if not re.match(r"\s*(pip|uv|asc|python)\s", line):
        return []  # a figure, or output
    return shlex.split(line, comments=True)


def asc_commands() -> list[list[str]]:
    """The words after `asc`."""
    return [words[words.index("asc") + 1 :] for words in commands() if "asc" in words[:3]]


def test_the_two_commands_work_from_a_bare_machine() -> None:
    lines = [" ".join(words) for words in commands()]
    assert "pip install uv" in lines
    assert any(line.startswith("uv run asc run") for line in lines)
    assert "uv run pytest" in lines


@pytest.mark.parametrize("words", asc_commands(), ids=" ".join)
def test_every_asc_command_exists_with_its_options(words: list[str]) -> None:
    group = get_command(app)
    name, *rest = words
    command = group.commands[name]  # type: ignore[attr-defined]
    context = command.make_context(name, rest)  # UsageError: no such option, or a value that it does not take
    assert context is not None


def test_ci_runs_the_test_command_of_the_readme() -> None:
    ci = (ROOT / ".ci" / "run").read_text()
    assert "pip install uv && uv run pytest" in ci
    assert "pip install uv && uv run pytest" in README


@pytest.mark.parametrize("target", sorted(set(re.findall(r"\]\(([^)#:]+)\)", README))) or [""])
def test_every_link_to_a_file_leads_somewhere(target: str) -> None:
    assert (ROOT / target).exists()


def test_it_says_plainly_that_it_is_not_safety_rated() -> None:
    assert re.search(r"not a safety[- ](rated )?function", README, re.IGNORECASE)
