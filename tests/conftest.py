from __future__ import annotations

import os
import sys

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy starts them: small matrices, parallel tests
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # else every child process compiles all sources

import gc
import signal
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from sitegrid.process.lifetime import SIGNALS
from tests import postgres_server as postgres
from tests.paths import ROOT, SHARED_DATA

gc.set_threshold(50_000, 50, 100)  # recorded drives are millions of objects: default steps take a sixth of the time

# Shells start background jobs with SIGINT ignored, nohup with SIGHUP; so would all test processes.
for number, handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, handler)

# Repeatable everywhere, tolerant of slow hosts.
settings.register_profile(
    "repeatable", max_examples=50, derandomize=True, deadline=None, database=None, print_blob=True
)
settings.load_profile("repeatable")


@pytest.fixture(scope="session")
def root() -> Path:
    return ROOT


@pytest.fixture(scope="session", autouse=True)
def _compiled_kernels() -> None:
    """Compile or load Numba's kernels, so that no single test pays for it."""
    from tests.kernels import compile_all

    compile_all(from_the_end=os.environ.get("PYTEST_XDIST_WORKER", "gw0") != "gw0")


@pytest.fixture(scope="session")
def husky_data() -> Path:
    """The real Husky log, or skip."""
    folder = SHARED_DATA / "rl_test1_husky"
    if not folder.exists():
        pytest.skip("the Husky log is not beside the project (../shared/data/rl_test1_husky)")
    return folder


@pytest.fixture(scope="session")
def postgres_cluster() -> Iterator[postgres.Cluster]:
    """A real PostgreSQL server per test process."""
    try:
        with postgres.cluster() as cluster:
            yield cluster
    except RuntimeError as error:
        pytest.fail(str(error), pytrace=False)


@pytest.fixture
def database(postgres_cluster: postgres.Cluster) -> postgres.Database:
    """An empty database on it."""
    return postgres_cluster.new_database()


def pytest_report_header() -> str:
    """The PostgreSQL in use."""
    try:
        return f"PostgreSQL: {postgres.binaries()}"
    except RuntimeError as error:
        return f"PostgreSQL: none, tests that need it fail: {error}"


@pytest.fixture(autouse=True)
def _at_root(monkeypatch: pytest.MonkeyPatch) -> None:
    """Child processes find the packages from any directory."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))


@pytest.fixture(autouse=True)
def _signals_are_put_back() -> Iterator[None]:
    """Commands run in the test's process set signal handlers."""
    before = {number: signal.getsignal(number) for number in SIGNALS}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


# CPU time is reported only: it doubles on a loaded host, and first use of a library costs.
MOST_CPU_S = 4.0  # of an unmarked test; `make quick` omits those over 0.5 s
CPU_S = "cpu_s"
BEGAN_S, OF_WORKERS = pytest.StashKey[float](), pytest.StashKey[float]()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    item.stash[BEGAN_S] = _cpu_s()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item: pytest.Item) -> Generator[None, object, object]:
    """Includes teardown; shared fixtures count for the first and last test."""
    try:
        return (yield)
    finally:
        item.user_properties.append((CPU_S, round(_cpu_s() - item.stash[BEGAN_S], 2)))


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Report total CPU time, fixtures included, to the parent."""
    if (output := getattr(session.config, "workeroutput", None)) is not None:
        output[CPU_S] = _cpu_s()


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Add a pytest-xdist worker's time."""
    taken_s = getattr(node, "workeroutput", {}).get(CPU_S, 0.0)  # none of a crashed one
    node.config.stash[OF_WORKERS] = node.config.stash.get(OF_WORKERS, 0.0) + taken_s


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Print the total, and slow unmarked tests."""
    for report in terminalreporter.stats.get("", []):
        taken_s = dict(report.user_properties).get(CPU_S, 0.0)
        if taken_s > MOST_CPU_S and not {"slow", "processes", "nightly"} & report.keywords.keys():
            terminalreporter.line(
                f"{report.nodeid} took {taken_s:.1f} s of processor time: mark it slow, unless kernels compiled"
            )
    times = os.times()
    of_workers_s = times.user + times.system + config.stash.get(OF_WORKERS, 0.0)
    minutes, seconds = divmod(round(max(_cpu_s(), of_workers_s)), 60)
    terminalreporter.line(f"processor time {minutes}:{seconds:02}")


def _cpu_s() -> float:
    """CPU time of this process, its waited children, and forks."""
    times, forks = os.times(), sys.modules.get("tests.integration.forks")
    of_children_s = times.children_user + times.children_system + (forks.cpu_s() if forks else 0.0)
    return times.user + times.system + of_children_s
