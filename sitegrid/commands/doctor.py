"""`sitegrid doctor`: check this host's part of a site; a line per problem, with advice."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from dataclasses import asdict
from pathlib import Path

from sitegrid.doctor import Finding, Level
from sitegrid.options.groups import add_network
from sitegrid.process.lifetime import say, tell

HELP = "check the set-up of this host and say how to repair it"
EXTRA = "server"  # for --store only


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    folder = "folder of `sitegrid init`: its files, ports, place and data are checked, and nothing else"
    parser.add_argument("folder", type=Path, nargs="?", metavar="FOLDER", help=folder)
    add_network(parser)
    parser.add_argument("--site", help="name of the site (default: that of the site file or the keys, else paper)")
    parser.add_argument("--site-file", type=Path, help="site file, to compare with the map server's (site.toml)")
    parser.add_argument("--machine", help="name of the machine (default: that of the keys)")
    parser.add_argument("--spool", type=Path, help="file of an agent's spool")
    parser.add_argument("--store", type=Path, help="folder of a map server's store")
    parser.add_argument("--journal", metavar="URL", default="", help="PostgreSQL database with that server's journal")


def run(arguments: Namespace) -> int:
    """Run the checks; 1 if anything fails."""
    findings = _findings(arguments)
    ok = all(finding.level != Level.FAIL for finding in findings)
    table = {"ok": ok, "findings": [asdict(finding) for finding in findings]}
    say(table) if arguments.json else tell(*findings)
    return 0 if ok else 1


def _findings(arguments: Namespace) -> list[Finding]:
    if arguments.folder:
        from sitegrid.doctor.folder import examine_folder

        return examine_folder(arguments.folder)
    from sitegrid.doctor.examine import examine

    return examine(arguments)
