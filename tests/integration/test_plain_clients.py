"""Independent clients (`tests/clients/`) against real, killed processes: 0 lost, 0 double, by plain SQL on the journal.

The query is described in docs/operation.md.
"""

from __future__ import annotations

import ast
import math
import random
import sqlite3
import struct
import subprocess
import sys
import zlib
from collections import Counter
from contextlib import closing
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from protocol.wire.session import free_endpoint
from sitegrid import connect
from sitegrid.process.children import Child, Children
from tests.clients import plain_asker, plain_sender
from tests.paths import GOLDEN, ROOT
from tests.patience import PATIENCE_S, until

pytestmark = pytest.mark.processes

SENDER = ROOT / "tests" / "clients" / "plain_sender.py"
SITE, SAMPLES, KILLS = "lot", 1200, 5
MACHINES = ("digger-1", "digger-2")
# Unstated: no calibration, mass NaN, no lane aid, fuel NaN.
SAMPLE = struct.Struct(f"{plain_sender.ROW}fffff")
HEAD = struct.Struct("<qqQqB")


def test_the_plain_clients_know_nothing_of_this_project():
    for path in (ROOT / "tests" / "clients").glob("*.py"):
        imported = {
            (node.module if isinstance(node, ast.ImportFrom) else alias.name).partition(".")[0]
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.Import | ast.ImportFrom)
            for alias in node.names
        }
        assert imported <= {*sys.stdlib_module_names, "zenoh", "msgpack"}, path


def test_the_plain_sender_writes_a_batch_as_the_golden_file_has_it():
    golden = msgpack.unpackb((GOLDEN / "batch_older.bin").read_bytes())  # without own calibration
    run = plain_sender.Run(golden["spool_id"], 0, 0, golden.get("store", ""))
    sender = plain_sender.Sender(None, "", golden["machine"], golden["frame"], None, None)  # type: ignore[arg-type]
    columns = [struct.unpack(f"<{golden['n']}{kind}", golden["cols"][name]) for name, kind in plain_sender.COLUMNS]
    rows = [struct.pack(plain_sender.ROW, *row) for row in zip(*columns, strict=True)]
    written = msgpack.unpackb(sender.batch(run, golden["first_seq"], rows, golden.get("lost_before", 0)))
    assert {name: written[name] for name in golden} == golden


def test_the_plain_asker_reads_the_slopes_of_the_golden_lanes() -> None:
    answer = msgpack.unpackb((GOLDEN / "lanes.bin").read_bytes())
    read = {at: (round(east, 3), round(north, 3)) for at, (east, north) in plain_asker.slopes(answer).items()}
    column = -4 + 1  # of the second parts from the west, of square -1
    assert read == {
        (column, 8): (-0.254, 0.006),
        (column, 9): (-0.002, 0.004),
        (column, 10): (0.0, 0.002),
        (column, 11): (0.254, 0.0),
    }


class Lot:
    """Router, map server, plain senders: killed and restarted at will."""

    def __init__(self, folder: Path, children: Children) -> None:
        self.folder, self.endpoint, self._children = folder, free_endpoint(), children
        (folder / "site.toml").write_text(
            f'name = "{SITE}"\norigin_lat_deg = 49.01\norigin_lon_deg = 8.4\norigin_height_m = 112.0\n'
        )
        self.running: dict[str, Child | subprocess.Popen[str]] = {}
        self.started = 0

    def start(self, name: str) -> None:
        self.started += 1
        if name == "router":
            self.running[name] = self._children.start(name, "router", "--listen", self.endpoint)
        elif name == "server":
            words = (
                "--endpoint",
                self.endpoint,
                "--site-file",
                self.folder / "site.toml",
                "--store",
                self.folder / "store",
            )
            self.running[name] = self._children.start(name, "server", *words)
        else:
            frame = plain_sender.frame_of(49.01, 8.4, 112.0)
            words = (SENDER, self.endpoint, frame, SITE, name, self.folder / f"{name}.db", "--samples", SAMPLES)
            words = (*words, "--seed", MACHINES.index(name))
            command = [sys.executable, *map(str, words)]
            sender = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
            self._children.callback(sender.wait)
            self._children.callback(sender.kill)
            self.running[name] = sender

    def kill(self, name: str) -> None:
        process = self.running[name]
        if isinstance(process, Child):
            process.send(9)  # type: ignore[arg-type]
            process.wait(PATIENCE_S)
        else:
            process.kill()
            process.communicate()

    def is_over(self, name: str) -> bool:
        process = self.running[name]
        return process.poll() is not None if isinstance(process, subprocess.Popen) else process.code is not None


def journal(store: Path) -> Counter[tuple[str, int, int, int]]:
    """Journalled samples by machine, run, number, stamp, with repetitions."""
    counts: Counter[tuple[str, int, int, int]] = Counter()
    with closing(sqlite3.connect(store / "journal.db")) as db:
        for number, record in db.execute("SELECT row, record FROM journal ORDER BY row"):
            assert zlib.crc32(record[:-4]) == int.from_bytes(record[-4:], "little")
            row, _, run, first, name_bytes = HEAD.unpack_from(record)
            assert row == number
            begin = HEAD.size + name_bytes
            machine = record[HEAD.size : begin].decode()
            for i, sample in enumerate(SAMPLE.iter_unpack(record[begin:-4])):
                counts[machine, run, first + i, sample[0]] += 1
                applied_zero, applied_scale, mass_kg, aid_share, fuel_l = sample[-5:]
                assert (applied_zero, applied_scale, aid_share) == (0.0, 0.0, 0.0)
                assert math.isnan(mass_kg)
                assert math.isnan(fuel_l)
    return counts


def recorded(path: Path, machine: str) -> tuple[set[tuple[str, int, int]], int]:
    """Machine, run, number of a plain sender's recorded, unquarantined samples; their total."""
    with closing(sqlite3.connect(path)) as db:
        runs = {place: (int(run), newest) for place, run, newest in db.execute("SELECT place, id, newest FROM run")}
        bad = {(runs[place][0], seq) for place, seq in db.execute("SELECT place, seq FROM quarantine")}
        assert db.execute("SELECT count(*) FROM sample").fetchone() == (0,), "all is delivered"
    every = {(run, seq) for run, newest in runs.values() for seq in range(1, newest + 1)}
    return {(machine, *each) for each in every - bad}, len(bad)


def test_a_plain_sender_loses_and_doubles_nothing_while_everything_is_killed(tmp_path: Path, children: Children):
    lot, draw = Lot(tmp_path, children), random.Random(7)
    for name in ("router", "server", *MACHINES):
        lot.start(name)
    store = tmp_path / "store"
    until(lambda: (store / "journal.db").exists(), "the server works")
    for _ in range(KILLS):
        before = progress(tmp_path)
        until(lambda b=before: progress(tmp_path) != b or all(map(lot.is_over, MACHINES)), "work is done")
        victim = draw.choice(["router", "server", "server", *MACHINES])
        lot.kill(victim)
        lot.start(victim)
    for name in MACHINES:
        process: Any = lot.running[name]
        said, errors = process.communicate(timeout=PATIENCE_S)
        assert (process.returncode, said, errors) == (0, "done\n", ""), name
    with connect(lot.endpoint, SITE, timeout_s=PATIENCE_S) as client:
        info = client.info()
        compare_answers(client)
    lot.kill("server")
    journalled, quarantined = journal(store), 0
    for name in MACHINES:
        own, bad = recorded(tmp_path / f"{name}.db", name)
        quarantined += bad
        there = {(machine, run, seq) for machine, run, seq, _ in journalled if machine == name}
        assert own - there == set(), "lost"
        assert there - own == set(), "nobody recorded it"
        assert len({stamp for machine, _, _, stamp in journalled if machine == name}) == len(own), (
            "one sample, one identity"
        )
        assert info.machines[name].lost == bad, "declared"
    assert max(journalled.values()) == 1, "double"
    assert quarantined == len(MACHINES) * SAMPLES // plain_sender.BAD_EVERY
    assert info.samples_merged == len(journalled) == len(MACHINES) * SAMPLES - quarantined


def progress(folder: Path) -> list[Any]:
    """Acknowledged progress in the senders' spools."""
    marks: list[Any] = []
    for name in MACHINES:
        try:
            with closing(sqlite3.connect(f"file:{folder / name}.db?mode=ro", uri=True)) as db:
                marks.append(db.execute("SELECT sum(acknowledged), count(*) FROM run").fetchone())
        except sqlite3.OperationalError:  # not created yet
            marks.append(None)
    return marks


def compare_answers(client: Any) -> None:
    """Plain asker and client read the same."""
    session = client.session
    info = plain_asker.ask(session, SITE, "info")["info"]
    assert info["machines"].keys() == {*MACHINES}
    bounds = (0.0, 0.0, 400.0, 300.0)
    first, layers = plain_asker.region(session, SITE, bounds, "resistance", "visits")
    assert first["piece"]["count"] > 1, "large enough for pieces"
    theirs = client.region(bounds, ["resistance", "visits"])
    for name in ("resistance", "visits"):
        np.testing.assert_array_equal(np.array(layers[name], np.float32), theirs[name])
    assert np.isfinite(theirs["resistance"]).sum() > 300
    point = plain_asker.ask(session, SITE, "point", x=60.5, y=30.5)
    assert point["values"]["resistance"] == pytest.approx(client.point(60.5, 30.5).values["resistance"])
    assert math.isfinite(point["values"]["resistance"])
    with pytest.raises(plain_asker.RefusedError, match="unknown_layer"):
        plain_asker.ask(session, SITE, "point", x=0, y=0, layers="gold")
