"""`python -m lab bench`: a public map benchmark (lab/benchmark/README.md)."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from lab.campaign.command import add_processes, show
from sitegrid.options.groups import add_action
from sitegrid.options.values import FOLDER
from sitegrid.process.lifetime import raise_interrupts, tell
from sitegrid.process.progress import Display
from sitegrid.proof.figures import Report

HELP = "make the recordings of a benchmark of maps, and score entries"
EXTRA = "lab"


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    what = parser.add_subparsers(metavar="WHAT", required=True, dest="what")
    make = add_action(what, "make", "make the recordings, or go on with them")
    score = add_action(what, "score", "score baselines and entries on the recordings")
    entries = "folder of an entry: a map or samples for each recording, NAME.csv"
    score.add_argument("entries", type=Path, nargs="*", metavar="ENTRY", help=entries)
    for action in (make, score):
        action.add_argument("--data", type=FOLDER, default="bench-data", help="folder (default %(default)s)")
        quick = "two short recordings in place of 24, to see that all works"
        action.add_argument("--quick", action="store_true", help=quick)
        add_processes(action)


def run(arguments: Namespace) -> int:
    """Make recordings or score entries."""
    from lab.benchmark import recordings, scores
    from lab.campaign.experiment import Runner
    from lab.campaign.workers import cores

    raise_interrupts()  # the progress bar hides the cursor
    edition, processes = recordings.QUICK if arguments.quick else recordings.FULL, arguments.processes or cores()
    title = {"make": "fleets drive, agents make samples", "score": "maps are compared with the truth"}[arguments.what]
    kept = arguments.data if arguments.what == "make" else None
    with Display(title, headless=arguments.json, kept=kept) as display:
        if arguments.what == "make":
            rows = recordings.make(Runner(arguments.data, processes, display.show), edition)
            report: Report = {"edition": recordings.edition_key(edition), "rows": rows}
        else:
            report = scores.run(arguments.data, edition, arguments.entries, processes, display.show)
    show(arguments, report, _readable)
    others = [row["name"] for row in report["rows"] if row.get("published") is False]
    if others and not arguments.json:
        tell(f"not as published: {', '.join(others)}; lab/benchmark/README.md says when that is so")
    return 0


def _readable(report: Report) -> Report:
    """Rows without wide columns."""
    from lab.benchmark import recordings

    hidden = {"by_recording", *recordings.PARTS}
    return {"rows": [{name: value for name, value in row.items() if name not in hidden} for row in report["rows"]]}
