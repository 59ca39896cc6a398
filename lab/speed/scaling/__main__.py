"""Prints the tables of docs/scaling.md: `python -m lab.speed.scaling`."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from lab.speed.scaling import constants as c
from lab.speed.scaling.sums import Needs, carried, followers, needs

FLEETS = (10, 1000, 100_000)
SITES = (10, 500)
Row = Sequence[object]
LINES: tuple[tuple[str, Callable[[Needs], str]], ...] = (
    ("sites = map servers", lambda n: _number(n.servers)),
    ("routers", lambda n: _number(n.routers)),
    ("hosts; with take-over", lambda n: f"{_number(n.hosts)}; {_number(n.take_over_hosts)}"),
    ("samples a second of one site, all driving", lambda n: _number(n.samples_s)),
    ("of what its server takes", lambda n: f"{n.share * 100:.1f} %"),
    ("link of a site's router, up, all driving", lambda n: f"{_number(n.up_kbit_s)} kbit/s"),
    ("traffic a year", lambda n: _bytes(n.traffic_gb)),
    ("all journals in SQLite, a day's rows", lambda n: _bytes(n.journal_gb)),
    ("archives, a year", lambda n: _bytes(n.archive_gb)),
    ("instead in PostgreSQL with its replica, a year", lambda n: _bytes(n.postgres_gb)),
    ("a year folded again, one core", lambda n: f"{n.fold_h:.3g} h" if n.fold_h < 1000 else f"{_number(n.fold_h)} h"),
    ("cost a year; with take-over", lambda n: f"{_number(n.eur)} EUR; {_number(n.take_over_eur)} EUR"),
    ("of that, a machine and month", lambda n: f"{_monthly(n.eur, n)} EUR; {_monthly(n.take_over_eur, n)} EUR"),
)


def tables() -> list[str]:
    """Tables in Markdown: measured, assumed, one writer, and one for each size of sites."""
    measured = [
        (m.what, f"{_plain(m.value)} {m.unit}".strip(), f"[{m.page}](results/{m.page})", f"`{m.command}`")
        for m in c.MEASURED
    ]
    assumed = [(a.what, f"{a.value:g} {a.unit}".strip()) for a in c.ASSUMED]
    journals = (
        ("SQLite", 1.0),
        ("PostgreSQL", c.IN_POSTGRES.value),
        ("with a synchronous replica", c.REPLICATED.value),
    )
    writers = [(name, _number(c.TAKEN.value * share), _number(carried(share))) for name, share in journals]
    answers = c.ANSWERS.value / c.FOLLOWER_CORES.value
    readers = [(_number(n), _number(followers(n))) for n in (100, 1000, 10_000)]
    return [
        _table(("measured", "value", "page", "command"), measured),
        _table(("assumed", "value"), assumed),
        _table((f"answers a second ({answers:.0f} a core)", "followers"), readers),
        _table(("journal", "one writer takes, samples a second", "machines that all drive are half of that"), writers),
        *(_fleets(size) for size in SITES),
    ]


def _fleets(per_site: int) -> str:
    columns = [needs(machines, per_site) for machines in FLEETS]
    heading = (f"machines, at most {per_site} on a site", *(_number(n.machines) for n in columns))
    return _table(heading, [(what, *map(figure, columns)) for what, figure in LINES])


def _table(heading: Row, rows: Sequence[Row]) -> str:
    lines = [heading, ["---"] * len(heading), *rows]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)


def _number(value: float) -> str:
    return f"{value:,.0f}".replace(",", " ")


def _plain(value: float) -> str:
    return _number(value) if value >= 1000 else f"{value:g}"


def _monthly(eur: float, n: Needs) -> str:
    return f"{eur / 12 / n.machines:.2f}"


def _bytes(gb: float) -> str:
    if gb >= 100_000:
        return f"{_number(gb / 1000)} TB"
    return f"{gb / 1000:.3g} TB" if gb >= 1000 else f"{gb:.3g} GB"


if __name__ == "__main__":
    print("\n\n".join(tables()))
