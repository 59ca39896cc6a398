"""New samples of a store during a recording, as wire batches with their identity."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from mapserver.journal.history import History, read_history
from mapserver.journal.location import JournalLocation
from protocol.errors import ConfigError
from protocol.wire.codec import encode_batch
from protocol.wire.messages import SampleBatch


class NewSamples:
    """Rows added to a store from now on."""

    def __init__(self, folder: Path) -> None:
        """ConfigError without a store; StoreError if unreadable."""
        self._location = JournalLocation(folder)
        if not self._location.exists():
            raise ConfigError(folder, "is no store of a map server on this host")
        with self._location.reader() as reader:
            self._row = reader.state().row

    def read(self) -> Iterator[tuple[str, bytes]]:
        """Machines and batches since the last call; StoreError."""
        with self._location.reader() as reader:
            self._row = min(self._row, reader.state().row)  # after a restore
            for rows in read_history(History(reader, self._location.archive), self._row):
                for row in rows:
                    batch = SampleBatch(row.machine, row.spool_id, row.first_seq, row.rows, reader.frame)
                    yield row.machine, encode_batch(batch)
                    self._row = row.row
