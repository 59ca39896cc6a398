"""The doctor: single checks, and the whole against a router and map server in process."""

from __future__ import annotations

import contextlib
import json
import math
import shutil
import sqlite3
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agents.delivery.spool import Spool, SpoolConfig
from mapserver.config import ServerConfig
from mapserver.ingest.store import Incoming, Store
from mapserver.journal.location import JournalLocation
from mapserver.journal.sqlite.reader import SCHEMA
from mapserver.server import Server
from protocol.errors import Refusal, StoreError
from protocol.machine.samples import empty
from protocol.queries.answer_codec import encode_info
from protocol.queries.answers import FollowerState, MapInfo, SampleCounts
from protocol.queries.requests import InfoQuery
from protocol.site.site_config import SiteConfig
from protocol.wire import keys
from protocol.wire.codec import encode_batch, encode_health
from protocol.wire.credentials import Identity
from protocol.wire.messages import Ack, Health, Refused, SampleBatch
from protocol.wire.session import SessionConfig, free_endpoint, open_session
from sitegrid.cli import main
from sitegrid.doctor import Finding, Level, disk, network
from sitegrid.doctor.disk import SpoolState, StoreState
from sitegrid.doctor.examine import check_positions
from sitegrid.doctor.keys import Certificate, check_certificate
from sitegrid.doctor.network import RouterLink
from tests.unit.records import map_info

NOW = datetime(2026, 6, 1, 12, tzinfo=UTC)
NOW_NS = 1_767_225_600_000_000_000
SITE = SiteConfig("pit", 48.0, 11.0)
WALL = replace(SITE, clock="wall", clock_tolerance_s=5.0)
INFO = map_info(SITE, samples_merged=300, cells=250, journalled=12, merged=12)
SITE_TOML = 'name = "pit"\norigin_lat_deg = 48.0\norigin_lon_deg = 11.0\n'


def samples(n: int) -> np.ndarray:
    rows = empty(n)
    rows["stamp_ns"] = NOW_NS + np.arange(n) * 10**9
    rows["distance_m"] = 1.0
    return rows


# --- judgements: pure functions --------------------------------------------------------------------------------------

PASS, WARN, FAIL, SKIP = Level.PASS, Level.WARN, Level.FAIL, Level.SKIP
GOOD = Certificate(
    Identity("pit", "loader-1", "machine", NOW + timedelta(days=90)),
    "loader-1",
    NOW - timedelta(days=1),
    NOW + timedelta(days=90),
    signed=True,
    fits=True,
    mode=0o100600,
)
COUNTS = {"spools": 1, "samples": 3, "lost": 0, "missing": 0}
AHEAD = replace(
    INFO,
    stamp_ns=NOW_NS + 72_000 * 10**9,
    wall_ns=NOW_NS,
    machines={f"loader-{i}": SampleCounts(**COUNTS, newest_ns=NOW_NS + 36_000 * 10**9 * i) for i in (1, 2)},
)
STORE = StoreState("pit", SITE.frame, 2, 5000, 100, 3, 4000, 90.0)
HEALTHY = {"spool": {"depth": 3, "pending": 2, "dropped": 0, "put_aside": 0}, "uplink": {"problem": ""}}


def router(took_s: float | None, **link: bool) -> Finding:
    return network.check_link(RouterLink("tcp/a:1", took_s, **link))


def server(info: MapInfo | None, *, is_there: bool, role: str = "") -> Finding:
    return network.check_server("pit", info, is_there=is_there, role=role)


def lossy(lost: int, missing: int) -> MapInfo:
    return replace(INFO, machines={"loader-1": SampleCounts(1, 200, lost, NOW_NS, missing)})


def permission(answer: Ack | Refused | None, *, is_there: bool = True, has_keys: bool = False) -> Finding:
    return network.check_permission("loader-1", answer, is_there=is_there, has_keys=has_keys)


def certificate(check: str, given: dict[str, str] | None = None, **change: Any) -> Finding:
    findings = check_certificate(replace(GOOD, **change), NOW, **(given or {}))
    return next(finding for finding in findings if finding.check == check)


def spool(depth: int, dropped: int = 0, quarantined: int = 0, *, oldest_ns: int = 0, age_s: int = 0) -> Finding:
    return disk.check_spool(SpoolState(depth, dropped, quarantined, oldest_ns), NOW_NS + age_s * 10**9)


def store(site: SiteConfig | None = SITE, **change: Any) -> Finding:
    return disk.check_store(replace(STORE, **change), site)


def positions(variance_factor: Any = 1.0, **verdicts: str) -> Finding:
    receivers = {name: {"verdict": v, "variance_factor": variance_factor} for name, v in verdicts.items()}
    return check_positions("loader-1", {"pipeline": {"consistency": receivers}})


def follower(name: str = "a", store: str = "", behind_s: float = 0.2) -> FollowerState:
    return FollowerState(name, store or INFO.store, 15, 12, 3, behind_s)


@pytest.mark.parametrize(
    ("finding", "level", "words"),
    [
        (router(0.012), PASS, "answers in 12 ms"),
        (router(None, listens=False), FAIL, "nothing listens at tcp/a:1; start `sitegrid router`"),
        (router(None, listens=True), FAIL, "pass --keys"),
        (server(replace(INFO, merged=10), is_there=True), PASS, "journal row 12, merged only up to 10"),
        (network.check_losses(lossy(3, 0)), WARN, "declared lost: 3 of loader-1; look at"),
        (network.check_losses(replace(INFO, counters={"refused_scattered": 3})), WARN, "of 3 batches, on new ground"),
        (network.check_losses(replace(INFO, shortfalls=("a", "row 3 is gone"))), WARN, "row 3 is gone"),
        (server(None, is_there=True, role="visitor"), FAIL, "; the router denies the question"),
        (server(None, is_there=False), FAIL, "start `sitegrid server`"),
        (server(None, is_there=False, role="machine"), FAIL, "revoked"),
        (network.check_site(replace(SITE, origin_lat_deg=48.1), INFO), FAIL, SITE.frame),
        (network.check_site(replace(SITE, name="hill"), INFO), FAIL, "this is hill"),
        (permission(Refused(Refusal.WRONG_FRAME, "compare")), FAIL, "(wrong_frame): compare"),
        (permission(None, is_there=False), FAIL, "start `sitegrid server`"),
        (permission(None, has_keys=True), FAIL, "under the name of its keys alone"),
        (network.check_writers([INFO]), PASS, f"pid 7 on host office, store {INFO.store}"),
        (network.check_writers([INFO, INFO]), FAIL, "2 map servers take samples of this site: pid 7 on host office"),
        (network.check_followers([follower(), follower(name="b")], INFO), PASS, "a, b: at most 0.2 s behind"),
        (network.check_followers([follower(behind_s=11.0)], INFO), WARN, "a: journal row 12, 3 rows and 11.0 s behind"),
        (network.check_followers([follower(store="f" * 16)], INFO), FAIL, "a has the map of another store"),
        (
            network.check_time(AHEAD),
            WARN,
            "20.0 h ahead of the server's clock, by loader-2; set the clock that is wrong",
        ),
        (network.check_time(replace(AHEAD, distrusted=("loader-2",))), WARN, "by loader-1"),
        (
            network.check_time(replace(INFO, counters={"refused_far_future": 3})),
            WARN,
            "3 batches were refused for stamps",
        ),
        *(
            (network.check_time(replace(AHEAD, counters={f"refused_{reason}": 1})), WARN, "20.0 h ahead of the server")
            for reason in ("far_future", "server_clock")
        ),
        (network.check_clock(0.4, 0.01, None), PASS, "0.40 s ahead of"),
        (network.check_clock(1.2, 0.1, None), WARN, "NTP"),
        (network.check_clock(1.2, 0.3, None), PASS, "+-0.30"),
        (network.check_clock(-90.0, 0.1, WALL), WARN, "90.00 s behind"),
        (network.check_clock(6.0, 0.1, WALL), FAIL, "refused beyond 5 s"),
        (network.check_clock(6.0, 0.1, SITE), WARN, "6.00 s ahead"),
        (network.check_clock(5.05, 0.1, WALL), WARN, "5.05 s ahead"),
        (network.check_version("1.0", "1.1"), WARN, "update the older side"),
        (network.check_version("1.0", "unknown"), SKIP, "without being installed"),
        (certificate("certificate", expires=NOW + timedelta(days=30, hours=1)), PASS, "valid until"),
        (certificate("certificate", expires=NOW + timedelta(days=29)), WARN, "29 days more; make a new one with `site"),
        (certificate("certificate", expires=NOW - timedelta(seconds=1)), FAIL, "expired on 2026-06-01"),
        (certificate("certificate", begins=NOW + timedelta(minutes=1)), FAIL, "set this host's clock"),
        (certificate("name", {"site": "pit", "machine": "loader-1"}), PASS, "machine loader-1 of site pit"),
        (certificate("name", common_name="loader-1.2"), PASS, "machine loader-1 of site pit"),
        (certificate("name", {"site": "hill"}), FAIL, "compare --site, --keys"),
        (certificate("authority", signed=False), FAIL, "ca.pem has not signed cert.pem"),
        (certificate("authority", fits=False), FAIL, "key.pem is not the key of cert.pem"),
        (certificate("authority", mode=0o100640), WARN, "mode 640"),
        (disk.check_disk("spool", 2**25), FAIL, "make room now"),
        (disk.check_disk("spool", 2**29), WARN, "make room"),
        (spool(5, oldest_ns=NOW_NS, age_s=600), PASS, "the oldest is of 10 min ago"),
        (spool(5, oldest_ns=NOW_NS, age_s=4 * 3600), WARN, "4 h ago; 0 were dropped, 0 quarantined; start its agent"),
        (spool(0, dropped=3), WARN, "raise max_samples"),
        (spool(0, quarantined=2), WARN, "table `quarantine`"),
        (disk.check_spool(SpoolState(0, 0, 0, 0, gone=9), NOW_NS), WARN, "9 are gone; its disk has lost recorded"),
        (disk.check_spool(SpoolState(0, 0, 0, 0, damage="a.db-wal is damaged"), NOW_NS), WARN, "a.db-wal is damaged"),
        (disk.check_health("loader-1", {**HEALTHY, "problems": ["a", "b: old"]}), WARN, "; a; b: old"),
        (disk.check_health("loader-1", {**HEALTHY, "status": "calibrating"}), PASS, "0 quarantined; calibrating"),
        (disk.check_health("loader-1", HEALTHY), PASS, "loader-1 runs: 3 samples wait, 2 of them for the smoother; "),
        (disk.check_health("loader-1", {"status": 7, "problems": "?"}), PASS, "? samples wait"),
        (disk.check_health("loader-1", {**HEALTHY, "spool": {"depth": 3, "dropped": 1}}), WARN, "1 were dropped"),
        # foreign values may be anything
        (disk.check_health("loader-1", {}), PASS, "? samples wait"),
        (positions(a="cannot_tell"), PASS, "a cannot tell; a slow GPS error that is larger than stated would not show"),
        (positions(a="consistent", b="inconsistent"), WARN, "b inconsistent; fixes are further off than"),
        (check_positions("loader-1", {"pipeline": {"consistency": {"a": 7}}}), SKIP, "too few fixes"),
        (positions(4.0, gps="cannot_tell"), WARN, "the fixes of gps err 2.0 times as far as stated"),
        (positions(0.3, gps="cannot_tell"), WARN, "the fixes of gps err 0.5 times as far as stated"),
        (positions("?", gps="consistent"), PASS, "gps consistent"),
        (store(), PASS, "5000 rows of 3 machines, 100 archived; snapshot of row 4000, 90 s ago"),
        (store(None, checkpoints=3, checkpoint_bytes=2 * 10**8), PASS, "ago; 3 checkpoints of the past, 0.2 GB"),
        (store(None, snapshot_row=0, snapshot_age_s=math.inf), PASS, "no snapshot"),
        (store(None, last_row=30_000), WARN, "a restart folds 26000 rows"),
        (store(shortfall="3 journal rows after row 5 are gone"), FAIL, "rows after row 5 are gone; restore a backup"),
        (store(missing={"loader-1": 4}), WARN, "acknowledged samples are missing: 4 of loader-1"),
        (store(frame="0"), FAIL, "choose another --store"),
        (store(replace(SITE, name="hill")), FAIL, "choose another --store"),
    ],
)
def test_what_is_found_is_judged(finding: Finding, level: Level, words: str):
    assert (finding.level, words in str(finding)) == (level, True), str(finding)


def test_only_who_has_keys_is_told_of_revoking():
    assert "revoked" not in str(server(None, is_there=False))


def test_the_offset_is_taken_at_the_middle_of_the_question():
    asked_ns = (10 * 10**9, 12 * 10**9)
    assert network.offset_of(replace(INFO, wall_ns=8 * 10**9), asked_ns) == (3.0, 1.0)


# --- keys ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def key_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("cryptography")
    folder = tmp_path_factory.mktemp("made") / "keys"
    assert main(["keys", "init", "--site", "pit", "--dir", str(folder)]) == 0
    for name in ("loader-1", "loader-2"):
        assert main(["keys", "add", name, "--dir", str(folder), "--days", "20"]) == 0
    return folder


def copied(folder: Path, name: str, to: Path, **files: bytes) -> Path:
    to.mkdir()
    for path in (folder / name).iterdir():
        (to / path.name).write_bytes(files.get(path.stem, path.read_bytes()))
    return to


@pytest.mark.parametrize("broken", ["cert", "ca"])
def test_what_is_no_certificate_is_one_line(key_folder: Path, tmp_path: Path, broken: str, capsys):
    folder = copied(key_folder, "loader-1", tmp_path / "a", **{broken: b"nonsense"})
    words = ["doctor", "--endpoint", free_endpoint().replace("tcp", "tls"), "--keys", str(folder)]
    assert main(words) == 1
    assert "FAIL  certificate" in (text := capsys.readouterr().out)
    assert "copy the whole folder again" in text.splitlines()[0]
    assert "these keys cannot be used" in text


def test_keys_that_soon_expire_are_told_of_and_their_name_is_used(key_folder: Path, capsys):
    endpoint = free_endpoint().replace("tcp", "tls")
    assert main(["doctor", "--endpoint", endpoint, "--keys", str(key_folder / "loader-1"), "--site", "hill"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("WARN  certificate   machine loader-1 of site pit is valid until")
    assert lines[1].startswith("FAIL  name          the keys are for site pit, not hill")
    assert lines[3].startswith("FAIL  router        nothing listens at tls/")


# --- disk ------------------------------------------------------------------------------------------------------------


def test_a_spool_is_read_without_a_trace(tmp_path: Path):
    with pytest.raises(StoreError, match="no such file"):
        disk.read_spool(tmp_path / "spool.db")
    with closing(Spool(tmp_path / "spool.db", SpoolConfig(max_samples=4))) as spool:
        spool.record(samples(6))
        head = spool.head(1)
        assert head
        spool.quarantine(head, "bad")
        with pytest.raises(disk.InUseError, match="an agent has it open"):
            disk.read_spool(tmp_path / "spool.db")
    before = sorted(tmp_path.iterdir())
    state = disk.read_spool(tmp_path / "spool.db")
    assert state == SpoolState(depth=3, dropped=2, quarantined=1, oldest_ns=NOW_NS + 3 * 10**9)
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize("broken", ["bytes", "schema"])
def test_a_spool_that_cannot_be_used_is_a_finding(tmp_path: Path, broken: str, capsys):
    path = tmp_path / "spool.db"
    if broken == "bytes":
        path.write_bytes(b"nonsense" * 1000)
    else:
        with closing(sqlite3.connect(path)) as db:
            db.execute("PRAGMA user_version = 99")
    assert main(["doctor", "--endpoint", free_endpoint(), "--spool", str(path), "--json"]) == 1
    findings = json.loads(capsys.readouterr().out)["findings"]
    finding = next(f for f in findings if f["check"] == "spool")
    assert finding["level"] == "FAIL"
    said = (
        "schema 99, this version knows 9; have the version that wrote it send"
        if broken == "schema"
        else "no usable spool"
    )
    assert said in finding["message"]


def filled_store(folder: Path) -> None:
    with closing(Store(JournalLocation(folder), SITE, ServerConfig(), time.time_ns)) as store:
        payload = encode_batch(SampleBatch("loader-1", 5, 1, samples(4), SITE.frame))
        assert isinstance(store.commit([Incoming("loader-1", payload)])[0], Ack)
        store.save_snapshot()
        payload = encode_batch(SampleBatch("loader-1", 5, 5, samples(4), SITE.frame))
        store.commit([Incoming("loader-1", payload)])


def test_a_store_is_read_also_while_a_server_uses_it(tmp_path: Path):
    with pytest.raises(StoreError, match=r"holds no journal\.db"):
        disk.read_store(tmp_path, time.time())
    filled_store(tmp_path)
    with closing(Store(JournalLocation(tmp_path), SITE, ServerConfig(), time.time_ns)):
        state = disk.read_store(tmp_path, time.time() + 100)
    assert state == StoreState("pit", SITE.frame, SCHEMA, 2, 0, 1, 1, state.snapshot_age_s)
    assert 99 < state.snapshot_age_s < 160


def test_a_store_whose_log_is_damaged_is_a_finding_before_the_server_starts(tmp_path: Path, capsys):
    left = tmp_path / "left"
    with closing(Store(JournalLocation(tmp_path / "store"), SITE, ServerConfig(), time.time_ns)) as store:
        for first_seq in (1, 5, 9):
            payload = encode_batch(SampleBatch("loader-1", 5, first_seq, samples(4), SITE.frame))
            assert isinstance(store.commit([Incoming("loader-1", payload)])[0], Ack)
        shutil.copytree(tmp_path / "store", left)  # as after kill -9
    assert disk.read_store(left, time.time()).shortfall == ""
    log = left / "journal.db-wal"
    log.write_bytes(log.read_bytes()[:-3000] + bytes(3000))
    assert "4 acknowledged samples of loader-1 are gone" in disk.read_store(left, time.time()).shortfall
    assert main(["doctor", "--endpoint", free_endpoint(), "--store", str(left)]) == 1
    assert "4 acknowledged samples of loader-1 are gone; restore a backup" in capsys.readouterr().out
    Store(JournalLocation(left), SITE, ServerConfig(), time.time_ns).close()
    state = disk.read_store(left, time.time())
    assert (state.shortfall, state.missing) == ("", {"loader-1": 4})


def test_a_spool_whose_disk_lost_its_end_is_a_finding(tmp_path: Path):
    (tmp_path / "left").mkdir()
    with closing(Spool(tmp_path / "spool.db", SpoolConfig())) as spool:
        spool.record(samples(7))
        shutil.copytree(tmp_path, tmp_path / "left", dirs_exist_ok=True, ignore=shutil.ignore_patterns("left"))
    assert disk.read_spool(tmp_path / "left" / "spool.db").gone == 0
    log = tmp_path / "left" / "spool.db-wal"
    log.write_bytes(log.read_bytes()[:-3000] + bytes(3000))
    assert disk.read_spool(tmp_path / "left" / "spool.db").gone == 7


# --- the whole -------------------------------------------------------------------------------------------------------


class Site:
    def __init__(self, endpoint: str, folder: Path) -> None:
        self.endpoint, self.folder = endpoint, folder
        self.site_file = folder / "site.toml"
        self.site_file.write_text(SITE_TOML)
        self.session = open_session(SessionConfig(endpoint, mode="router"))

    def doctor(self, capsys: Any, *words: str | Path) -> tuple[int, dict[str, Finding]]:
        code = main(["doctor", "--endpoint", self.endpoint, "--json", *map(str, words)])
        findings = [Finding(**f) for f in json.loads(capsys.readouterr().out)["findings"]]
        return code, {f.check: f for f in findings}


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    made = Site(free_endpoint(), tmp_path)
    yield made
    made.session.close()


def test_a_healthy_site_passes_and_nothing_is_left_behind(site: Site, capsys):
    filled_store(site.folder / "store")
    with closing(Spool(site.folder / "spool.db", SpoolConfig())):
        pass
    with closing(
        Server(site.session, site.session, JournalLocation(site.folder / "store"), SITE, ServerConfig(), time.time_ns)
    ) as server:
        files = ("--site-file", site.site_file, "--store", site.folder / "store", "--spool", site.folder / "spool.db")
        code, findings = site.doctor(capsys, *files)
        info = server.answers.info()
    assert code == 0
    passed = ("router", "server", "site", "permission", "spool", "spool disk", "store", "store disk")
    assert {name: findings[name].level for name in passed} == dict.fromkeys(passed, Level.PASS)
    assert findings["certificate"].level == Level.SKIP
    assert findings["permission"].message == "batches of doctor are taken"
    assert set(info["machines"]) == {"loader-1"}
    assert info["journalled"] == 2


def test_the_wrong_site_file_is_found_out(site: Site, capsys):
    site.site_file.write_text(SITE_TOML.replace("48.0", "47.0"))
    with closing(
        Server(site.session, site.session, JournalLocation(site.folder / "store"), SITE, ServerConfig(), time.time_ns)
    ):
        code, findings = site.doctor(capsys, "--site-file", site.site_file, "--machine", "loader-7")
    assert code == 1
    assert findings["site"].level == Level.FAIL
    assert findings["permission"].level == Level.FAIL
    assert "loader-7 (wrong_frame)" in findings["permission"].message


def test_a_router_without_a_server_is_found_out(site: Site, capsys):
    code, findings = site.doctor(capsys, "--site", "hill")
    assert code == 1
    assert findings["router"].level == Level.PASS
    assert findings["server"].message == "site hill: the router knows of no map server"
    assert findings["permission"].level == Level.SKIP
    _, findings = site.doctor(capsys, "--site-file", site.site_file)
    assert findings["permission"].message == "nobody takes batches of doctor"


@contextlib.contextmanager
def answering(site: Site, key: str, data: bytes) -> Iterator[None]:
    """A queryable on a key; without data it is silent, like a denying router."""

    def reply(query: Any) -> None:
        with query:
            if data:
                query.reply(query.key_expr, data)

    queryable = site.session.declare_queryable(key, reply)
    yield
    queryable.undeclare()


def test_silence_of_a_server_that_is_there_is_called_a_denial(site: Site, capsys):
    with answering(site, keys.map_queries_all("pit"), b""), answering(site, keys.ingest_all("pit"), b""):
        code, findings = site.doctor(capsys, "--site-file", site.site_file)
    assert code == 1
    assert findings["server"].message == "site pit: a map server is there, but does not answer"
    assert findings["permission"].message == "a map server is there, but gives no answer to batches of doctor"


def test_clock_and_version_of_the_server_are_compared(site: Site, capsys, monkeypatch):
    monkeypatch.setattr("sitegrid.doctor.examine.package_version", lambda: "1.0")
    info = replace(INFO, wall_ns=time.time_ns() - 3600 * 10**9, version="0.9")
    with answering(site, keys.map_query("pit", InfoQuery.name), encode_info(info)):
        _, findings = site.doctor(capsys, "--site", "pit")
    assert findings["clock"].level == Level.WARN
    assert "s ahead of the map server's clock" in findings["clock"].message
    assert findings["version"].message == "here 1.0, map server 0.9"


def test_a_running_agent_is_heard(site: Site, capsys):
    health = encode_health(Health("loader-1", NOW_NS, {"spool": {"depth": 9}, "problems": ["no answer"]}))
    done = threading.Event()

    def tell() -> None:
        while not done.wait(0.05):
            site.session.put(keys.health("pit", "loader-1"), health)

    teller = threading.Thread(target=tell)
    words = ("--site", "pit", "--spool", site.folder / "spool.db")
    with closing(Spool(site.folder / "spool.db", SpoolConfig())):
        _, unnamed = site.doctor(capsys, *words)
        teller.start()
        _, named = site.doctor(capsys, *words, "--machine", "loader-1")
        done.set()
        teller.join()
    assert "give --machine NAME" in unnamed["spool"].message
    assert named["spool"].message.startswith("loader-1 runs: 9 samples wait")
    assert named["spool"].advice == "no answer"
