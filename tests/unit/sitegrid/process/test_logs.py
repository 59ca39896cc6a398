"""One line per event, that whoever reads standard error can read."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Callable
from typing import Any

import pytest

from sitegrid.process.logs import JsonFormatter, TextFormatter, start_logging


def record(message: str, *values: object, error: bool = False) -> logging.LogRecord:
    try:
        raise ValueError('no "good"\nat all')
    except ValueError:
        info = sys.exc_info() if error else None
    made = logging.LogRecord("mapserver", logging.WARNING, __file__, 1, message, values, info)
    made.created = 1767225600.5
    return made


def as_json(*given: Any, **options: Any) -> dict[str, Any]:
    line = JsonFormatter().format(record(*given, **options))
    assert "\n" not in line
    return json.loads(line)


def test_json_holds_the_event_and_its_values():
    line = as_json("refused machine=%s reason=%s seq=%d problem=%r", "loader-1", "gap", 7, 'say "lost"\nnow')
    head = {"t": "2026-01-01T00:00:00.500Z", "level": "WARNING", "logger": "mapserver", "event": "refused"}
    assert line == {**head, "machine": "loader-1", "reason": "gap", "seq": 7, "problem": 'say "lost"\nnow'}


@pytest.mark.parametrize(
    ("given", "event"),
    [
        (('a "quoted"\nmessage',), 'a "quoted"\nmessage'),
        (("%s of %d", "three", 4), "three of 4"),
        (("half=%s done %d %%", "x", 4), "half=x done 4 %"),
    ],
)
def test_what_is_not_key_and_value_is_the_event_as_it_is(given: tuple[Any, ...], event: str):
    assert as_json(*given)["event"] == event


def test_a_traceback_stays_in_the_line_of_json_and_follows_for_people():
    assert as_json("failed work=%s", "fold", error=True)["traceback"].endswith('ValueError: no "good"\nat all')
    lines = TextFormatter().format(record("failed work=%s", "fold", error=True)).splitlines()
    assert lines[0].endswith("failed work=fold")
    assert lines[1].startswith("Traceback")


@pytest.mark.parametrize(("terminal", "read"), [(True, lambda s: "event one=1" in s), (False, json.loads)])
def test_a_terminal_decides(terminal: bool, read: Callable[[str], Any], monkeypatch, capsys):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    root = logging.getLogger()
    monkeypatch.setattr(root, "handlers", [])
    monkeypatch.setattr(root, "level", root.level)
    start_logging(verbose=True)
    logging.getLogger("sitegrid.test").info("event one=%d", 1)
    assert read(capsys.readouterr().err)
