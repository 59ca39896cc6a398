"""How a file of the archive is written: one line per sample, in row groups of whole batches, sealed, under its name."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from mapserver.journal.archive_file import KEY, ArchiveHeader, arrow, seal
from mapserver.journal.rows import JournalRow
from protocol.errors import StoreError
from protocol.files import sync_folder, whole_file
from protocol.machine.samples import COLUMNS, SAMPLE_DTYPE
from protocol.site.site_config import SiteConfig

HOUR_NS = 3_600_000_000_000
GROUP_SAMPLES = 50_000  # of a row group, about: a batch is never cut
TEMPORARY = "next.parquet.tmp"


def write_file(folder: Path, site: SiteConfig, rows: Iterator[JournalRow]) -> Path | None:
    """Write rows to a new file that survives a power cut once it has its name; None where there are none.

    The file is complete under a temporary name first: its own name has its last row, which is not known before.
    """
    first = next(rows, None)
    if first is None:
        return None
    temporary = folder / TEMPORARY
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with whole_file(temporary) as file:
            last_row = write_parquet(file, site, chain([first], rows))
            seal(file)
        hour = datetime.fromtimestamp(first.received_ns // HOUR_NS * 3600, UTC).strftime("%Y-%m-%dT%H")
        path = folder / f"{hour}_{first.row:06d}-{last_row:06d}.parquet"
        temporary.rename(path)
        sync_folder(folder)
    except OSError as error:
        raise StoreError(folder, f"cannot be written: {error}") from None
    finally:
        temporary.unlink(missing_ok=True)
    return path


def write_parquet(file: BinaryIO, site: SiteConfig, rows: Iterator[JournalRow]) -> int:
    """Write rows, row group by row group; returns the last one's number."""
    delta = dict.fromkeys(("seq", "row", "stamp_ns"), "DELTA_BINARY_PACKED")
    options = {
        "compression": "zstd",
        "use_dictionary": ["machine", "spool_id", "received_ns"],
        # Never a dictionary for samples: it would take every NaN for the same. Split by byte they also shrink better.
        "column_encoding": dict.fromkeys(COLUMNS, "BYTE_STREAM_SPLIT") | delta,
        "write_page_checksum": True,
        "write_page_index": True,
    }
    machines: set[str] = set()
    with arrow("parquet").ParquetWriter(file, _schema(), **options) as writer:
        for group in _groups(rows):
            writer.write_table(_table(group))
            machines |= {row.machine for row in group}
        header = ArchiveHeader(site, site.frame, site.crs, tuple(sorted(machines)))
        writer.add_key_value_metadata({KEY: json.dumps(asdict(header))})
    return group[-1].row


def _groups(rows: Iterator[JournalRow]) -> Iterator[list[JournalRow]]:
    """Batches of one row group each."""
    group: list[JournalRow] = []
    samples = 0
    for row in rows:
        group.append(row)
        samples += len(row.rows)
        if samples >= GROUP_SAMPLES:
            yield group
            group, samples = [], 0
    if group:
        yield group


def _schema() -> Any:
    pa = arrow()
    types = {"machine": pa.string(), "spool_id": pa.uint64()}
    types |= dict.fromkeys(("seq", "row", "received_ns"), pa.int64())
    types |= {name: pa.from_numpy_dtype(SAMPLE_DTYPE[name]) for name in COLUMNS}
    return pa.schema([pa.field(name, kind, nullable=False) for name, kind in types.items()])


def _table(group: list[JournalRow]) -> Any:
    """One line per sample."""
    samples = np.concatenate([row.rows for row in group])
    lengths = [len(row.rows) for row in group]
    batch = np.repeat(np.arange(len(group)), lengths)
    columns: dict[str, Any] = {
        "machine": np.array([row.machine for row in group], object)[batch],
        "spool_id": np.array([row.spool_id for row in group], np.uint64)[batch],
        "seq": np.concatenate([row.first_seq + np.arange(len(row.rows)) for row in group]),
        "row": np.array([row.row for row in group], np.int64)[batch],
        "received_ns": np.array([row.received_ns for row in group], np.int64)[batch],
    }
    columns |= {name: np.ascontiguousarray(samples[name]) for name in COLUMNS}
    return arrow().table(columns, schema=_schema())
