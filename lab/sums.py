"""Needs of a fleet, extrapolated from one machine: `python -m lab.sums`.

Prints the Markdown tables of lab/results/sums.md. Measured figures: lab/results/speed.md, calibration.md; replace the
assumed ones by your own.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

# Measured on one constantly driving machine, and one server.
RATE, UP, DOWN = 6.52, 2583.2, 240.7  # samples/s; link up, down [B/s]
ARCHIVE, JOURNAL, POSTGRES = 45.0, 121.0, 160.6  # [B/sample]
TAKEN, FOLDED = 48_352, 0.70e6  # samples/s taken by a server, and folded by a core
ANSWERS_A_CORE = 100 / 0.23  # of followers
JOURNALS = {"SQLite": 1.0, "PostgreSQL": 0.64, "with a synchronous replica": 0.59}  # relative throughput
# Assumed.
DRIVES, HOURS, DAYS = 0.4, 10, 300  # share of a working day driven, hours a day, days a year
HEADROOM, ROUTED = 0.5, 500  # usable share of a server's capacity; machines per router
HOST, DISK, SIM_CARD, TRAFFIC = 50, 0.10, 5, 1.0  # EUR per month, per GB and month (stored twice), per month, per GB

FLEETS, SITES, READERS = (10, 1000, 100_000), (10, 500), (100, 1000, 10_000)
GB, KBIT, MONTHS = 1e9, 1000 / 8, 12
TAKE_OVER_HOSTS = 4  # two servers, a database and its replica; without take-over one


@dataclass(frozen=True)
class Needs:
    """Needs of all machines by site size, per year; costs in EUR."""

    machines: int
    per_site: int

    @property
    def sites(self) -> int:
        """Sites, one map server each."""
        return math.ceil(self.machines / self.per_site)

    @property
    def on_site(self) -> int:
        """Machines per site."""
        return min(self.machines, self.per_site)

    @property
    def samples(self) -> float:
        """Samples of all machines."""
        return self.machines * RATE * self.driven_s

    @property
    def driven_s(self) -> float:
        """Driving time of a machine [s]."""
        return HOURS * 3600 * DAYS * DRIVES

    @property
    def traffic_gb(self) -> float:
        """Traffic of a machine."""
        return (UP + DOWN) * self.driven_s / GB

    def eur(self, hosts: int, disk_gb: float) -> float:
        """Cost of hosts, of disks that fill over the year, and of links."""
        links = self.machines * (MONTHS * SIM_CARD + TRAFFIC * self.traffic_gb)
        return hosts * self.sites * MONTHS * HOST + DISK * MONTHS / 2 * disk_gb + links

    def lines(self) -> Iterator[tuple[str, str]]:
        """Rows of the sites table."""
        archive, postgres = self.samples * ARCHIVE / GB, 2 * self.samples * POSTGRES / GB
        fold_h = self.samples / FOLDED / 3600
        eur, take_over_eur = self.eur(1, archive), self.eur(TAKE_OVER_HOSTS, postgres / 2)
        monthly = "; ".join(f"{cost / MONTHS / self.machines:.2f} EUR" for cost in (eur, take_over_eur))
        yield "sites = map servers", _number(self.sites)
        yield "routers", _number(self.sites * math.ceil(self.on_site / ROUTED))
        yield "hosts; with take-over", f"{_number(self.sites)}; {_number(TAKE_OVER_HOSTS * self.sites)}"
        yield "samples a second of one site, all driving", _number(self.on_site * RATE)
        yield "of what its server takes", f"{self.on_site * RATE / TAKEN * 100:.1f} %"
        yield "link of a site's router, up, all driving", f"{_number(self.on_site * UP / KBIT)} kbit/s"
        yield "traffic a year", _bytes(self.traffic_gb * self.machines)
        yield "all journals in SQLite, a day's rows", _bytes(self.samples / DAYS * JOURNAL / GB)
        yield "archives, a year", _bytes(archive)
        yield "instead in PostgreSQL with its replica, a year", _bytes(postgres)
        yield "a year folded again, one core", f"{fold_h:.3g} h" if fold_h < 1000 else f"{_number(fold_h)} h"
        yield "cost a year; with take-over", f"{_number(eur)} EUR; {_number(take_over_eur)} EUR"
        yield "of that, a machine and month", monthly


def carried(share: float) -> int:
    """Constantly driving machines at HEADROOM of one writer; share: its journal's relative speed."""
    return int(HEADROOM * TAKEN * share / RATE)


def tables() -> list[str]:
    """Readers, one writer, and a table per site size."""
    readers = [(_number(n), _number(math.ceil(n / ANSWERS_A_CORE))) for n in READERS]
    writers = [(name, _number(TAKEN * share), _number(carried(share))) for name, share in JOURNALS.items()]
    head = ("journal", "one writer takes, samples a second", "machines that all drive are half of that")
    return [
        _table((f"answers a second ({ANSWERS_A_CORE:.0f} a core)", "followers"), readers),
        _table(head, writers),
        *(_sites(per_site) for per_site in SITES),
    ]


def _sites(per_site: int) -> str:
    fleets = [dict(Needs(machines, per_site).lines()) for machines in FLEETS]
    heading = (f"machines, at most {per_site} on a site", *map(_number, FLEETS))
    return _table(heading, [(what, *(fleet[what] for fleet in fleets)) for what in fleets[0]])


def _table(heading: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [heading, ["---"] * len(heading), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _number(value: float) -> str:
    return f"{value:,.0f}".replace(",", " ")


def _bytes(gb: float) -> str:
    if gb >= 100_000:
        return f"{_number(gb / 1000)} TB"
    return f"{gb / 1000:.3g} TB" if gb >= 1000 else f"{gb:.3g} GB"


if __name__ == "__main__":
    print("\n\n".join(tables()))
