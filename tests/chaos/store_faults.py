"""Conflicts of stores and times: a second map server, stamps and clocks off by years."""

from __future__ import annotations

import sqlite3
import time
from contextlib import closing

from mapserver.journal.location import JOURNAL_FILE
from mapserver.journal.sqlite.reader import SqliteReader
from tests.chaos import stepped_clock
from tests.chaos.chaos_site import HOUR_S, ROUTER, SECOND, SERVER, ChaosSite
from tests.chaos.outcome import FaultOutcome
from tests.chaos.scenario import FaultRun
from tests.tcp_proxy import FAIR, Proxy, Weather

YEAR_S = 365 * 24 * HOUR_S
DAY_NS = 24 * HOUR_S * 10**9
ALONE_S = 4.0  # of a second server
WRONG_S = 3.0  # of a clock
RUNS = "a map server runs already"
OTHER_WRITES, TAKEN_OVER = "another map server writes", "another map server takes over"


def second_server(scenario: FaultRun) -> FaultOutcome:
    """A second map server with another store: beside the first, without it, and with --take-over.

    The second one must refuse runs that are bound to the first store.
    """
    with scenario.site() as site, Proxy(int(site.endpoints[ROUTER].rpartition(":")[2])) as of_server:
        site.endpoints[SERVER] = of_server.endpoint
        site.start_all()
        _bind(site)
        with site.fault():
            _is_refused(site)
            of_server.set(Weather(cut=True))
            site.start(SECOND)
            site.wait_ready(SECOND)
            scenario.console.wait(ALONE_S)
            of_server.set(FAIR)
            _has_ended(site, SERVER, OTHER_WRITES)
            site.stop(SECOND)
            _start_again(site)
        _bind(site)
        with site.fault():
            site.options[SECOND] = ("--take-over",)
            site.start(SECOND)
            _has_ended(site, SERVER, TAKEN_OVER)
            site.wait_ready(SECOND)
            scenario.console.wait(ALONE_S / 2)
            site.options[SERVER] = ("--take-over",)
            site.start(SERVER)
            _has_ended(site, SECOND, TAKEN_OVER)
            site.wait_ready(SERVER)
        with SqliteReader(site.folder / SECOND / JOURNAL_FILE) as reader:
            if taken := reader.last_row:
                site.problem(f"the second store took {taken} batches of runs that are bound to the first")
        return site.finish(scenario.fault, 3)


def _bind(site: ChaosSite) -> None:
    """Wait until the first store acknowledged samples of every current run."""
    site.wait_runs()
    site.console.wait(1.0)  # acknowledgements arrive; an ending drive is not followed by another


def _is_refused(site: ChaosSite) -> None:
    code, words = site.expect_end(SECOND)
    if code != 1 or RUNS not in words:
        site.problem(f"a second server beside the first: exit code {code}, {words!r}")


def _has_ended(site: ChaosSite, role: str, words: str) -> None:
    code, last = site.wait_end(role)
    if code != 1 or words not in last:
        site.problem(f"{role} should have ended since {words}: exit code {code}, {last!r}")


def _start_again(site: ChaosSite) -> None:
    site.start(SERVER)
    site.wait_ready(SERVER)


def far_future(scenario: FaultRun) -> FaultOutcome:
    """One machine stamps the year 2099, and the server's clock is years behind, then restarted.

    Only that machine's samples are quarantined and declared; the site's now stays.
    """
    with scenario.site() as site:
        machine = site.machines[0]
        clocks = {role: site.folder / f"clock-{role}" for role in (machine, SERVER)}
        for role, path in clocks.items():
            stepped_clock.write(path, 0)
            site.modules[role] = ("-m", "tests.chaos.stepped_clock", str(path))
        site.start_all()
        for role, years, is_killed in ((machine, 73, False), (SERVER, -10, False), (SERVER, -10, True)):
            with site.fault():  # machines may wait meanwhile
                stepped_clock.write(clocks[role], years * YEAR_S * 10**9)
                if is_killed:
                    site.kill(SERVER)
                    site.wait_ready(SERVER)
                site.linger(WRONG_S)
                stepped_clock.write(clocks[role], 0)
            site.linger(1.0)
        outcome = site.finish(scenario.fault, 3)
        with SqliteReader(site.folder / "store" / JOURNAL_FILE) as reader:
            newest_ns = max(mark.newest_ns for mark in reader.watermarks().values())
        if newest_ns > time.time_ns() + DAY_NS:
            site.problem(f"the journal holds a stamp {(newest_ns - time.time_ns()) / DAY_NS:.0f} days ahead")
        quarantined = {name: _quarantined(site, name) for name in site.machines}
        outcome.notes["quarantined"] = sum(quarantined.values())
        if not quarantined.pop(machine):
            site.problem(f"no sample of {machine} was from the future: nothing was tried")
        if any(quarantined.values()):
            site.problem(f"samples of machines with right clocks are quarantined: {quarantined}")
        return outcome


def _quarantined(site: ChaosSite, machine: str) -> int:
    with closing(sqlite3.connect(site.folder / "spool" / f"{machine}.db")) as db:
        return int(db.execute("SELECT COUNT(*) FROM quarantine").fetchone()[0])


def archive_clock(scenario: FaultRun) -> FaultOutcome:
    """The server's clock is a year ahead for a while; 40 hours after its correction all rows must be archived."""
    with scenario.site() as site:
        path = site.folder / "clock-server"
        stepped_clock.write(path, 0)
        site.modules[SERVER] = ("-m", "tests.chaos.stepped_clock", str(path))
        site.start_all()
        for off_s in (YEAR_S, 0):
            stepped_clock.write(path, off_s * 10**9)
            site.linger(WRONG_S)
        with SqliteReader(site.folder / "store" / JOURNAL_FILE) as reader:
            old = reader.last_row
        stepped_clock.write(path, 40 * HOUR_S * 10**9)
        site.kill(SERVER)  # a starting server looks for old rows
        site.wait_ready(SERVER)
        archived = 0
        with SqliteReader(site.folder / "store" / JOURNAL_FILE) as reader:
            end_s = time.monotonic() + 20.0
            while (archived := reader.archived_row) < old and time.monotonic() < end_s:
                site.linger(0.25)
        if archived < old:
            site.problem(f"rows up to {archived} are archived, those up to {old} are old enough")
        site.outcome.notes["archived"] = archived
        stepped_clock.write(path, 0)
        return site.finish(scenario.fault, 2)
