"""Archives for fold tests: samples anywhere and any time, with overflowing weights."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mapserver.calibration.correction import UNCORRECTED
from mapserver.config import ServerConfig
from mapserver.evidence.fold_config import FoldConfig
from mapserver.journal.archive import write_file
from mapserver.journal.rows import ALL, JournalRow, Selection
from protocol.arrays import Table
from protocol.machine.samples import empty
from protocol.site.site_config import SiteConfig
from sitegrid.refold.parts import FilePart
from sitegrid.refold.work import STORE_FILE, Fold, code_digest

SITE = SiteConfig("pit", 48.0, 11.0)
STORE = "0123456789abcdef"
T0 = 1_767_225_600_000_000_000
S = 10**9


def samples(rng: np.random.Generator, n: int, *, days: float = 2.0, heavy: bool = False) -> Table:
    """Samples around the corner of four tiles; heavy: many at one place, 100 m each."""
    rows = empty(n)
    rows["stamp_ns"] = T0 + np.sort(rng.integers(0, int(days * 86_400 * S), n))
    for name in ("x_m", "y_m"):
        rows[name] = rng.uniform(-12, 12, n)
    std = rng.uniform(0.05, 3.4, n)
    rows["cov_xx_m2"], rows["cov_yy_m2"] = std**2, (std * rng.uniform(0.5, 1, n)) ** 2
    rows["heading_rad"], rows["distance_m"] = rng.uniform(-3, 3, n), rng.uniform(0, 2, n)
    rows["c_rr"] = np.where(rng.random(n) < 0.1, np.nan, rng.uniform(0.01, 0.3, n))
    rows["c_rr_var"][np.isnan(rows["c_rr"])] = np.nan
    rows["grade_e"], rows["grade_n"] = rng.normal(0, 0.1, (2, n))
    if heavy:
        rows["x_m"] = rows["y_m"] = 0.0
        rows["distance_m"], rows["cov_xx_m2"], rows["cov_yy_m2"], rows["heading_rad"] = 100.0, 0.01, 0.01, 0.0
    return rows


def write(folder: Path, rows: Sequence[JournalRow]) -> FilePart:
    path = write_file(folder, STORE, SITE, ((row, row.received_ns) for row in rows))
    assert path
    return FilePart(path)


def fold_in(
    folder: Path, config: FoldConfig | None = None, selection: Selection = ALL, site: SiteConfig = SITE
) -> Fold:
    """Common part of a fold's tasks in a folder."""
    folder.mkdir(exist_ok=True)
    (folder / STORE_FILE).write_text(STORE)
    return Fold(folder, STORE, site, config or ServerConfig().fold, selection, UNCORRECTED, code_digest())
