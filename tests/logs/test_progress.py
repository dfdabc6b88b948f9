"""Long work is told on stderr, a terminal or not."""

import io
import sys

import pytest

from logs import progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_file_gets_plain_lines_and_a_terminal_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "LINE_S", -1.0)  # at every step
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    assert list(progress.progress("cycles")(range(3))) == [0, 1, 2]
    assert sys.stderr.getvalue() == "0 of 3 cycles\n1 of 3 cycles\n2 of 3 cycles\n"
    monkeypatch.setattr(sys, "stderr", Terminal())
    assert list(progress.progress("cycles")(range(3))) == [0, 1, 2]
    assert "3/3" in sys.stderr.getvalue() and "\r" in sys.stderr.getvalue()


def test_short_work_says_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    assert list(progress.progress("cycles")(iter("ab"))) == ["a", "b"]
    assert sys.stderr.getvalue() == ""
