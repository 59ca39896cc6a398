"""All decoders with valid inputs, and the law of accepted inputs: written and reread they are equal."""

from __future__ import annotations

import gzip
import io
import json
import sqlite3
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict
from datetime import UTC, datetime
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from agents.config import load_agent
from agents.estimation import calibration_file
from agents.estimation.calibration import Calibration
from mapserver.config import ServerConfig
from mapserver.journal.archive import FOLDER as ARCHIVE
from mapserver.journal.archive import next_file
from mapserver.journal.archive_file import KEY, ArchiveFile, seal
from mapserver.journal.rows import Admission, JournalRow
from mapserver.journal.sqlite.journal import SqliteJournal
from mapserver.journal.sqlite.reader import SqliteReader
from protocol.config import from_table
from protocol.errors import ConfigError, LogFolderError, MessageError, QueryError, StoreError
from protocol.files import load_toml, sealed
from protocol.machine.log_folder import open_log, write_log
from protocol.machine.machine_config import MachineConfig, SensorConfig
from protocol.machine.readings import Gps, Imu
from protocol.machine.samples import check_samples
from protocol.queries import requests
from protocol.queries.commands import parse_command
from protocol.queries.parameters import selector_of, split_selector
from protocol.site.geometry import Bounds
from protocol.site.site_config import MAX_EXTENT_M, SiteConfig
from protocol.site.site_file import load_site
from protocol.wire.codec import decode_offer, encode_offer, receive_pose
from protocol.wire.credentials import check_valid, load_credentials
from protocol.wire.keys import check_name, pose
from protocol.wire.messages import SampleBatch
from sim.config import load_sim
from sitegrid.logs.log_truth import read_known_ground, read_log_truth
from sitegrid.security.register import Register, RegisterEntry, load_register, register_toml
from tests.fuzz.messages import messages
from tests.fuzz.mutations import files, texts
from tests.fuzz.strangers import archives, web
from tests.fuzz.verdict import Decoder
from tests.golden import questions
from tests.golden.make import EXTENT_M, FOLDER, GOLDEN, NEWER, OLDER, T0, rows
from tests.paths import CONFIG

NOW = datetime(2026, 1, 1, tzinfo=UTC)
SITE = SiteConfig("paper", 49.0, 8.0)
PLAIN = ("health", "info", "machines", "machine", "changes", "change", "calibration")  # people see these as JSON


@cache
def workshop() -> Path:
    """A folder for files read by name, for the process's lifetime."""
    folder = tempfile.TemporaryDirectory(prefix="sitegrid-fuzz-")
    _KEPT.append(folder)
    return Path(folder.name)


_KEPT: list[tempfile.TemporaryDirectory[str]] = []


@cache
def decoders() -> tuple[Decoder, ...]:
    return (*_messages(), *_selectors(), *_configs(), *_logs(), *_kept(), *web())


# --- messages --------------------------------------------------------------------------------------------------------


def _messages() -> Iterator[Decoder]:
    batches = ("batch.bin", "batch_lost.bin", "batch_empty.bin", OLDER, NEWER)
    golden = {name: ((FOLDER / f"{name}.bin").read_bytes(),) for name in _SINGLE}
    several = {"batch": tuple((FOLDER / name).read_bytes() for name in batches)}
    replies = ("ack.bin", "ack_offer.bin", "refused.bin", "refused_later.bin")
    several["reply"] = tuple((FOLDER / name).read_bytes() for name in replies)
    for name, seeds in {**golden, **several}.items():
        file = {"batch": "batch.bin", "reply": "ack.bin"}.get(name, f"{name}.bin")
        encode, decode = GOLDEN[file].encode, GOLDEN[file].decode
        yield Decoder(name, seeds, partial(_again, name, encode, decode), (MessageError,), messages)


_SINGLE = (
    "bundle",
    "corrections",
    "pose",
    "health",
    "point",
    "region",
    "history",
    "tiles",
    "lanes",
    "why",
    "segments",
    "worklist",
    "alive",
    "origin",
    *PLAIN[1:],
    "error",
)


def _again(name: str, encode: Callable[[Any], bytes], decode: Callable[[bytes], Any], data: bytes) -> None:
    value = decode(data)
    if name == "batch":
        assert abs(value.rows["x_m"]).max(initial=0) <= EXTENT_M
    if name == "region":
        assert isinstance(value.bounds, Bounds)
    if name == "pose":
        with suppress(MessageError):  # checks of every pose after its codec
            heard = receive_pose(pose("paper", "loader-1"), data)
            assert heard.machine == "loader-1"
            assert max(abs(heard.x_m), abs(heard.y_m)) <= MAX_EXTENT_M
    if name == "error":
        assert str(value).isprintable()
    if name == "reply":
        assert getattr(value, "problem", "").isprintable()
        with suppress(MessageError):  # for an offer only: the acknowledgement is valid
            offer = decode_offer(getattr(value, "offer", None))
            assert decode_offer(encode_offer(offer)) == offer
    if name in PLAIN:
        json.dumps(value.values if name == "health" else value, default=asdict)
    written = encode(value)
    assert encode(decode(written)) == written


# --- selectors -------------------------------------------------------------------------------------------------------


def _selectors() -> Iterator[Decoder]:
    for what, known, read in (("query", questions.QUESTIONS, _query), ("command", questions.COMMANDS, _command)):
        names = {one.name for one in known}
        seeds = [line for line in questions.SELECTORS.read_text().splitlines() if line.partition("?")[0] in names]
        yield Decoder(what, tuple(line.encode() for line in seeds), read, (QueryError,), texts)


def _split(data: bytes) -> tuple[str, dict[str, str]]:
    name, _, text = data.decode(errors="replace").partition("?")
    return name, split_selector(text)


def _query(data: bytes) -> None:
    query = requests.parse_query(*_split(data))
    sent = split_selector(selector_of(query.parameters()))
    known = requests.parse_query(query.name, sent)
    assert known.parameters() == query.parameters()


def _command(data: bytes) -> None:
    command = parse_command(*_split(data))
    sent = split_selector(selector_of(command.parameters()))
    assert parse_command(command.name, sent) == command


# --- configurations --------------------------------------------------------------------------------------------------


def _configs() -> Iterator[Decoder]:
    shipped = {name: (CONFIG / f"{name}.toml").read_bytes() for name in ("site", "server", "agent", "sim")}
    ground = b'[[known_ground]]\nname = "pad"\nc_rr = 0.02\noutline = [[0.0, 0.0], [9.0, 0.0], [9.0, 9.0]]\n'
    yield _config(
        "site",
        (shipped["site"], shipped["site"].replace(b"known_ground = []", b"") + ground),
        lambda path: load_site(path).frame,
    )
    yield _config("server", (shipped["server"],), lambda path: from_table(ServerConfig, load_toml(path), str(path)))
    yield _config("agent", (shipped["agent"],), load_agent)
    yield _config("sim", (shipped["sim"],), load_sim)
    entry = RegisterEntry("machine", "1f", NOW, signing="A" * 43 + "=")
    register = register_toml(Register("paper", ("localhost",), {"loader-1": entry, "router": entry}))
    yield _config("register", (_text_of(register).encode(),), _sealed(_register), "register.toml")
    identity = b'site = "paper"\nname = "loader-1"\nrole = "machine"\nexpires = 2030-01-01T00:00:00Z\n'
    yield _config("identity", (identity,), _sealed(_identity), "identity.toml", place="")


def _config(
    name: str, seeds: tuple[bytes, ...], load: Callable[[Path], object], file: str = "", place: str | None = None
) -> Decoder:
    path = workshop() / name / (file or f"{name}.toml")
    path.parent.mkdir()

    def decode(data: bytes) -> None:
        path.write_bytes(data)
        load(path)

    return Decoder(name, seeds, decode, (ConfigError,), texts, path.name if place is None else place)


def _text_of(sealed_text: str) -> str:
    return sealed_text.partition("\n")[2]


def _sealed(load: Callable[[Path], object]) -> Callable[[Path], object]:
    """Add a valid checksum, else nothing behind it would be tested."""

    def seal_and_load(path: Path) -> None:
        with suppress(UnicodeDecodeError):
            path.write_bytes(sealed(path.read_bytes().decode()).encode())
        load(path)

    return seal_and_load


def _register(path: Path) -> None:
    register = load_register(path.parent)
    path.write_text(register_toml(register), encoding="utf-8")
    assert load_register(path.parent).names.keys() == register.names.keys()


def _identity(path: Path) -> None:
    for name in ("ca.pem", "cert.pem", "key.pem"):
        (path.parent / name).touch()
    check_valid(load_credentials(path.parent), NOW)


# --- logs ------------------------------------------------------------------------------------------------------------

MACHINE = MachineConfig("loader-1", sensors=(SensorConfig("imu-1", "imu"), SensorConfig("gps-1", "gps")))
METRES = b'''x_m = { columns = { lat_deg = 0.5, lon_deg = 0.5 }, offset = 1.5, unit = "mm" }
y_m = "height_m"'''
GROUND = b"""[[ground]]
name = "pad"
outline = [[0.0, 0.0], [20.0, 0.0], [20.0, 15.0]]
c_rr = 0.012
grade_east = 0.05
"""
TRUTH = b"""[truth]
file = "truth.csv"
names = ["t", "x", "y", "fix"]
delimiter = ";"
at_least = { fix = 2 }
mount = { xyz_m = [1.0, 0.5, 2.0] }
stamp = { columns = { t = 1.0 }, unit = "ms" }
x_m = "x"
y_m = "y"
"""
PLACES = b"1000;0.5;0.25;2\n1100;0.75;nan;2\n9000;3;4;3\n"
READINGS = [
    *(Imu("imu-1", T0 + i * 10**7, 0.001, -0.002, 0.25, 0.1, -0.2, 9.80665) for i in range(8)),
    *(Gps("gps-1", T0 + i * 10**9, 49.5, 8.25, 112.5, 1.5, 1.5, 4.0) for i in range(4)),
]


def _logs() -> Iterator[Decoder]:
    (workshop() / "paper.toml").write_bytes((CONFIG / "site.toml").read_bytes())
    site = load_site(workshop() / "paper.toml")
    folders = [workshop() / name for name in ("log", "csv", "gzip", "judged")]
    for folder in folders:
        write_log(folder, "drive", site, MACHINE, READINGS)
    log, plain, packed, judged = folders
    manifest, csv = (log / "log.toml").read_bytes(), (log / "imu-1.csv").read_bytes()
    (packed / "log.toml").write_bytes(manifest.replace(b"imu-1.csv", b"imu-1.csv.gz"))
    converted = manifest.replace(b'gyro_x_radps = "', b'gyro_x_radps = { value = 0.5, unit = "deg/s" }\n#"')
    metres = manifest.replace(b'lat_deg = "lat_deg"\nlon_deg = "lon_deg"', METRES).replace(
        b"delay_s = 0.0", b"delay_s = -0.5"
    )
    assert b"\nx_m = {" in metres
    errors, seeds = (ConfigError, LogFolderError), (gzip.compress(csv, mtime=0),)
    yield Decoder("manifest", (manifest, converted, metres), partial(_log, log, "log.toml"), errors, texts, str(log))
    (judged / "truth.csv").write_bytes(PLACES)
    (plain / "evaluation.toml").write_bytes(TRUTH)
    yield Decoder("truth", (TRUTH, GROUND), partial(_truth, judged, "evaluation.toml"), errors, texts, str(judged))
    yield Decoder("truth_csv", (PLACES,), partial(_truth, plain, "truth.csv"), errors[1:], texts, "truth.csv")
    yield Decoder("csv", (csv,), partial(_log, plain, "imu-1.csv"), errors[1:], texts, "imu-1.csv")
    yield Decoder("csv_gzip", seeds, partial(_log, packed, "imu-1.csv.gz"), errors[1:], files, "imu-1.csv.gz")


def _log(folder: Path, file: str, data: bytes) -> None:
    (folder / file).write_bytes(data)
    log = open_log(folder)
    assert all((folder / source.file.file).resolve().is_relative_to(folder.resolve()) for source in log.sources)
    known = [stamp_ns for stamp_ns, _ in log.timed()]
    assert known == sorted(known)


def _truth(folder: Path, file: str, data: bytes) -> None:
    """A log's truth, described and read."""
    (folder / file).write_bytes(data)
    log = open_log(folder)
    assert all(area.c_rr is not None or area.has_gradient for area in read_known_ground(log, folder))
    truth = read_log_truth(log, folder)
    assert truth is None or (np.diff(truth.track.stamp_ns) >= 0).all()


# --- what is kept on disk --------------------------------------------------------------------------------------------


def _kept() -> Iterator[Decoder]:
    path = workshop() / "loader-1.calibration.json"
    calibration = Calibration(0.0031, -0.02, ((1e-6, -2e-7), (-2e-7, 1e-4)), T0, 41)
    calibration_file.save(path, "loader-1", calibration)

    def decode(data: bytes) -> None:
        path.write_bytes(data)
        loaded = calibration_file.load(path, "loader-1")
        assert loaded is not None
        calibration_file.save(path, "loader-1", loaded)
        assert calibration_file.load(path, "loader-1") == loaded

    yield Decoder("calibration", (path.read_bytes(),), decode, (StoreError,), texts, path.name)
    yield _journal(workshop() / "journal")
    yield from _archive(workshop() / "archive")


def _journal(folder: Path) -> Decoder:
    """A row with another record."""
    expected = _write_journal(folder)
    path = folder / "journal.db"
    db = sqlite3.connect(path, isolation_level=None)
    db.execute("PRAGMA synchronous=OFF")
    record = db.execute("SELECT record FROM journal WHERE row = 2").fetchone()[0]

    def decode(data: bytes) -> None:
        db.execute("UPDATE journal SET record = ? WHERE row = 2", (data,))
        with SqliteReader(path) as reader:
            _compare(list(reader.read()), expected)

    return Decoder("journal", (record,), decode, (StoreError,), files, "row 2 is damaged")


def _archive(folder: Path) -> Iterator[Decoder]:
    """A file damaged anywhere, and one sealed by a stranger."""
    expected = _write_journal(folder)
    with SqliteReader(folder / "journal.db") as reader:
        made = next_file(folder / ARCHIVE, reader, SITE, T0 + 360_000 * 10**9)
    assert made is not None

    def decode(data: bytes) -> None:
        made.write_bytes(data)
        _compare(list(ArchiveFile(made).read()), expected)

    yield Decoder("archive", (made.read_bytes(),), decode, (StoreError,), files, made.name)
    strange = folder / "strange.parquet"

    def decode_strange(data: bytes) -> None:
        with strange.open("w+b") as file:
            file.write(data)
            with suppress(OSError):  # files without footer
                seal(file)
        for row in ArchiveFile(strange).read():
            check_samples(row.rows, MAX_EXTENT_M)
            check_name(row.machine, "machine")

    plain = io.BytesIO()
    table = pq.read_table(made)
    header = {KEY: pq.read_metadata(made).metadata[KEY]}
    pq.write_table(table.replace_schema_metadata(header), plain)
    yield Decoder("strange_archive", (plain.getvalue(),), decode_strange, (StoreError,), archives, strange.name)


def _write_journal(folder: Path) -> list[JournalRow]:
    """Make a journal of three rows; returns the expected content."""
    journal = SqliteJournal(folder / "journal.db", SITE.name, SITE.frame)
    journal.begin()
    for i in range(3):
        batch = SampleBatch("loader-1", 7, 1 + 3 * i, rows(), SITE.frame)
        journal.append(Admission(batch, 0, 0), T0)
    journal.commit()
    rows_read = list(journal.read())
    journal.close()
    return rows_read


def _compare(rows_read: list[JournalRow], expected: list[JournalRow]) -> None:
    assert [row.row for row in rows_read] == [row.row for row in expected]
    for one, other in zip(rows_read, expected, strict=True):
        assert np.array_equal(one.rows.tobytes(), other.rows.tobytes())
        assert (one.machine, one.spool_id, one.first_seq) == (other.machine, other.spool_id, other.first_seq)
