"""The command line: lazy, one-line errors, all sub-commands described."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from sitegrid import cli, command_line, commands

COMMANDS = sorted(path.stem for path in Path(commands.__path__[0]).rglob("[a-z]*.py"))


def test_help_lists_each_command_once_on_a_line_in_its_group(capsys):
    with pytest.raises(SystemExit) as end:
        cli.main(["--help"])
    assert end.value.code == 0
    text = capsys.readouterr().out
    listed = re.findall(r"^  (\w+) +\w.*$", text.partition("run a site:")[2], re.MULTILINE)
    assert listed == [command for group in commands.GROUPS.values() for command in group]
    assert sorted(listed) == COMMANDS
    assert re.findall(r"^(\w.*):$", text, re.MULTILINE)[2:] == list(commands.GROUPS)


@pytest.mark.parametrize(("set_to", "is_then"), [(None, "1"), ("3", "3")])
def test_linear_algebra_gets_one_core_unless_told_otherwise(set_to, is_then, monkeypatch):
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    if set_to:
        monkeypatch.setenv("OPENBLAS_NUM_THREADS", set_to)
    with pytest.raises(SystemExit):
        cli.main(["--help"])
    assert os.environ["OPENBLAS_NUM_THREADS"] == is_then


def test_every_command_in_the_documents_is_one_that_the_parser_takes(root: Path, monkeypatch, tmp_path: Path):
    monkeypatch.chdir(tmp_path)
    pages = [root / "README.md", *(page for top in ("docs", "examples") for page in sorted((root / top).rglob("*.md")))]
    parser, asked = command_line.build_parser(), set()
    for page in pages:
        blocks = re.findall(r"```sh\n(.*?)```", page.read_text(), re.DOTALL)
        for line in "".join(blocks).splitlines():
            for part in re.split(r"&& |[|&;>$]|\.\.\.", line):  # of what the shell does, only the commands
                if part.lstrip().startswith("sitegrid "):
                    _, *words = shlex.split(part, comments=True)
                    asked.add(words[0])
                    parser.parse_args(words)  # a usage error exits, and fails the test
    assert asked >= {
        "router",
        "server",
        "agent",
        "web",
        "sim",
        "query",
        "plot",
        "export",
        "log",
        "probe",
        "up",
        "doctor",
    }


BEYOND_BASE = {"cryptography", "cv2", "filterpy", "matplotlib", "numba", "pyarrow", "pybullet", "pyproj", "rich"}
BEYOND_BASE |= {"scipy", "agents", "mapserver", "sim", "lab"}


@pytest.mark.parametrize(
    ("imports", "needed", "not_needed"),
    [
        ("sitegrid.command_line; sitegrid.command_line.build_parser()", {"sitegrid", "zenoh"}, BEYOND_BASE),
        ("sitegrid.client, sitegrid.security.join, sitegrid.commands.router", {"sitegrid"}, {"cryptography"}),
        (
            "sitegrid.commands.agent, agents.agent, agents.config, agents.drivers.sources, agents.drivers.replay",
            {"agents", "scipy"},
            BEYOND_BASE - {"agents", "scipy"},
        ),
        ("sitegrid.logs.check, sitegrid.logs.run", {"agents", "scipy"}, BEYOND_BASE - {"agents", "scipy", "pyproj"}),
    ],
)
def test_whoever_asks_for_help_joins_with_keys_runs_an_agent_or_reads_a_log_needs_no_more_than_that(
    imports, needed, not_needed
):
    code = f"import sys, {imports}; print(*sorted(sys.modules))"
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    packages = {name.partition(".")[0] for name in output.split()}
    assert needed <= packages
    assert not packages & not_needed


@pytest.mark.parametrize(
    ("command", "words", "missing", "extras"),
    [
        ("agent", ["--spool", "x.db"], "scipy.linalg", "agent"),
        ("agent", ["--spool", "x.db"], "filterpy.kalman", "agent,paper"),
        ("log", ["run", "x", "--picture", "x.png"], "cv2", "agent,server"),
        ("server", ["--site-file", "x", "--store", "x"], "cryptography", "server,security"),
        ("sim", [], "numba", "sim"),
    ],
)
def test_a_missing_extra_is_that_of_the_command(command, words, missing, extras, monkeypatch, capsys):
    def fail(_: object) -> int:
        raise ModuleNotFoundError(f"No module named {missing!r}", name=missing)

    monkeypatch.setattr(f"sitegrid.commands.{command}.run", fail)
    assert cli.main([command, *words]) == 1
    assert f"pip install '.[{extras}]'" in capsys.readouterr().err


@pytest.mark.parametrize("missing", ["sim.nothing", "sitegrid.nothing"])
def test_a_bug_is_not_hidden(monkeypatch, missing: str):
    def fail(_: object) -> int:
        raise ModuleNotFoundError(f"No module named {missing!r}", name=missing)

    monkeypatch.setattr("sitegrid.commands.sim.run", fail)
    with pytest.raises(ModuleNotFoundError):
        cli.main(["sim"])
