"""`python -m tests.release`: the small store and spool of this version, which every later one has to open.

Once for each release, before its tag; it writes tests/release/VERSION/. Of each machine some samples are in the archive
and some in the journal; the last ones of the first machine wait in its spool.
"""

from __future__ import annotations

import json
import sys
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from agents.delivery.spool import Spool, SpoolConfig
from protocol.arrays import Table
from sitegrid.cli import main as sitegrid
from sitegrid.process.children import Children
from tests.release.stores import MACHINES, X_M, Y_M, served, version
from tests.unit.mapserver.data import NOW_NS, SITE, incoming, open_writer, samples, send

COUNT = 40  # of samples of each machine in each place


def main() -> None:
    """Make the folder of this version."""
    folder = Path(__file__).parent / version()
    folder.mkdir()
    with TemporaryDirectory() as place:
        site = Path(place) / "site.toml"
        site.write_text(
            f'name = "{SITE.name}"\norigin_lat_deg = {SITE.origin_lat_deg}\norigin_lon_deg = {SITE.origin_lon_deg}\n'
        )
        add(Path(place) / "old", 0)
        words = ("fold", str(Path(place) / "old"), "--out", str(folder / "store"), "--site-file", str(site))
        assert sitegrid(words) == 0
    (folder / "store" / "server.toml").write_text("[store]\narchive_after_h = 0.0\n")
    add(folder / "store", 1)
    with closing(Spool(folder / "spool.db", SpoolConfig())) as spool:
        spool.record(rows(2))
    with Children() as children, served(folder, children) as (client, _):
        client.distrust(MACHINES[1], "an example")
        values = {name: value for name, value in client.point(X_M, Y_M).values.items() if value == value}
    expected = {"merged": 2 * COUNT, "after": 3 * COUNT, "values": values}
    (folder / "expected.json").write_text(json.dumps(expected, indent=1) + "\n", encoding="utf-8")
    for cache in folder.rglob("*.checkpoint"):
        cache.unlink()


def rows(part: int) -> Table:
    """Of a machine, one part behind the other."""
    stamps = {"stamp_ns": NOW_NS + (part * COUNT + np.arange(COUNT)) * 10**9}
    return samples(COUNT, x_m=X_M, y_m=Y_M, **stamps)


def add(store: Path, part: int) -> None:
    """Samples of all machines, by the server's own writer."""
    with closing(open_writer(store)) as writer:
        for machine in MACHINES:
            send(writer, [incoming(rows(part), part * COUNT + 1, machine)])


if __name__ == "__main__":
    sys.exit(main())
