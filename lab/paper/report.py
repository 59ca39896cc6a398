"""Tables of the paper's report for people: figures with intervals, the paper's in brackets."""

from __future__ import annotations

from lab.paper.experiment import DRIVEN, PLOTTED
from sitegrid.proof.figures import Report, Row

POSITIONS = (("x [m]", "rmse_x_m"), ("y [m]", "rmse_y_m"), ("net [m]", "net_m"))
MAPS = (
    ("net [m]", "net_m"),
    ("J_r driven [%]", DRIVEN[0]),
    ("J_s driven [%]", DRIVEN[1]),
    ("known [%]", DRIVEN[2]),
    ("J_r plotted [%]", PLOTTED[0]),
    ("J_s plotted [%]", PLOTTED[1]),
)
PAPERS = {PLOTTED[0]: DRIVEN[0], PLOTTED[1]: DRIVEN[1]}  # J over all plotted cells


def readable(report: Report) -> Report:
    """The report with one table per kind of row."""
    positions, maps = ([row for row in report["rows"] if row["table"] == table] for table in ("positions", "maps"))
    tables = {
        "positions": [
            {**_sensors(row), **_cells(row, POSITIONS), "us per s": row["us_per_second"]} for row in positions
        ],
        "maps": [{**_site(row), **_sensors(row), **_made(row), **_cells(row, MAPS)} for row in maps],
    }
    return {name: value for name, value in report.items() if name != "rows"} | tables


def _sensors(row: Row) -> Row:
    return {name: row[name] for name in ("filter", "gps", "imu", "profile")}


def _site(row: Row) -> Row:
    return {name: row[name] for name in ("scenario", "preset", "machines")}


def _made(row: Row) -> Row:
    return {name: row[name] for name in ("values", "calibration", "merge")}


def _cells(row: Row, columns: tuple[tuple[str, str], ...]) -> Row:
    return {title: _cell(row, name) for title, name in columns}


def _cell(row: Row, name: str) -> str:
    """Mean, interval half-width, and the paper's comparable figure."""
    if row[name] is None or row[name] != row[name]:
        return "-"
    half = row["ci95"].get(name)
    published = row["paper"] and row["paper"].get(PAPERS.get(name, "" if name in DRIVEN else name))
    return f"{row[name]:.2f}" + (f" +- {half:.2f}" if half else "") + (f" ({published:g})" if published else "")
