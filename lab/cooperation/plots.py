"""Pictures of cooperation: what is known over time by number of machines and by link, and how good maps become."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from lab.campaign import pictures
from lab.campaign.experiment import Runner
from lab.campaign.pictures import BLUE, GREEN, ORANGE, VERMILION, head
from lab.cooperation.network import SHARE_PCT
from lab.cooperation.scores import CENTRAL
from sitegrid.proof.figures import Report, Row

MACHINES = {"one": VERMILION, "two": ORANGE, "four": BLUE, "eight": GREEN}
LINKS = {CENTRAL: GREEN, "four": BLUE, "slow": ORANGE, "lost": VERMILION}
TITLES = {CENTRAL: "one process, perfect link", "four": "link always there", "slow": "300 kbit/s",
          "lost": "lost one minute in five", "mixed": "loaders and dump trucks"}  # fmt: skip
MINUTES, COVERED = "minutes of site time", "network known and right [%]"


def draw(report: Report, _: object, __: Runner, folder: Path) -> list[Path]:
    """Draw all pictures of a report into a folder; returns their paths."""
    rows = {row["arm"]: row for row in report["rows"]}
    drawn: dict[str, Callable[[], Figure]] = {"links": partial(draw_links, _some(rows, LINKS))}
    if several := _some(rows, MACHINES):
        drawn["machines"] = partial(draw_machines, several, report["rounds"])
    return pictures.draw_all(drawn, folder)


def _some(rows: dict[str, Row], names: dict[str, str]) -> list[Row]:
    return [rows[name] for name in names if name in rows]


def draw_machines(rows: Sequence[Row], rounds: Sequence[Row]) -> Figure:
    """What is known over time by number of machines, and errors of the map after each round."""
    figure, (known, slope, resistance) = plt.subplots(1, 3, figsize=(pictures.WIDTH_IN, 3.6), width_ratios=(2, 1, 1))
    for row in rows:
        colour = MACHINES[row["arm"]]
        label = f"{row['machines']} machine{'s' * (row['machines'] > 1)}"
        _covered(known, row, "covered_pct", colour, label, "-")
        _covered(known, row, "arrived_covered_pct", colour, "", ":")
        own = [each for each in rounds if each["arm"] == row["arm"]]
        for axes, name in ((slope, "grade_pct"), (resistance, "c_rr_pct")):
            axes.plot([each["rounds"] for each in own], [each[name] for each in own], "o-", ms=3, color=colour)
    _frame(known, "by stamps (lines) and as it arrived (dots)")
    for axes, title, unit in (
        (slope, "gradient along the way", "root mean square error [% grade]"),
        (resistance, "rolling resistance", "relative root mean square error [%]"),
    ):
        head(axes, title)
        axes.set(xlabel="rounds of every machine", ylabel=unit, ylim=(0, None))
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    return figure


def draw_links(rows: Sequence[Row]) -> Figure:
    """What is known over time by what links are like, as it arrived; and the same by stamps."""
    figure, axes = plt.subplots(1, 2, figsize=(pictures.WIDTH_IN, 3.6), sharey=True)
    for panel, name, title in zip(
        axes, ("arrived_covered_pct", "covered_pct"), ("as it arrived", "by stamps of samples"), strict=True
    ):
        for row in rows:
            title_of = TITLES[row["arm"]]
            _covered(panel, row, name, LINKS[row["arm"]], title_of, "--" if row["arm"] == CENTRAL else "-")
        _frame(panel, title)
    return figure


def _covered(axes: Axes, row: Row, name: str, colour: str, label: str, style: str) -> None:
    steps = row["over_time"]
    times = [0.0, *(step["minutes"] for step in steps)]
    axes.plot(times, [0.0, *(step[name] for step in steps)], style, color=colour, label=label)


def _frame(axes: Axes, title: str) -> None:
    head(axes, title)
    axes.axhline(SHARE_PCT, color="0.6", lw=0.8)
    axes.set(xlabel=MINUTES, ylabel=COVERED, ylim=(0, 102), xlim=(0, None))
    axes.legend(loc="lower right")
