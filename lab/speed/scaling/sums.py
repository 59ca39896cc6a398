"""What a number of machines needs, as sums of what was measured of one."""

from __future__ import annotations

import math
from dataclasses import dataclass

from lab.speed.scaling import constants as c

GB, KBIT = 1e9, 1000 / 8
MONTHS = 12


@dataclass(frozen=True)
class Needs:
    """What all machines need, on sites of so many machines each.

    hosts: with a router and a map server each site has one; with take-over four: two servers, a database and its
    replica, of which the second server's has the follower. up_kbit_s: of one site's router, while all drive.
    samples_s: of one site, likewise. Disks after a year: archive, with journals in SQLite; and PostgreSQL, which keeps
    all, on two hosts. eur: a year; take_over_eur: the same with take-over.
    """

    machines: int
    sites: int
    routers: int
    servers: int
    hosts: int
    take_over_hosts: int
    samples_s: float
    share: float
    up_kbit_s: float
    traffic_gb: float
    journal_gb: float
    archive_gb: float
    postgres_gb: float
    fold_h: float
    eur: float
    take_over_eur: float


def carried(of_sqlite: float = 1.0) -> int:
    """Machines that all drive at once and are half of what one writer takes; of_sqlite: speed of its journal."""
    return int(c.HEADROOM.value * c.TAKEN.value * of_sqlite / c.RATE.value)


def followers(answers_s: float) -> int:
    """Followers that give so many answers a second: each has one core at most, since it is one interpreter."""
    return math.ceil(answers_s / (c.ANSWERS.value / c.FOLLOWER_CORES.value))


def needs(machines: int, per_site: int) -> Needs:
    """What so many machines need on sites of so many each."""
    sites = math.ceil(machines / per_site)
    on_site = min(machines, per_site)
    routers = sites * math.ceil(on_site / c.ROUTED.value)
    seconds = c.HOURS.value * 3600 * c.DAYS.value * c.DRIVES.value  # a year, driven
    samples = machines * c.RATE.value * seconds  # a year
    traffic = (c.UP.value + c.DOWN.value) * seconds / GB
    archive, postgres = samples * c.ARCHIVE.value / GB, 2 * samples * c.POSTGRES.value / GB
    disk = c.DISK.value * MONTHS / 2  # on average through the year in which it fills; twice is in the price
    links = machines * (MONTHS * c.SIM_CARD.value + c.TRAFFIC.value * traffic)
    host = MONTHS * c.HOST.value
    return Needs(
        machines=machines,
        sites=sites,
        routers=routers,
        servers=sites,
        hosts=sites,
        take_over_hosts=4 * sites,
        samples_s=on_site * c.RATE.value,
        share=on_site * c.RATE.value / c.TAKEN.value,
        up_kbit_s=on_site * c.UP.value / KBIT,
        traffic_gb=traffic * machines,
        journal_gb=samples / c.DAYS.value * c.JOURNAL.value / GB,
        archive_gb=archive,
        postgres_gb=postgres,
        fold_h=samples / c.FOLDED.value / 3600,
        eur=sites * host + disk * archive + links,
        take_over_eur=4 * sites * host + disk / 2 * postgres + links,
    )
