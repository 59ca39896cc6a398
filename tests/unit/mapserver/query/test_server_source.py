from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from mapserver.journal.journal import FencedError, UnwrittenError
from mapserver.query.server_source import Commands
from protocol.errors import Refusal
from tests.unit.mapserver.data import open_writer, refused

GONE = {"store": "0123456789abcdef", "reason": "its disk died"}


@pytest.mark.parametrize(
    ("error", "reason", "problem"),
    [
        (UnwrittenError("here", "the disk is full"), Refusal.STORE, "does not count: the disk is full; make room"),
        (UnwrittenError("here", "it was cut", unsure=True), Refusal.AFTER_TIMEOUT, "not known whether .* it was cut"),
        (FencedError("here", "another one took over"), Refusal.NOT_WRITER, "is not written: another one took over"),
    ],
)
def test_an_accepted_store_that_is_not_written_is_refused_as_a_decision_is(
    tmp_path: Path, error: UnwrittenError, reason: Refusal, problem: str
) -> None:
    with closing(open_writer(tmp_path)) as writer:
        commands: Any = Commands(writer, None, dict)  # type: ignore[arg-type]

        def refuse(*_: object) -> int:
            raise error

        writer._store.journal.append_event = refuse  # type: ignore[method-assign]
        with refused(reason, problem):
            commands.obey("accept", GONE)
        assert not writer._store.accepted
