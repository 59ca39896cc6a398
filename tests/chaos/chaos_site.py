"""A site of real processes that can be killed, frozen and cut off, with a final count."""

from __future__ import annotations

import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from agents.delivery.audit import read_audit
from mapserver.config import ServerConfig
from mapserver.journal.history import history_rows
from mapserver.journal.location import JOURNAL_FILE
from mapserver.journal.rows import Watermark
from mapserver.journal.shortfall import KIND, Shortfall, missing
from mapserver.journal.sqlite.reader import SqliteReader
from protocol.errors import StoreError
from protocol.machine.log_folder import open_log
from protocol.site.site_config import site_toml
from protocol.site.site_file import load_site
from protocol.wire.session import free_endpoint
from sitegrid.proof.delivery import audit_store
from tests.chaos.leashed import Process
from tests.chaos.outcome import Console, FaultOutcome, TimeSpan, longest_pause
from tests.chaos.recordings import IDLE, SECONDS, SPEED, START_NS, Recordings
from tests.journals import history_beside
from tests.memory import memory_mb

READY_S = 120.0  # first start in a new folder compiles kernels
RESUME_S = 60.0
ROUTER, SERVER, SECOND, WEB = "router", "server", "second", "web"  # second: a map server with its own store
COMMAND = ("-m", "sitegrid.cli")
HOUR_S = 3600
# Cheaper filter, short lag: the suite needs many valid, timely samples, not accurate ones. `window` and `parked` use
# the usual lag.
AGENT = """
linger_s = 20.0
[pipeline.localisation]
filter = "ekf"
lag_s = {lag_s}
"""
LAG_S = 8.0
# Frequent snapshots are written under faults too; the audit would exclude machines.
SERVER_TOML = "[store]\nsnapshot_s = 2.0\n[trust]\nexclude = false\n"
ALL_STOPPED = (signal.SIGCONT, signal.SIGTERM)


class StartError(Exception):
    """The site did not start, before any fault."""


class ChaosSite:
    """Router, map server and agents, for the length of the block.

    clock: the site's. first_ns: start of the first drives.
    """

    def __init__(
        self,
        folder: Path,
        recordings: Recordings,
        console: Console,
        *,
        clock: str = "data",
        first_ns: int = START_NS,
    ) -> None:
        for name in ("log", "spool", "audit", "store"):
            (folder / name).mkdir(parents=True)
        self.folder, self.console = folder, console
        self.machines = recordings.machines
        self.guests: tuple[str, ...] = ()  # names of machines without process, see guests.py
        self.endpoints = dict.fromkeys((ROUTER, SERVER, SECOND, WEB, *self.machines), free_endpoint())
        self.prefix: dict[str, tuple[str, ...]] = {}
        self.env: dict[str, dict[str, str]] = {}
        self.options: dict[str, tuple[str, ...]] = {}
        self.modules: dict[str, tuple[str, ...]] = {}
        self.speed, self.variant = SPEED, ""  # of the drives
        self.excuses: tuple[str, ...] = ()  # last words that allow a process to end and be restarted
        self.outcome = FaultOutcome("")
        self.faults: list[TimeSpan] = []
        self._ack_ms: list[int] = []
        self._recordings, self._first_ns = recordings, first_ns
        self._running: dict[str, Process] = {}
        self._starts, self._starts_of = 0, Counter[str]()
        site = replace(open_log(recordings.data(self.machines[0])).site, clock=clock)
        self.name = site.name
        (folder / "site.toml").write_text(site_toml(site), encoding="utf-8")
        (folder / "server.toml").write_text(SERVER_TOML, encoding="utf-8")
        self.set_lag(LAG_S)

    def __enter__(self) -> ChaosSite:
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._running.values():
            process.end()

    def set_lag(self, lag_s: float) -> None:
        """Set the smoother's lag of agents started from now on."""
        (self.folder / "agent.toml").write_text(AGENT.format(lag_s=lag_s), encoding="utf-8")

    # --- what runs ---------------------------------------------------------------------------------------------------

    def start_all(self) -> None:
        """Start everything, and wait for samples of every machine."""
        before = len(self.outcome.problems)
        for role in (ROUTER, SERVER, *self.machines):
            self.start(role)
            if role in (ROUTER, SERVER):
                self.wait_ready(role)
        self.wait(lambda: self.progress().keys() >= set(self.machines), READY_S, "no samples from every machine")
        ended = [f"{role}: {p.code} {p.last_words()}" for role, p in self._running.items() if p.code is not None]
        if wrong := [*self.outcome.problems[before:], *ended]:
            raise StartError("; ".join(wrong))

    def start(self, role: str, *, idle: bool = False) -> Process:
        """Start a router, server or agent; idle: only delivers its spool."""
        self._starts += 1
        self._starts_of[role] += 1
        words = self._words(role, IDLE if idle else self.variant)
        env = {"PYTHONUNBUFFERED": "1", **self.env.get(role, {})}
        log = self.folder / "log" / f"{self._starts:04d}-{role}"
        self._running[role] = Process(
            log, [*self.prefix.get(role, ()), sys.executable, *self.modules.get(role, COMMAND), *words], env
        )
        self.outcome.pids.append(self._running[role].pid)
        return self._running[role]

    def send(self, role: str, number: signal.Signals) -> None:
        self._running[role].send(number)

    def peak_mb(self, role: str) -> float:
        """Peak memory since the start, or since `forget_peak_mb`."""
        return memory_mb("VmHWM", self._running[role].pid)

    def forget_peak_mb(self, role: str) -> float:
        """Reset the peak; returns the current memory."""
        Path(f"/proc/{self._running[role].pid}/clear_refs").write_text("5", encoding="ascii")
        return memory_mb("VmRSS", self._running[role].pid)

    def kill(self, role: str) -> None:
        with self.fault():
            self._running[role].end(signal.SIGKILL)
            self.start(role)

    def put_down(self, role: str) -> None:
        """Kill a process for good."""
        self._running.pop(role).end(signal.SIGKILL)

    def words_of_refusal(self, role: str) -> str | None:
        """Wait until a started process works (None), or refuses: its last words."""
        process = self._running[role]
        self.wait(lambda: process.said("ready") or process.code is not None, READY_S, f"{role} is not ready")
        return process.last_words() if process.code is not None and not process.said("ready") else None

    def deliver_rest(self, machine: str) -> None:
        """Deliver a stopped machine's spool, without new samples."""
        process = self.start(machine, idle=True)
        self.wait(lambda: process.code is not None, RESUME_S, "left-over samples are not delivered")
        self._running.pop(machine).end()

    def log_of(self, role: str) -> str:
        """Logs of all processes of a role."""
        paths = sorted((self.folder / "log").glob(f"*-{role}.err"))
        return "".join(path.read_text(encoding="utf-8", errors="replace") for path in paths)

    def stop(self, role: str) -> None:
        """End a process with SIGTERM; it must obey within seconds."""
        process, began_s = self._running.pop(role), time.monotonic()
        code = process.end(*ALL_STOPPED)
        took_s = time.monotonic() - began_s
        self.outcome.notes["slowest end [s]"] = round(max(took_s, self.outcome.notes.get("slowest end [s]", 0)), 1)
        works = process.said("ready") and not process.said("ended")  # before and after, SIGTERM is Python's own
        if code and (code != -signal.SIGTERM or works):
            self.problem(f"{role} ended with {code} on SIGTERM: {process.last_words()}")
        self._note_report(process)

    def expect_end(self, role: str) -> tuple[int | None, str]:
        """Start what cannot run; returns exit code (None: it runs) and last words."""
        self.start(role)
        return self.wait_end(role)

    def wait_end(self, role: str) -> tuple[int | None, str]:
        """Wait for a process to end; returns exit code (None: it runs on) and last words."""
        process = self._running[role]
        self.wait(lambda: process.code is not None, READY_S, f"{role} runs on")
        return self._running.pop(role).code, process.last_words()

    def wait_ready(self, role: str) -> None:
        self.wait(lambda: self._running[role].said("ready"), READY_S, f"{role} is not ready")

    def wait_runs(self) -> None:
        """Wait for samples of every agent start in the journal."""

        def are_there() -> bool:
            self.tend()
            runs = Counter(machine for machine, _ in self._marks())
            return all(runs[machine] >= self._starts_of[machine] for machine in self.machines)

        self.wait(are_there, READY_S, "some runs have no samples")

    def wait_delivered(self) -> None:
        """Wait for everything recorded so far, agents running."""

        def is_there() -> bool:
            progress = self.progress()
            recorded = {machine: len(read_audit(self.folder / "audit" / machine)) for machine in self.machines}
            return all(progress.get(machine, 0) == n for machine, n in recorded.items())

        self.wait(is_there, RESUME_S, "recorded samples stay with their machines")

    def tend(self) -> None:
        """Restart ended processes; it is a problem unless a drive ended or an excuse applies."""
        for role, process in list(self._running.items()):
            if process.code is not None:
                words = process.last_words()
                if not process.said("ended") and not any(excuse in words for excuse in self.excuses):
                    self.problem(f"{role} ended with {process.code}: {words}")
                self._note_report(process)
                self.start(role)

    @contextmanager
    def fault(self) -> Iterator[None]:
        """Record how long a fault lasts."""
        began_s = time.time()
        try:
            yield
        finally:
            self.faults.append((began_s, time.time()))

    def linger(self, seconds: float) -> None:
        end_s = time.monotonic() + seconds
        while (left_s := end_s - time.monotonic()) > 0:
            self.console.wait(min(left_s, 0.25))
            self.tend()

    def problem(self, text: str) -> None:
        self.outcome.problems.append(text)

    # --- the end -----------------------------------------------------------------------------------------------------

    def finish(self, fault: str, count: int) -> FaultOutcome:
        """Wait until all machines are served, deliver everything, stop, count."""
        self.outcome.fault, self.outcome.count = fault, count
        ended_s = time.time()
        self._resume()
        resumed_s = time.time()
        self.outcome.notes["resumed after [s]"] = round(resumed_s - ended_s, 1)
        for machine in self.machines:
            self.stop(machine)
        for machine in self.machines:
            self.start(machine, idle=True)
        drained = [self._running[machine] for machine in self.machines]
        self.wait(lambda: all(p.code is not None for p in drained), RESUME_S, "left-over samples are not delivered")
        for machine, process in zip(self.machines, drained, strict=True):
            self._running.pop(machine)
            process.end()
            self._note_report(process)
            if process.code:
                self.problem(f"{process.log.name} could not deliver: {process.last_words()}")
        self.stop(SERVER)
        self.stop(ROUTER)
        self._count(ended_s, resumed_s)
        return self.outcome

    def progress(self) -> dict[str, int]:
        """Journalled samples by machine."""
        counts: Counter[str] = Counter()
        for (machine, _), mark in self._marks().items():
            counts[machine] += mark.seq
        return counts

    def _marks(self) -> Mapping[tuple[str, int], Watermark]:
        """Progress of all runs; empty while the journal is created or recovered."""
        try:
            with SqliteReader(self.folder / "store" / JOURNAL_FILE) as reader:
                return reader.watermarks()
        except StoreError:
            return {}

    def _note_report(self, process: Process) -> None:
        if report := process.line("ended"):
            self._ack_ms.append(report["uplink"]["ack_ms_max"])

    def _resume(self) -> None:
        before = self.progress()

        def is_served() -> bool:
            self.tend()  # a drive may be over
            progress = self.progress()
            return all(progress.get(machine, 0) > before.get(machine, 0) for machine in self.machines)

        self.wait(is_served, RESUME_S, "service does not resume")

    def _count(self, ended_s: float, resumed_s: float) -> None:
        audits = {machine: self.folder / "audit" / machine for machine in (*self.machines, *self.guests)}
        store, site = self.folder / "store", load_site(self.folder / "site.toml")
        result = audit_store(audits, store, site, ServerConfig())
        with SqliteReader(store / JOURNAL_FILE) as reader:
            rows = [(r.machine, r.received_ns * 1e-9) for r in history_rows(history_beside(reader))]
            declared = sum(mark.lost for mark in reader.watermarks().values())
            shortfalls = [Shortfall.from_event(event) for event in reader.events(KIND)]
            named = missing(shortfalls, reader.watermarks()).total()  # as in `info`, metrics and doctor
        out = self.outcome
        out.recorded, out.merged, out.double = result.recorded, result.merged, result.double
        out.declared = min(declared, result.lost)
        out.lost = result.lost - out.declared
        out.named = min(out.lost, named)
        out.silent = out.lost - out.named
        out.ack_ms_max = max(self._ack_ms, default=0)
        out.notes |= {"declared in all": declared, "unrecorded": result.unrecorded, "rows": len(rows)}
        if result.unrecorded:
            self.problem(f"{result.unrecorded} samples in the journal that nobody recorded")
        # Undo hour steps of the server's clock: no scenario lasts that long.
        true = [(name, s - round((s - ended_s) / HOUR_S) * HOUR_S) for name, s in rows]
        commits = {machine: [s for name, s in true if name == machine] for machine in self.machines}
        out.longest_pause_s = max(
            longest_pause([s for s in stamps if s < resumed_s], self.faults, resumed_s) for stamps in commits.values()
        )

    def wait(self, is_so: Callable[[], bool], timeout_s: float, problem: str) -> None:
        """Wait for a condition; its absence is a problem."""
        end_s = time.monotonic() + timeout_s
        while not is_so():
            if time.monotonic() > end_s:
                self.problem(f"{problem} within {timeout_s:g} s")
                return
            self.console.wait(0.05)

    def _words(self, role: str, variant: str) -> list[str]:
        where, site = ("--endpoint", self.endpoints[role]), ("--site-file", str(self.folder / "site.toml"))
        if role == ROUTER:
            return ["router", "--listen", self.endpoints[role], *self.options.get(role, ())]
        if role == WEB:
            return ["web", *where, "--site", self.name, *self.options.get(role, ())]
        if role in (SERVER, SECOND):
            folder = self.folder / ("store" if role == SERVER else SECOND)
            store = ("--store", str(folder), "--config", str(self.folder / "server.toml"))
            return ["server", *where, *site, *store, *self.options.get(role, ())]
        first_ns = self._first_ns + self._starts * SECONDS * 10**9
        manifest = self._recordings.manifest(self.folder / "log" / f"{self._starts}.toml", role, first_ns, variant)
        replay = ("--driver", "replay", "--log", manifest, "--data", self._recordings.data(role), "--speed", self.speed)
        files = ("--spool", self.folder / "spool" / f"{role}.db", "--audit", self.folder / "audit" / role)
        config = ("--config", self.folder / "agent.toml")
        return [str(word) for word in ("agent", *where, *site, *config, *replay, *files, "--json")]
