"""Settings for all tests."""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy starts them: small matrices, and tests side by side
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # or each process that a test starts compiles all sources

import signal
from collections.abc import Generator, Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from sitegrid.process.lifetime import SIGNALS
from tests import postgres_server as postgres
from tests.paths import ROOT, SHARED_DATA

# A shell starts what it runs in the background with SIGINT ignored, nohup with SIGHUP, and so would be all processes of
# the tests.
for number, handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, handler)

# Repeatable on every machine, and no complaint about a slow one.
settings.register_profile("repeatable", derandomize=True, deadline=None, database=None, print_blob=True)
settings.load_profile("repeatable")


@pytest.fixture(scope="session")
def root() -> Path:
    """The project's root."""
    return ROOT


@pytest.fixture(scope="session")
def husky_data() -> Path:
    """The real Husky log; skipped where it is not at hand."""
    folder = SHARED_DATA / "rl_test1_husky"
    if not folder.exists():
        pytest.skip("the Husky log is not beside the project (../shared/data/rl_test1_husky)")
    return folder


@pytest.fixture(scope="session")
def postgres_cluster() -> Iterator[postgres.Cluster]:
    """A real PostgreSQL server, one for all tests of a process."""
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
    """Which PostgreSQL the tests use."""
    try:
        return f"PostgreSQL: {postgres.binaries()}"
    except RuntimeError as error:
        return f"PostgreSQL: none, tests that need it fail: {error}"


@pytest.fixture(autouse=True)
def _at_root(monkeypatch: pytest.MonkeyPatch) -> None:
    """Child processes find the packages from wherever pytest was started."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))


@pytest.fixture(autouse=True)
def _signals_are_put_back() -> Iterator[None]:
    """Commands that run inside the test's process set signal handlers."""
    before = {number: signal.getsignal(number) for number in SIGNALS}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


# `make quick` leaves out what takes longer than about half a second of processor time, quietly run. Processor time
# doubles on a loaded machine, and a library's first use costs some: what takes far longer is named, and fails nothing.
MOST_CPU_S = 4.0


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, object, object]:
    """Note a test that takes long and does not say so."""
    began_s = _cpu_s()
    outcome = yield
    taken_s = _cpu_s() - began_s
    if taken_s > MOST_CPU_S and not any(item.iter_markers("slow")) and not any(item.iter_markers("processes")):
        item.user_properties.append(("cpu_s", taken_s))
    return outcome


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Name the tests that took long and do not say so."""
    for report in terminalreporter.stats.get("passed", []):
        for name, taken_s in report.user_properties:
            if name == "cpu_s":
                terminalreporter.line(f"{report.nodeid} took {taken_s:.1f} s of processor time: mark it slow")


def _cpu_s() -> float:
    """Processor time of this process and of the children that it waited for."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system
