"""docs/scaling.md says what follows from what was measured, and what was measured stands on its page."""

import math

import pytest

from lab.speed.scaling import constants as c
from lab.speed.scaling.__main__ import FLEETS, SITES, tables
from lab.speed.scaling.sums import carried, followers, needs
from tests.paths import DOCS


def test_page_has_the_tables_that_follow_from_the_constants():
    page = (DOCS / "scaling.md").read_text()
    assert [table.splitlines()[0] for table in tables() if table not in page] == [], "python -m lab.speed.scaling"


@pytest.mark.parametrize("figure", c.MEASURED, ids=lambda figure: figure.what)
def test_every_figure_stands_on_the_page_that_it_names_with_its_command(figure: c.Measured):
    page = (DOCS / "results" / figure.page).read_text()
    assert figure.shown in page
    program = figure.command.split(" --")[0]
    assert program in page
    digits = "".join(letter for letter in figure.shown if letter.isdigit() or letter == ".").strip(".")
    assert math.isclose(float(digits) * (1e6 if figure is c.FOLDED else 1), figure.value), "what is shown is the value"


def test_needs_grow_with_machines_and_not_with_how_they_are_cut_but_for_hosts():
    one, ten = needs(1000, 10), needs(10_000, 10)
    for name in ("sites", "routers", "hosts", "traffic_gb", "archive_gb", "postgres_gb", "fold_h", "eur"):
        assert math.isclose(10 * getattr(one, name), getattr(ten, name)), name
    large = needs(1000, 500)
    assert (large.traffic_gb, large.archive_gb) == (one.traffic_gb, one.archive_gb)
    assert large.eur < one.eur
    assert one.take_over_hosts == 4 * one.sites


def test_a_day_of_ten_machines_by_hand():
    one = needs(10, 10)
    day = 10 * c.RATE.value * 4 * 3600  # four hours of driving each
    assert math.isclose(one.journal_gb, day * c.JOURNAL.value / 1e9)
    assert math.isclose(one.archive_gb, 300 * day * c.ARCHIVE.value / 1e9)
    assert (one.sites, one.hosts, one.routers) == (1, 1, 1)
    assert math.isclose(one.eur, 12 * 50 + 10 * 12 * 5 + one.traffic_gb * 1.0 + one.archive_gb * 0.6)


def test_one_writer_carries_the_largest_site_that_the_sums_are_made_for():
    assert max(SITES) <= min(c.MACHINES.value, carried(), carried(c.REPLICATED.value))
    assert all(needs(machines, size).share < c.HEADROOM.value for machines in FLEETS for size in SITES)
    assert carried() > carried(c.IN_POSTGRES.value) > carried(c.REPLICATED.value)


def test_followers_are_as_many_as_their_cores():
    a_core = c.ANSWERS.value / c.FOLLOWER_CORES.value
    assert followers(a_core) == 1
    assert followers(a_core + 1) == 2
