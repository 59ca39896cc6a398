"""A PostgreSQL journal is folded like a store, even while in use."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path

import pytest

from mapserver.ingest.store import Store
from mapserver.journal.location import JournalLocation
from protocol.site.site_config import site_toml
from sitegrid.cli import main
from tests.postgres_server import Database
from tests.unit.mapserver.data import CONFIG, SITE, incoming, now_ns, random_samples, same


@pytest.mark.slow
def test_a_journal_in_postgresql_gives_the_store_that_its_copy_in_sqlite_gives(
    tmp_path: Path, database: Database, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "site.toml").write_text(site_toml(SITE))
    batches = [
        incoming(random_samples(50, 50 * k + m), 1 + 50 * k, machine)
        for k in range(4)
        for m, machine in enumerate("ab")
    ]
    summaries, grids = [], []
    for name, url in (("sqlite", ""), ("postgres", database.url)):
        location = JournalLocation(tmp_path / name, url)
        with closing(Store(location, SITE, CONFIG, now_ns)) as store:
            store.commit(batches)
            out = tmp_path / f"{name}-folded"
            words = ["fold", url or str(tmp_path / name), "--out", str(out), "--site-file", str(tmp_path / "site.toml")]
            assert main([*words, "--json"]) == 0, "while it is written"
            assert store.identity.id in json.loads(capsys.readouterr().out.splitlines()[-1])["descends"]
        with closing(Store(JournalLocation(out), SITE, CONFIG, now_ns)) as folded:
            grids.append(folded.grid)
            summaries.append(
                (folded.journal.samples, {key: mark.seq for key, mark in folded.journal.watermarks().items()})
            )
            answer = folded.commit([incoming(random_samples(5, 1), 201, "a")])[0]
            assert answer.watermark == 205, "machines go on with it"
    assert same(*grids)
    assert summaries[0] == summaries[1]
    assert summaries[0][0] == 400
