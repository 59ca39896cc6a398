"""`sitegrid fold` by processes and a Dask cluster: the same store, even if killed midway."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from mapserver.journal.archive import write_file
from mapserver.journal.rows import JournalRow
from protocol.site.site_config import SiteConfig
from sitegrid.cli import main
from sitegrid.refold import engine
from sitegrid.refold.engine import Cluster
from tests.patience import PATIENCE_S, until
from tests.site_work import evidence_hash
from tests.unit.sitegrid.refold.archives import SITE, STORE, T0, S, samples

pytest.importorskip("pyarrow.parquet")
distributed = pytest.importorskip("distributed")
pytestmark = pytest.mark.processes
FILES = 12
MOST_FOLDS = 8  # until a worker dies in one
# The command with many small tasks.
FOLD = (
    "import sys; from sitegrid.refold.engine import Cluster as C; C.task_samples = 1; from sitegrid.cli import main; "
)
FOLD += "sys.exit(main(sys.argv[1:]))"


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve files of two machines."""
    folder = tmp_path_factory.mktemp("archive") / "archive"
    write(folder, SITE, range(FILES))
    return folder


def write(folder: Path, site: SiteConfig, numbers: range) -> None:
    for number in numbers:
        rng = np.random.default_rng(number)
        rows = [
            JournalRow(2 * number + i + 1, name, 7, 20_000 * number + 1, samples(rng, 20_000), T0 + number * 3600 * S)
            for i, name in enumerate("ab")
        ]
        write_file(folder, STORE, site, ((row, row.received_ns) for row in rows))


@pytest.fixture(scope="module")
def expected(archive: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    out = tmp_path_factory.mktemp("expected") / "store"
    assert main(["fold", str(archive), "--out", str(out), "--json"]) == 0
    return contents(out)


def contents(store: Path) -> dict[str, str]:
    """Contents but the store's random id; names of other files."""
    files = {path for path in store.rglob("*") if path.is_file() and path.name not in ("lock", "journal.db-mark")}
    hashes = {".toml": Path.read_text, ".checkpoint": evidence_hash}
    return {str(path.relative_to(store)): hashes.get(path.suffix, lambda _: "")(path) for path in files}


def started(*words: object) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-c", FOLD, "fold", *map(str, words), "--json"], stdout=subprocess.PIPE)


def children_of(pid: int) -> set[int]:
    """Children of all threads of a process, with Python's resource tracker."""
    return {int(word) for path in Path(f"/proc/{pid}/task").glob("*/children") for word in path.read_text().split()}


def evidence(out: Path) -> list[Path]:
    return list(out.with_name(f"{out.name}.part").glob("work/evidence-*"))


@pytest.mark.nightly
def test_a_fold_that_is_killed_goes_on(archive: Path, expected: dict[str, str], tmp_path: Path) -> None:
    out = tmp_path / "out"
    with started(archive, "--out", out, "--jobs", 2) as fold:
        until(lambda: len(evidence(out)) >= 3, "some tasks")
        workers = children_of(fold.pid)
        fold.kill()
    assert workers
    until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in workers), "the end of its processes")
    assert not out.exists()
    before = {path: path.stat().st_ino for path in evidence(out)}
    assert 3 <= len(before) < FILES
    with started(archive, "--out", out, "--jobs", 2) as fold:
        until(lambda: len(evidence(out)) > len(before), "more tasks")
        assert {path: path.stat().st_ino for path in before} == before, "what was done is not done again"
        assert fold.wait(PATIENCE_S) == 0
    assert contents(out) == expected
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.nightly
def test_a_fold_that_is_interrupted_at_its_terminal_says_so_in_one_line(archive: Path, tmp_path: Path) -> None:
    """Ctrl-C reaches its workers too."""
    words = ["fold", str(archive), "--out", str(tmp_path / "out"), "--jobs", "2"]
    pipe = {"stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    with subprocess.Popen([sys.executable, "-c", FOLD, *words], **pipe) as fold:
        until(lambda: len(evidence(tmp_path / "out")) >= 2, "some tasks")
        workers = children_of(fold.pid)
        os.killpg(fold.pid, signal.SIGINT)
        _, error = fold.communicate(timeout=PATIENCE_S)
    assert fold.returncode == 130
    assert error.count("\n") <= 1, error
    until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in workers), "the end of its processes")


# --- a cluster -------------------------------------------------------------------------------------------------------


class Deaths(distributed.diagnostics.plugin.SchedulerPlugin):
    """Counts workers that leave."""

    count = 0

    def remove_worker(self, *_: object, **__: object) -> None:
        self.count += 1


@pytest.fixture
def dask(monkeypatch: pytest.MonkeyPatch) -> Iterator[distributed.LocalCluster]:
    """A scheduler and two workers with nannies."""
    monkeypatch.setattr(Cluster, "task_samples", 1)
    options = {"host": "127.0.0.1", "dashboard_address": ":0", "silence_logs": 50}
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, **options) as cluster:
        yield cluster


def address(cluster: distributed.LocalCluster) -> str:
    return str(cluster.scheduler_address).replace("tcp://", "dask://")


@pytest.mark.nightly
def test_a_cluster_makes_the_same_store(archive: Path, expected: dict[str, str], tmp_path: Path, dask) -> None:
    with distributed.Client(dask) as client:
        pids = set(client.run(os.getpid).values())
    assert len(pids - {os.getpid()}) == 2
    assert main(["fold", str(archive), "--out", str(tmp_path / "out"), "--engine", address(dask), "--json"]) == 0
    assert contents(tmp_path / "out") == expected


@pytest.mark.nightly
@pytest.mark.parametrize("mode", ["graceful", "segfault"])
def test_a_cluster_whose_workers_die_makes_the_same_store(
    archive: Path, expected: dict[str, str], tmp_path: Path, dask, mode: str
) -> None:
    from distributed.chaos import KillWorker

    deaths = Deaths()
    dask.scheduler.add_plugin(deaths)
    dask.adapt(minimum=2, maximum=2, interval="1 s")  # a nanny may end with its worker
    with distributed.Client(dask) as client:
        client.register_plugin(KillWorker(4.0, mode))  # any sooner kills starting workers, and so their nannies
    for number in range(MOST_FOLDS):
        out, before = tmp_path / str(number), deaths.count
        assert main(["fold", str(archive), "--out", str(out), "--engine", address(dask), "--json"]) == 0
        assert contents(out) == expected
        if died := deaths.count - before:
            break
    assert died, "workers died during a fold"


@pytest.mark.nightly
def test_a_cluster_that_loses_all_its_workers_is_named(
    archive: Path, tmp_path: Path, dask, monkeypatch, capsys
) -> None:
    """`sys.exit` ends a worker's nanny, without replacement."""
    from distributed.chaos import KillWorker

    monkeypatch.setattr(engine, "ALONE_S", 3.0)
    with distributed.Client(dask) as client:
        client.register_plugin(KillWorker(0.4, "sys.exit"))
    assert main(["fold", str(archive), "--out", str(tmp_path / "out"), "--engine", address(dask)]) == 1
    error = capsys.readouterr().err
    assert "workers" in error
    assert error.count("\n") == 1


@pytest.mark.nightly
def test_a_scheduler_that_dies_is_named_and_the_fold_goes_on_without_it(
    archive: Path, expected: dict[str, str], tmp_path: Path
) -> None:
    """Separate processes; the scheduler is killed."""
    out, port_file = tmp_path / "out", tmp_path / "scheduler.json"
    command = [sys.executable, "-c", "from distributed.cli.dask_scheduler import main; main()"]
    command += ["--host", "127.0.0.1", "--port", "0", "--dashboard-address", "127.0.0.1:0", "--no-dashboard"]
    worker = [sys.executable, "-c", "from distributed.cli.dask_worker import main; main()", "--no-dashboard"]
    worker += ["--scheduler-file", str(port_file), "--nthreads", "1", "--local-directory", str(tmp_path / "scratch")]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with subprocess.Popen([*command, "--scheduler-file", str(port_file)], **quiet) as scheduler:
        until(port_file.exists, "a scheduler")
        place = json.loads(port_file.read_text())["address"].replace("tcp://", "dask://")
        with subprocess.Popen([*worker, "--death-timeout", "20"], **quiet) as one:
            words = ["fold", str(archive), "--out", str(out), "--engine", place]
            with subprocess.Popen([sys.executable, "-c", FOLD, *words], stderr=subprocess.PIPE, text=True) as fold:
                until(lambda: len(evidence(out)) >= 2 or fold.poll() is not None, "some tasks")
                scheduler.kill()
                _, error = fold.communicate(timeout=PATIENCE_S)
            one.terminate()
    assert fold.returncode == 1
    assert "is gone; what is done is kept in" in error
    assert error.count("\n") == 1
    assert evidence(out)
    with started(archive, "--out", out, "--jobs", 2) as again:
        assert again.wait(PATIENCE_S) == 0
    assert contents(out) == expected
