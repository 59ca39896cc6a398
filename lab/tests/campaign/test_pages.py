import json
from pathlib import Path

import pytest

from lab.campaign.pages import filled, main
from protocol.errors import ConfigError

RESULTS = Path(__file__).parents[2] / "results"
MADE = {"command": "sitegrid eval roads --json", "commit": "1234abcd", "date": "2026-11-23", "processor_min": 61.5}
REPORT = {
    "made": MADE,
    "seeds": [1000, 1001],
    "rows": [
        {"case": "haul_road", "tau": 0.912345678, "km": 12.0, "kept": None, "by_seed": [{"tau": 0.9}, {"tau": 0.93}]},
        {"case": "repairs", "seen": 88.0, "by_seed": [{"looks": 3}, {"looks": 4}]},
    ],
    "ways": [{"case": "way_even", "maps": 50}],
    "maps": [
        {"machines": 1, "merge": None, "net": 1.25, "ci95": {"net": 0.5}, "paper": {"net": 2.0}, "met": True},
        {"machines": 4, "merge": "mean", "net": None, "ci95": {"net": 0.5}, "paper": None, "met": False},
    ],
    "goals": [
        {"row": "haul_road", "name": "tau", "goal": ">= 0.85", "value": 0.912345678, "met": True},
        {"row": "repairs", "name": "seen", "goal": ">= 90", "value": 88.0, "met": False},
    ],
}


def page(table: str, content: str = "old\n") -> str:
    return f"Before\n<!-- table: roads.json {table} -->\n{content}<!-- end -->\nbehind\n"


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "roads.json").write_text(json.dumps(REPORT))
    return tmp_path


def test_goals_stand_with_what_each_seed_gave_and_misses_in_bold(folder):
    assert filled(page("goals"), folder).splitlines() == [
        "Before",
        "<!-- table: roads.json goals -->",
        "| row | figure | goal | measured | seeds 1000, 1001 |",
        "| --- | --- | --- | --- | --- |",
        "| haul_road | `tau` | >= 0.85 | 0.91235 | 0.9, 0.93 |",
        "| repairs | `seen` | >= 90 | **88** |  |",
        "<!-- end -->",
        "behind",
    ]


def test_a_report_says_where_it_comes_from(folder):
    assert filled(page("made"), folder).splitlines()[2:5] == [
        "| command | commit | date | seeds | minutes of processor time, of what was not kept |",
        "| --- | --- | --- | --- | --- |",
        "| `sitegrid eval roads --json` | 1234abcd | 2026-11-23 | 1000, 1001 | 61.5 |",
    ]
    (folder / "roads.json").write_text(json.dumps({**REPORT, "seeds": [3, 4, 5]}))
    assert "| 2026-11-23 | 3 to 5 |" in filled(page("made"), folder)


def test_a_page_chooses_rows_and_columns(folder):
    lines = filled(page("maps machines=1 merge=-: net paper.net"), folder).splitlines()
    assert lines[2:6] == ["| `net` | `paper.net` |", "| --- | --- |", "| 1.25 +- 0.5 | 2 |", "<!-- end -->"]
    assert "|  |  |" in filled(page("maps machines=4: net paper.net"), folder)


@pytest.mark.parametrize(
    ("table", "problem"),
    [("maps machines=2", "no row with machines=2"), ("maps: nett", "rows without the column `nett`")],
)
def test_rows_and_columns_that_are_not_there_are_named(folder, table: str, problem: str):
    with pytest.raises(ConfigError, match=problem):
        filled(page(table), folder)


def test_a_page_is_written_only_where_it_is_another_one(folder, capsys):
    path = folder / "roads.md"
    path.write_text(page("goals"))
    main([str(path)])
    assert "made again" in capsys.readouterr().out
    main([str(path)])
    assert capsys.readouterr().out == ""
    assert "0.91235" in path.read_text()


@pytest.mark.parametrize("path", sorted(RESULTS.glob("*.md")), ids=lambda path: path.name)
def test_pages_have_the_figures_of_their_reports(path):
    """If not: run `python -m lab.campaign.pages` on the page."""
    assert filled(path.read_text(), path.parent) == path.read_text()
