"""Progress: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import pytest

from sitegrid.process import progress
from sitegrid.process.progress import Display


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_terminal_gets_a_bar_and_headless_gets_lines(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    with Display("machines drive", headless=False) as display:
        display.show(5, 10, "7 samples, 3 cells")
        assert display._bar.tasks[0].completed == 5
        display.begin("agents start", "soon")
        (task,) = display._bar.tasks
        assert (task.description, task.total, task.fields["what"]) == ("agents start", None, "soon")
    with Display("machines drive", headless=True) as display:
        assert display._bar is None
        display.show(5, 10, "7 samples, 3 cells")
        display.begin("agents start", "soon")
    assert sys.stderr.getvalue().endswith("5 of 10 s, 7 samples, 3 cells\nagents start soon\n")


def test_plain_lines_come_now_and_then_only(monkeypatch, capsys):
    now = iter([100.0, 100.0, 101.0, 106.0, 106.0])
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(now))
    display = Display("machines drive", headless=True)
    for second in (1, 2, 3):
        display.show(second, 10, "recording")
    assert capsys.readouterr().err.count("recording") == 2


@pytest.mark.parametrize("kept", [None, Path("out")])
def test_who_interrupts_is_told_whether_the_command_goes_on(kept: Path | None, capsys):
    with pytest.raises(KeyboardInterrupt), Display("machines drive", headless=True, kept=kept):
        raise KeyboardInterrupt
    said = capsys.readouterr().err
    assert ("interrupted; what is done is kept in out, and the same command goes on with it" in said) == bool(kept)
