"""Mishaps of all commands in process: one line on standard error, and the documented exit code.

Commands and options come from the parser, so new ones are covered. Signals and pipes:
`tests/integration/test_mishaps.py`.
"""

from __future__ import annotations

import json
import os
import socket
import sys
from argparse import Action
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from protocol.wire import session
from protocol.wire.session import SessionConfig, free_endpoint, open_session
from sim import publisher
from sitegrid import client
from sitegrid.cli import main
from sitegrid.options.values import OutputFile, OutputFolder, address
from sitegrid.process.lifetime import tell
from tests.command_lines import COMMANDS, Command

OUTPUTS = (OutputFile, OutputFolder)
WAITS_S = 0.2  # for absent things


def with_option(is_meant: Callable[[Action], bool]) -> list[Any]:
    """Commands with each selected option, as test parameters."""
    return [
        pytest.param(command, option, id=f"{command.name} {option.dest}")
        for command in COMMANDS
        for option in command.options()
        if is_meant(option)
    ]


def refused(words: Sequence[str], capsys: pytest.CaptureFixture[str]) -> str:
    """A failing command's only line."""
    capsys.readouterr()
    assert main(words) == 1, words
    errors = capsys.readouterr().err
    assert errors.endswith("\n"), words
    assert errors.count("\n") == 1, errors
    assert errors.startswith('{"error": ' if "--json" in words else "sitegrid: "), errors
    return errors


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files go away with the test; absent things are not awaited."""
    monkeypatch.chdir(tmp_path)
    settings = session._settings

    def impatient(config: SessionConfig) -> dict[str, object]:
        waits = config.mode == "client" and config.wait_s > 0
        return settings(config) | ({"connect/timeout_ms": int(WAITS_S * 1000)} if waits else {})

    monkeypatch.setattr(session, "_settings", impatient)
    monkeypatch.setitem(client.connect.__kwdefaults__, "timeout_s", WAITS_S)
    monkeypatch.setitem(publisher.run.__kwdefaults__, "wait_s", WAITS_S)


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    """A router alone."""
    endpoint = free_endpoint()
    router: Any = open_session(SessionConfig(endpoint, mode="router"))
    yield endpoint
    router.close()


def test_the_sweep_meets_commands_and_options():
    names = {command.words[0] for command in COMMANDS}
    assert {"agent", "demo", "doctor", "fold", "keys", "log", "plot", "query", "router", "server", "sim"} <= names
    assert len(with_option(_is_output)) > 15
    assert len(with_option(_is_input)) > 15


def with_all(*options: str) -> list[Any]:
    """Commands that have all of these options, as test parameters."""
    having = [c for c in COMMANDS if {*options} <= {option.dest for option in c.options()}]
    return [pytest.param(command, id=command.name) for command in having]


def _is_output(option: Action) -> bool:
    return isinstance(option.type, OUTPUTS)


def _is_input(option: Action) -> bool:
    return option.type is Path


@pytest.mark.parametrize(("command", "option"), with_option(_is_output))
def test_what_cannot_be_written_is_refused_first(command: Command, option: Action, capsys, tmp_path, monkeypatch):
    for parser in command.parsers:
        monkeypatch.setitem(parser._defaults, "run", None)
    suffix = (option.type.suffixes or ("",))[0] if isinstance(option.type, OutputFile) else ""  # type: ignore[union-attr]
    (tmp_path / "file").touch()
    (tmp_path / f"folder{suffix}").mkdir()
    bad = [f"/proc/nowhere{suffix}", f"file/below{suffix}"]
    bad += [f"folder{suffix}"] if isinstance(option.type, OutputFile) else ["file"]
    bad += ["picture.svg"] if suffix else []
    before = sorted(tmp_path.rglob("*"))
    for value in bad:
        assert value in refused(command.line({option.dest: value}), capsys)
    assert value in json.loads(refused([*command.line({option.dest: value}), "--json"], capsys))["error"]
    assert sorted(tmp_path.rglob("*")) == before, "trying leaves nothing"


@pytest.mark.slow  # many
@pytest.mark.parametrize(("command", "option"), with_option(_is_input))
def test_what_cannot_be_read_is_one_line(command: Command, option: Action, capsys, tmp_path):
    (tmp_path / "garbage").write_bytes(bytes(range(256)) * 9)
    (tmp_path / "folder").mkdir()
    _make_strange(tmp_path / "strange")
    for value in ("missing", "garbage", "folder", "strange"):
        given = {option.dest: value, "endpoint": free_endpoint(), "out": "out.png" if command.name == "plot" else "out"}
        if command.words[0] == "doctor":  # its answer is a report
            assert main(command.line(given)) == 1
            out, errors = capsys.readouterr()
            assert ("FAIL" in out, errors.count("\n")) in [(True, 0), (False, 1)]
        else:
            refused(command.line(given), capsys)


def _make_strange(folder: Path) -> None:
    """A stranger's folder: a manifest that names forbidden files, and invalid archives and stores."""
    folder.mkdir()
    manifest = (
        "[log]\nname = 'x'\n[site]\nname = 'lot'\norigin_lat_deg = 49\norigin_lon_deg = 8\n[machine]\nname = 'a'\n"
    )
    sensor = "[[sensor]]\nname = 'gps'\nkind = 'gps'\nfile = '%s'\nstd.position = 1.0\n"
    columns = "[sensor.columns]\nstamp = 't'\nlat_deg = 'a'\nlon_deg = 'b'\n"
    (folder / "log.toml").write_text(manifest + sensor % "fixes.csv" + columns)
    os.mkfifo(folder / "fixes.csv")
    os.mkfifo(folder / "a.parquet")
    for name in ("site.toml", "tokens.toml", "register.toml", "identity.toml", "journal.db", "world.wld"):
        (folder / name).write_bytes(bytes(range(256)) * 9)


@pytest.mark.parametrize("command", with_all("endpoint"))
def test_without_a_router_it_is_named(command: Command, capsys, tmp_path):
    nowhere = free_endpoint()
    given = {"endpoint": nowhere, "site_file": str(_site_file(tmp_path)), "store": "store"}
    if command.words[0] == "export":  # reads a store instead of a site
        given = {"endpoint": nowhere}
    if command.words[0] == "agent":  # drives and records without one
        assert "no [machine] is described" in refused(command.line(given | {"spool": "x.db"}), capsys)
    elif command.words[0] == "web":
        pytest.skip("waits for it: tests/integration/test_web.py")
    elif command.words[0] == "doctor":
        assert main(command.line({"endpoint": nowhere})) == 1
        assert f"nothing listens at {nowhere}" in capsys.readouterr().out
    else:
        (tmp_path / "base.toml").write_text('name = "base-1"\nsource = "tcp://127.0.0.1:1"\n')
        config = {"config": "base.toml"} if command.words[0] == "corrections" else {}
        line = refused(command.line(given | config), capsys)
        assert nowhere in line
        assert "start one with `sitegrid router`" in line
        assert ".rs" not in line, "no sources of Zenoh"


@pytest.mark.parametrize("command", with_all("endpoint", "site"))
def test_a_site_that_is_not_there_is_named(command: Command, capsys, endpoint: str):
    given = {"endpoint": endpoint, "site": "elsewhere"}
    if command.words[0] == "doctor":
        assert main(command.line(given)) == 1
        assert "the router knows of no map server" in capsys.readouterr().out
    else:
        named = "nothing-of-the-sort" if command.words[0] == "replay" else "elsewhere"  # the file is checked first
        assert named in refused(command.line(given), capsys)
    assert "elsewhere/*" in refused(command.line(given | {"site": "elsewhere/*"}), capsys)


@pytest.mark.parametrize(("command", "option"), with_option(lambda o: o.dest == "listen" or o.type is address))
def test_a_port_that_is_taken_is_named(command: Command, option: Action, capsys, tmp_path, endpoint: str):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        value = str(port) if option.type is address else f"tcp/127.0.0.1:{port}"
        given = {option.dest: value, "endpoint": endpoint, "site_file": str(_site_file(tmp_path)), "store": "store"}
        line = refused(command.line(given), capsys)
    assert str(port) in line
    assert "in use" in line
    assert ".rs" not in line


def _site_file(folder: Path) -> Path:
    path = folder / "site.toml"
    path.write_text('name = "lot"\norigin_lat_deg = 49.01\norigin_lon_deg = 8.4\n')
    return path


@pytest.mark.parametrize("command", COMMANDS, ids=lambda c: c.name)
def test_a_reader_that_leaves_is_no_error(command: Command, monkeypatch, capsys):
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as output:
        monkeypatch.setattr(sys, "stdout", output)
        with pytest.raises(SystemExit) as end:
            main([*command.words, "--help"])
        monkeypatch.undo()
    assert end.value.code == 0
    assert capsys.readouterr().err == ""


def test_an_answer_that_does_not_fit_on_the_disk_is_an_error(monkeypatch, capsys):
    monkeypatch.setattr("sitegrid.commands.fold.run", lambda _: tell("an answer") or 0)
    with Path("/dev/full").open("w") as output:
        monkeypatch.setattr(sys, "stdout", output)
        code = main(["fold", "x", "--out", "y"])
        monkeypatch.undo()
    assert code == 1
    problem = "standard output: No space left on device; not all of the answer was written"
    assert capsys.readouterr().err == f"sitegrid: {problem}\n"


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (PermissionError(13, "Denied", "a.db"), "a.db: Denied; run this as a user who may, or choose another place"),
        (OSError(28, "No space left", "x/y"), "x/y: No space left; make room, or choose another place"),
        (FileNotFoundError(2, "Not there", "z\n.csv"), "z\\n.csv: Not there"),
        (TimeoutError(), "TimeoutError"),
    ],
)
def test_errors_of_the_system_are_one_line(error: OSError, line: str, monkeypatch, capsys):
    def fail(_: object) -> int:
        raise error

    monkeypatch.setattr("sitegrid.commands.sim.run", fail)
    assert refused(["sim"], capsys) == f"sitegrid: {line}\n"
