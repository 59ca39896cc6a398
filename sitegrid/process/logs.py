"""Logs on standard error: one line per event, key=value for people on a terminal, JSON for machines elsewhere."""

from __future__ import annotations

import json
import logging
import math
import re
import sys
from datetime import UTC, datetime
from typing import Any

# A message is logged as `log.warning("refused machine=%s reason=%s", machine, reason)`: an event, and its values.
_VALUE = re.compile(r"(?:^| )(\w+)=%[^a-zA-Z%]*[a-zA-Z]")


def start_logging(*, verbose: bool) -> None:
    """Log warnings and status to standard error; with `verbose` also what happens."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(TextFormatter() if sys.stderr.isatty() else JsonFormatter())
    logging.basicConfig(level=logging.INFO if verbose else logging.WARNING, handlers=[handler])
    logging.getLogger("sitegrid.status").setLevel(logging.INFO)  # what a process says of itself is never too much


class TextFormatter(logging.Formatter):
    """`2026-01-31T07:00:00.000Z level=WARNING logger=mapserver.ingest.writer refused machine=loader-1 reason=gap`."""

    def format(self, record: logging.LogRecord) -> str:
        """One line; a traceback follows it, for people."""
        message = record.getMessage().replace("\r", "\\r").replace("\n", "\\n")
        line = f"{_time(record)} level={record.levelname} logger={record.name} {message}"
        return line + (f"\n{self.formatException(record.exc_info)}" if record.exc_info else "")


class JsonFormatter(logging.Formatter):
    """One JSON object in a line: t, level, logger, event, the values of the event, and the traceback of a bug."""

    def format(self, record: logging.LogRecord) -> str:
        """One line, whatever the message holds."""
        event, values = _parts(record)
        table = {"t": _time(record), "level": record.levelname, "logger": record.name, "event": event}
        table |= {name: value for name, value in values.items() if name not in table}
        if record.exc_info:
            table["traceback"] = self.formatException(record.exc_info)
        return json.dumps(table, allow_nan=False)


def _parts(record: logging.LogRecord) -> tuple[str, dict[str, Any]]:
    """The event and its values; where a message is not of that form, it is the event as a whole."""
    template, given = str(record.msg), record.args
    matches = list(_VALUE.finditer(template))
    if not matches or not isinstance(given, tuple) or not len(matches) == len(given) == template.count("%"):
        return record.getMessage(), {}
    names = [match[1] for match in matches]
    return template[: matches[0].start()].strip(), {name: _plain(v) for name, v in zip(names, given, strict=True)}


def _plain(value: Any) -> Any:
    """As JSON has it; anything else as text."""
    is_plain = value is None or isinstance(value, bool | int | str)
    return value if is_plain or (isinstance(value, float) and math.isfinite(value)) else str(value)


def _time(record: logging.LogRecord) -> str:
    return datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
