"""A recorded site replayed by readings or samples: equal samples and map."""

from __future__ import annotations

import hashlib
import json
import resource
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from mapserver.journal.history import History, history_rows
from mapserver.journal.location import JournalLocation
from protocol.machine.samples import SAMPLE_DTYPE
from protocol.recording import RecordedFile
from protocol.site.geometry import Bounds
from protocol.wire.session import free_endpoint
from sim.config import SimConfig
from sitegrid.cli import main
from sitegrid.process.children import Child
from tests.integration.forks import Forks
from tests.integration.site_run import SiteRun
from tests.patience import PATIENCE_S, until

pytestmark = [pytest.mark.processes, pytest.mark.slow]
SIM = SimConfig(machines=2, seconds=40, speed=8, seed=3, world="fast")
SIDE_M = 256.0


class Recorded:
    """Recorded by `sitegrid record` and agents, two machines driving."""

    def __init__(self, folder: Path, children: Forks) -> None:
        self.children, self.endpoint = children, free_endpoint()
        self.site = self.run(folder)
        self.readings = folder / "readings"
        for config in self.site.configs:
            config.write_text(f'{config.read_text()}\n[record]\nfolder = "{self.readings}"\n')
        self.site.start_router()
        self.site.start_server()
        self.file = folder / "site.mcap"
        words = ("--endpoint", self.endpoint, "--site", self.site.site, "--store", folder / "store", "--json")
        recorder = children.start("record", "record", self.file, *words)
        assert recorder.expect("ready", PATIENCE_S)["file"] == f"{self.file}.part"
        self.site.start_agents()
        self.site.start_sim().expect("ended", PATIENCE_S)
        self.site.delivered()
        self.samples, self.map = self.end(self.site)
        until(lambda: self.file.with_name("site.mcap.part").stat().st_size, "something is written")
        recorder.send(signal.SIGINT)
        self.report = recorder.expect("recorded", PATIENCE_S)
        assert recorder.wait(PATIENCE_S) == 0

    def run(self, folder: Path) -> SiteRun:
        folder.mkdir(exist_ok=True)
        return SiteRun(folder, self.children, self.endpoint, SIM)

    def end(self, site: SiteRun) -> tuple[dict[str, bytes], str]:
        """Samples by machine, and the whole map's hash, while stopping the server."""
        with site.connect() as client:
            until(lambda: (info := client.info()).merged == info.journalled, "all is merged")
            region = client.region(Bounds(-SIDE_M, -SIDE_M, SIDE_M, SIDE_M))
        site.server.stop()
        location = JournalLocation(site.folder / "store")
        samples: dict[str, bytes] = {}
        with location.reader() as reader:
            for row in history_rows(History(reader, location.archive)):
                samples[row.machine] = samples.get(row.machine, b"") + row.rows.tobytes()
        assert np.isfinite(region["resistance"]).sum() > 50
        return samples, hashlib.sha256(b"".join(values.tobytes() for values in region.layers.values())).hexdigest()

    def replay(self, *words: str | Path) -> Child:
        place = ("--endpoint", self.endpoint, "--site", self.site.site, "--speed", "0", "--json")
        return self.children.start("replay", "replay", *words, *place)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Recorded]:
    folder = tmp_path_factory.mktemp("recorded")
    with Forks(folder) as children:
        yield Recorded(folder, children)


def test_readings_that_are_replayed_give_the_same_samples_and_the_same_map(recorded: Recorded, tmp_path: Path):
    site = recorded.run(tmp_path)
    site.start_server()
    site.start_agents()
    files = sorted(recorded.readings.glob("*.mcap"))
    assert [path.name.partition(".")[0] for path in files] == sorted(recorded.samples)
    replayed = recorded.replay(*files).expect("replayed", PATIENCE_S)["replayed"]
    assert set(replayed) == set(recorded.samples)
    reports = site.delivered()
    assert {name: report["readings"] for name, report in reports.items()} == replayed
    assert recorded.end(site) == (recorded.samples, recorded.map)


def test_samples_that_are_replayed_give_the_same_map(recorded: Recorded, tmp_path: Path):
    site = recorded.run(tmp_path)
    site.start_server()
    table = recorded.replay(recorded.file, "--samples").expect("replayed", PATIENCE_S)["replayed"]
    assert table == {"samples": sum(len(data) for data in recorded.samples.values()) // SAMPLE_DTYPE.itemsize, "had": 0}
    assert recorded.end(site) == (recorded.samples, recorded.map)


def test_a_lost_router_is_a_gap_and_a_killed_recording_can_be_read(site: SiteRun, children: Forks):
    site.start_router()
    site.start_server()
    file, log = site.folder / "a.mcap", site.folder / "record.log"
    recorder = children.start("record", "record", file, "--endpoint", site.endpoint, "--site", site.site, "--json")
    recorder.expect("ready", PATIENCE_S)
    site.router.send(signal.SIGKILL)
    site.router.wait(PATIENCE_S)
    until(lambda: "gap: no router" in log.read_text(), "the gap is reported")
    site.start_router()
    until(lambda: "the gap without router ends after" in log.read_text(), "and its end")
    part = file.with_name("a.mcap.part")
    until(lambda: b"sitegrid" in part.read_bytes() and len(list(RecordedFile(part).messages())) >= 2, "it is flushed")
    recorder.send(signal.SIGKILL)
    recorder.wait(PATIENCE_S)
    lines = [json.loads(message.data)["message"] for message in RecordedFile(part).messages()]
    assert lines[0] == "gap: no router"
    assert any(line.startswith("the gap without router ends after") for line in lines)
    assert not file.exists()
    assert main(["record", str(file), "--endpoint", site.endpoint, "--site", site.site]) == 1


def test_a_full_disk_ends_a_recording_in_one_line(site: SiteRun, capsys: pytest.CaptureFixture[str]):
    site.start_router()
    site.start_server()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50, limits[1]))
    try:
        file = site.folder / "a.mcap"
        words = ("--endpoint", site.endpoint, "--site", site.site, "--duration", "0.1")
        assert main(["record", str(file), *words]) == 1
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith(f"sitegrid: {file}.part: File too large")
    assert not file.exists()
