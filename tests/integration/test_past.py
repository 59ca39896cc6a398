"""Checkpoints of real servers: killed while writing, queried after a distrust."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from mapserver.config import ServerConfig
from mapserver.evidence.grid import Grid
from mapserver.journal.location import JOURNAL_FILE
from mapserver.journal.rows import Admission
from mapserver.journal.sqlite.journal import SqliteJournal
from mapserver.query.views import read_cells, view_of
from protocol.arrays import Table
from protocol.config import toml_lines
from protocol.site.geometry import Bounds
from protocol.site.site_config import SiteConfig
from protocol.units import HOUR_NS
from protocol.wire.messages import SampleBatch
from protocol.wire.session import free_endpoint
from sitegrid import connect
from sitegrid.client import Client
from sitegrid.process.children import Child
from tests.integration.forks import Forks
from tests.integration.site_run import kill
from tests.patience import PATIENCE_S, until
from tests.site_work import BATCH, START_NS, batches, samples_of

SITE, CONFIG = SiteConfig("pit", 48.0, 11.0), ServerConfig()
HOURS = 2.2
AREA = Bounds(200.0, 200.0, 300.0, 300.0)  # around a crossing
LAYERS = ("resistance", "weight", "visits", "machines")
BAD = "loader-3"
Sent = list[tuple[str, Table]]


def filled_journal(folder: Path) -> Sent:
    """Two hours of ten machines, the last 15 minutes of each received last."""
    sent = list(islice(batches(), samples_of(HOURS) // BATCH))
    late = [i for i, (_, rows) in enumerate(sent) if 0.5 < (rows["stamp_ns"][0] - START_NS) / HOUR_NS % 1 < 0.75]
    sent = [each for i, each in enumerate(sent) if i not in set(late)] + [sent[i] for i in late]
    folder.mkdir()
    journal, numbers = SqliteJournal(folder / JOURNAL_FILE, SITE.name, SITE.frame), Counter[str]()
    journal.begin()
    for name, rows in sent:
        batch = SampleBatch(name, 1, numbers[name] + 1, rows, SITE.frame)
        journal.append(Admission(batch, trimmed=0, lost=0), START_NS)
        numbers[name] += len(rows)
    journal.commit()
    journal.close()
    return sent


def is_fold_from_the_start(client: Client, sent: Sent, stamp_ns: int, without: str = "") -> bool:
    """Whether a past map equals the fold of these samples."""
    grid = Grid(SITE.cell_m, CONFIG.fold)
    for name, rows in sent:
        if name != without:
            grid.fold(rows[rows["stamp_ns"] <= stamp_ns], name)
    window = SITE.geometry.window(AREA)
    expected = read_cells(view_of(grid, window, CONFIG), window, LAYERS, SITE.cell_m, CONFIG)
    region = client.region(AREA, LAYERS, as_of=stamp_ns)
    assert np.isfinite(expected["resistance"]).sum() > 1000
    return all(np.array_equal(region[name], expected[name], equal_nan=True) for name in LAYERS)


@pytest.mark.processes
@pytest.mark.nightly
def test_the_past_of_a_server_killed_in_mid_checkpoint_and_after_a_distrust(tmp_path: Path):
    sent = filled_journal(tmp_path / "store")
    (tmp_path / "site.toml").write_text("\n".join(toml_lines(asdict(SITE))))
    (tmp_path / "server.toml").write_text("[store]\narchive_after_h = 0.0\n[calibration]\nautomatic = false\n")
    folder, endpoint = tmp_path / "store" / "checkpoints", free_endpoint()
    late_ns, between_ns = START_NS + 2 * HOUR_NS + HOUR_NS // 10, START_NS + HOUR_NS + HOUR_NS // 2

    with Forks(tmp_path) as children:
        children.start("router", "router", "--listen", endpoint).expect("ready", PATIENCE_S)

        def serve() -> Child:
            files = ("--site-file", tmp_path / "site.toml", "--config", tmp_path / "server.toml")
            server = children.start("server", "server", "--endpoint", endpoint, "--store", tmp_path / "store", *files)
            server.expect("ready", PATIENCE_S)
            return server

        def made(client: Client, count: int) -> None:
            until(lambda: client.info().checkpoints.count == count, f"{count} checkpoints")

        server = serve()
        until(lambda: any(folder.glob(".*.part")), "a checkpoint in the making")
        kill(server)
        assert list(folder.glob(".*.part")), "it was killed in the midst of one"
        there = [path.name for path in folder.glob("*.checkpoint")]

        serve()
        with connect(endpoint, SITE.name) as client:
            for stamp_ns in (late_ns, between_ns):
                assert is_fold_from_the_start(client, sent, stamp_ns)
            made(client, 2)
            assert len(there) < 2
            assert not list(folder.glob(".*"))
            for stamp_ns in (late_ns, between_ns):
                assert is_fold_from_the_start(client, sent, stamp_ns)
            assert client.info().checkpoints.passed_over == 0

            assert not client.distrust(BAD, "its scale is broken").trusted
            for stamp_ns in (late_ns, between_ns):  # existing checkpoints do not apply
                assert is_fold_from_the_start(client, sent, stamp_ns, without=BAD)
            made(client, 2)  # without the machine
            for stamp_ns in (late_ns, between_ns):
                assert is_fold_from_the_start(client, sent, stamp_ns, without=BAD)
            assert client.trust(BAD, "repaired").trusted
            assert is_fold_from_the_start(client, sent, late_ns)
