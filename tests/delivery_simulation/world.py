"""Machines, link and map server in one thread under seeded faults, and the final invariants.

Agents are the real `Spool` and `Uplink` with the real `perform`; the server is the real rules of admission on a
modelled journal, or the real store. Time is a number. Faults stop eventually; then everything must settle.
"""

from __future__ import annotations

import contextlib
import random
import shutil
import sqlite3
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from agents.delivery import uplink_thread
from agents.delivery.spool import SpoolConfig
from agents.delivery.uplink import Action, Pacing, Uplink, UplinkConfig, Wait
from agents.delivery.write_buffer import WriteBuffer
from mapserver.ingest.store import Incoming
from protocol.arrays import Table
from protocol.errors import StoreError
from protocol.machine.samples import SAMPLE_DTYPE, empty
from protocol.site.site_config import SiteConfig
from protocol.wire.codec import decode_reply, encode_reply
from protocol.wire.messages import Ack, Refused
from tests.delivery_simulation.faults import Fault, FaultPlan, FaultySpool, Killed, draw_rates
from tests.delivery_simulation.servers import ModelServer, RealServer

START_NS = 1_767_225_600_000_000_000
HOUR_NS = 3_600_000_000_000
TIMEOUT_S = UplinkConfig().timeout_s
PACING = Pacing(first_batch=4, max_batch=16)
MOST_ROUNDS = 3000  # to settle without faults


class SimulatedAgent:
    """A machine's process, its file, and its history."""

    def __init__(self, name: str, machine: str, path: Path) -> None:
        self.name, self.machine, self.path = name, machine, path
        self.spool: FaultySpool | None = None
        self.uplink: Uplink | None = None
        self.plan = FaultPlan()
        self.clock_ns = 0
        self.start()

    def start(self) -> None:
        """Memory of a fresh process, and what its disk may hold."""
        self.buffer = WriteBuffer()
        self.pending: list[bytes] = []  # samples it will finalise, in order
        self.unwritten: dict[int, bytes] = {}  # values possibly on disk, by stamp
        self.before_drop: set[int] = set()


@dataclass
class Outcome:
    """Fate of all samples. lost, double: must be 0. explained: dropped, quarantined or gone with a disk."""

    seed: int
    recorded: int = 0
    journalled: int = 0
    explained: int = 0
    lost: int = 0
    double: int = 0
    problems: list[str] = field(default_factory=list)
    events: Counter[str] = field(default_factory=Counter)

    @property
    def is_good(self) -> bool:
        return not (self.lost or self.double or self.problems)


class World:
    """One seed's site."""

    def __init__(
        self, seed: int, folder: Path, *, real: bool = False, say: Callable[[str], None] | None = None
    ) -> None:
        self.rng = random.Random(seed)
        self.rates = draw_rates(self.rng)
        self.outcome = Outcome(seed)
        self._say = say
        self._folder = folder
        self._now_ns = START_NS
        site = SiteConfig("lot", 49.01, 8.4, 120.0, clock="wall" if self.rates.wall_clock else "data")
        self._frame = site.frame
        self._server = RealServer(folder, site, self._now) if real else ModelServer(site, self._now)
        self._server_up = True
        self._late: list[Incoming] = []
        self._agents = [
            SimulatedAgent(f"agent-{i}", f"loader-{i}", folder / f"{i}.db") for i in range(self.rates.machines)
        ]
        self._copies: dict[str, Path] = {}
        self._contents: dict[int, bytes] = {}  # every recorded sample's value, by stamp
        self._copied: dict[int, set[bytes]] = {}  # values that a copy may send instead
        self._explained: set[int] = set()
        self._faults = True
        self._numbers = iter(range(10**9))
        self.note(f"{type(self._server).__name__} {self.rates}")
        for agent in self._agents:
            self._start(agent)

    def run(self) -> Outcome:
        """Run events, settle, judge."""
        for _ in range(self.rates.steps):
            self._now_ns += self.rng.randint(1, 2_000_000_000)
            self._step()
        self._settle()
        self._judge()
        for agent in self._agents:
            if agent.spool:
                agent.spool.kill()
        return self.outcome

    def note(self, text: str) -> None:
        if self._say:
            self._say(text.replace(str(self._folder), "."))

    def close(self) -> None:
        if isinstance(self._server, RealServer):
            self._server.close()

    # --- what happens ------------------------------------------------------------------------------------------------

    def _step(self) -> None:
        agent = self.rng.choice(self._agents)
        weights: dict[Callable[..., object], int] = {
            self._record: 30,
            self._exchange: 45,
            self._deliver_late: 5,
            self._end: 4,
            self._start: 6,
            self._finalise: 8,
            self._step_clock: 1,
            self._change_server: 4,
            self._copy_or_restore: 2,
        }
        self.rng.choices(list(weights), list(weights.values()))[0](agent)

    def _record(self, agent: SimulatedAgent) -> None:
        """Record samples, final or pending."""
        if not agent.spool:
            return
        rows = [self._sample(agent) for _ in range(self.rng.randint(1, 6))]
        is_final = not (self.rates.pending or agent.pending)
        agent.buffer.add(_table(rows), _table(rows) if is_final else empty())
        agent.pending += [] if is_final else rows
        agent.unwritten |= {_stamp(row): row for row in rows}
        self._write(agent)

    def _finalise(self, agent: SimulatedAgent, n: int = 0) -> None:
        """Finalise the n oldest pending samples; 0: some."""
        if not agent.spool or not agent.pending:
            return
        n = n or self.rng.randint(1, len(agent.pending))
        better = _table(agent.pending[:n]).copy()
        better["x_m"] += 0.25
        del agent.pending[:n]
        agent.buffer.add(empty(), better)
        agent.unwritten |= {_stamp(row.tobytes()): row.tobytes() for row in better}
        self._write(agent)

    def _write(self, agent: SimulatedAgent) -> None:
        """Write to disk; in vain if full."""
        assert agent.spool
        before = self._present(agent) | agent.unwritten.keys()
        with self._spool_faults(agent):
            agent.before_drop = before
            n = agent.buffer.write(agent.spool)
            self.note(f"{agent.name} wrote {n} and {len(agent.unwritten) - n} final values, {agent.spool.counters()}")
            self._is_recorded(agent)
            self._explained |= before - self._present(agent)  # dropped by the bounded spool

    def _exchange(self, agent: SimulatedAgent) -> float:
        """One exchange of the uplink; returns its requested pause [s]."""
        if not agent.spool or not agent.uplink:
            return 0.0

        def ask(payload: bytes) -> tuple[Ack | Refused | None, float]:
            reply, took_s = self._send(Incoming(agent.machine, payload))
            self.note(f"{agent.name} received {reply}")
            return reply, took_s

        with self._spool_faults(agent):
            errors = agent.uplink.counters["disk_errors"]
            action: Action = agent.uplink.start_exchange()
            while not isinstance(action, Wait):
                action = uplink_thread.perform(action, agent.uplink, agent.spool, ask)
            if agent.uplink.counters["disk_errors"] > errors:
                self.outcome.events["disk_full"] += 1
                self.note(f"{agent.name}: {agent.uplink.problem}")
            return 0.0 if action.for_samples else action.seconds
        return 0.0

    def _send(self, incoming: Incoming) -> tuple[Ack | Refused | None, float]:
        timeout_s = TIMEOUT_S
        if self._happens(self.rates.lost):
            return None, timeout_s
        if self._happens(self.rates.late):
            self._late.append(incoming)
            return None, timeout_s
        if self._happens(self.rates.twice):
            self._late.append(incoming)
        if not self._server_up:
            return None, 0.0
        answer = self._take(incoming)
        if answer is None or self._happens(self.rates.reply_lost):
            return None, timeout_s
        return decode_reply(encode_reply(answer)), self.rng.uniform(0.0, timeout_s)

    def _take(self, incoming: Incoming) -> Ack | Refused | None:
        """Pass a request to the server, grouped with late ones; None if it dies before replying."""
        group = [incoming]
        while self._late and self._faults and self.rng.random() < 0.3:
            group.insert(self.rng.randint(0, len(group)), self._late.pop(self.rng.randrange(len(self._late))))
        plan = FaultPlan()
        if self._happens(self.rates.server_fault):
            plan.arm(self.rng.choice(list(Fault)), self.rng.randint(1, 6))
            self.note(f"server {plan.fault} at {plan.left}")
        try:
            answers = self._server.take(group, plan)
        except Killed:
            self.outcome.events["server_kills"] += 1
            return None
        return next(answer for one, answer in zip(group, answers, strict=True) if one is incoming)

    def _deliver_late(self, *_: object) -> None:
        if self._late and self._server_up:
            incoming = self._late.pop(self.rng.randrange(len(self._late)))
            answer = self._take(incoming)
            self.note(f"late request of {incoming.machine} answered {answer}, received by nobody")
            self.outcome.events["late"] += 1

    def _start(self, agent: SimulatedAgent) -> None:
        if agent.spool:
            return
        agent.plan = FaultPlan()
        options = {"config": SpoolConfig(self.rates.max_samples), "draw_id": lambda: self.rng.getrandbits(63)}
        try:
            with self._spool_faults(agent):
                agent.spool = FaultySpool(agent.path, agent.plan, **options)
        except StoreError as error:
            self.note(f"{agent.name} cannot start: {error}")
        if not agent.spool:
            return
        agent.uplink = Uplink(agent.machine, self._frame, TIMEOUT_S, PACING, np.random.default_rng(0))
        present = self._present(agent)
        self._end_doubt(agent, self._rows(agent.path))
        self.note(f"{agent.name} started with {len(present)} samples, spool_id={agent.spool.spool_id:x}")

    def _end_doubt(self, agent: SimulatedAgent, present: dict[int, bytes]) -> None:
        """Determine whether the transaction of a killed process was done; memory starts empty.

        The file's contents will be sent, even without their final values.
        """
        for stamp in agent.unwritten.keys() & present.keys():
            self._contents[stamp] = present[stamp]
        if any(present.get(stamp) == row for stamp, row in agent.unwritten.items()):
            self._explained |= agent.before_drop - present.keys()
        agent.start()

    def _end(self, agent: SimulatedAgent, orderly: bool | None = None) -> None:
        if agent.spool:
            orderly = self.rng.random() < 0.5 if orderly is None else orderly
            self.note(f"{agent.name} ends orderly={orderly}")
            self.outcome.events["agent_ends"] += 1
            agent.spool.close() if orderly else agent.spool.kill()
            agent.spool, agent.uplink = None, None

    def _copy_or_restore(self, agent: SimulatedAgent) -> None:
        """Copy the spool; restore it later; or start a second process from it."""
        if not self.rates.copies:
            return
        copy = self._copies.get(agent.machine)
        if copy is None:
            copy = self._copy(agent.path, self._folder / f"copy-{next(self._numbers)}.db")
            self._copies[agent.machine] = copy
            for stamp, row in self._rows(copy).items():  # the copy never learns pending final values
                self._copied.setdefault(stamp, set()).add(row)
            self.note(f"{agent.name} copied")
        elif self.rng.random() < 0.5:
            # Gone with the discarded disk; quarantined samples are declared lost, the copy's too.
            self._explained |= self._held(agent.path) - self._held(copy) | self._quarantined(agent.path)
            self._end(agent, orderly=False)
            self._end_doubt(agent, self._rows(agent.path))
            self._copy(copy, agent.path)
            self.outcome.events["spool_restores"] += 1
            self.note(f"{agent.name} restored from a copy")
        elif len(self._agents) < 4:
            name = f"clone-{next(self._numbers)}"
            clone = SimulatedAgent(name, agent.machine, self._copy(copy, self._folder / f"{name}.db"))
            self._agents.append(clone)
            self.outcome.events["clones"] += 1
            self.note(f"{clone.name} is a clone of a copy of {agent.machine}")
            self._start(clone)

    def _step_clock(self, agent: SimulatedAgent) -> None:
        agent.clock_ns = self.rng.choice((-HOUR_NS, 0, HOUR_NS))
        self.note(f"{agent.name} clock off by {agent.clock_ns / HOUR_NS:+.0f} h")

    def _change_server(self, *_: object) -> None:
        """Toggle, back up or restore the server."""
        draw = self.rng.random()
        if draw < 0.6 or not self.rates.server_backups:
            self._server_up = not self._server_up
            self.note(f"server up={self._server_up}")
            return
        if draw < 0.85:
            self._server.back_up()
            self.note("server backed up")
            return
        before = {_stamp(one.row) for one in self._server.samples()}
        self._server.restore()
        self._explained |= before - {_stamp(one.row) for one in self._server.samples()}
        self.outcome.events["server_restores"] += 1
        self.note("server restored")

    # --- the end -----------------------------------------------------------------------------------------------------

    def _settle(self) -> None:
        """Without faults everything recorded arrives."""
        self.note("--- faults stop ---")
        self._faults, self._server_up = False, True
        self._now_ns += 2 * HOUR_NS
        while self._late:
            self._deliver_late()
        for agent in self._agents:
            self._start(agent)
            self._finalise(agent, len(agent.pending))
            self._write(agent)
        self._deliver_all()
        for agent in self._agents:  # the next start declares samples quarantined or dropped at a run's end
            self._end(agent, orderly=True)
            self._start(agent)
        self._deliver_all()

    def _deliver_all(self) -> None:
        for _ in range(MOST_ROUNDS):
            waiting = [a for a in self._agents if a.spool and not a.spool.is_settled()]
            if not waiting:
                return
            agent = self.rng.choice(waiting)  # two of one name alternate
            self._now_ns += int(self._exchange(agent) * 1e9)
        self.outcome.problems.append(f"not settled after {MOST_ROUNDS} rounds")

    def _judge(self) -> None:
        outcome = self.outcome
        samples = list(self._server.samples())
        by_stamp = Counter(_stamp(one.row) for one in samples)
        by_identity = Counter(one[:3] for one in samples)
        outcome.double = max(sum(n - 1 for n in counts.values()) for counts in (by_stamp, by_identity))
        for agent in self._agents:
            self._explained |= self._quarantined(agent.path)
        right = {_stamp(one.row) for one in samples if self._is_right(one.row)}
        missing = self._contents.keys() - right
        outcome.recorded, outcome.journalled = len(self._contents), len(right)
        outcome.explained = len(missing & self._explained)
        outcome.lost = len(missing - self._explained)
        for stamp in sorted(missing - self._explained):
            self.note(f"lost: stamp {stamp}")
        if foreign := by_stamp.keys() - self._contents.keys():
            outcome.problems.append(f"{len(foreign)} samples that nobody recorded")
        self._judge_marks([(one.machine, one.spool_id) for one in samples])
        self._judge_counters()

    def _judge_marks(self, runs: list[tuple[str, int]]) -> None:
        """Per run, present and declared lost samples make up the watermark."""
        present = Counter(runs)
        for run, (seq, lost) in self._server.marks().items():
            if present[run] + lost != seq:
                self.outcome.problems.append(f"run {run[1]:x}: {present[run]} there + {lost} lost is not {seq}")

    def _judge_counters(self) -> None:
        """Unless files were copied or discarded, agents counted all missing samples."""
        events = self.outcome.events
        if events["spool_restores"] or events["clones"] or events["server_restores"]:
            return
        counters = [agent.spool.counters() for agent in self._agents if agent.spool]
        counted = sum(each["dropped"] + each["put_aside"] for each in counters)
        never = self.outcome.explained
        if counted < never:
            self.outcome.problems.append(f"{never} never arrived, {counted} are counted")
        if (declared := sum(lost for _, lost in self._server.marks().values())) != never:
            self.outcome.problems.append(f"{never} never arrived, {declared} were declared lost")

    # --- helpers -----------------------------------------------------------------------------------------------------

    @contextlib.contextmanager
    def _spool_faults(self, agent: SimulatedAgent):
        """Possible fault at a coming statement of an agent's file."""
        if self._happens(self.rates.spool_fault):
            agent.plan.arm(self.rng.choice(list(Fault)), self.rng.randint(1, 9))
        try:
            yield
        except Killed:
            self.note(f"{agent.name} was killed")
            self.outcome.events["agent_kills"] += 1
            if agent.spool:
                agent.spool.kill()
            agent.spool, agent.uplink = None, None
        except StoreError as error:
            self.note(f"{agent.name}: {error}")
            self.outcome.events["disk_full"] += 1
            if not agent.plan.struck:
                self.outcome.problems.append(f"{agent.name} cannot use a disk that is sound")
        finally:
            agent.plan.disarm()

    def _happens(self, rate: float) -> bool:
        return self._faults and self.rng.random() < rate

    def _now(self) -> int:
        return self._now_ns

    def _sample(self, agent: SimulatedAgent) -> bytes:
        row = empty(1)
        row["stamp_ns"] = self._now_ns + agent.clock_ns + next(self._numbers)
        row["cov_xx_m2"] = row["cov_yy_m2"] = 1.0
        row["c_rr"] = 99.0 if self.rng.random() < self.rates.bad_sample else 0.05
        return row.tobytes()

    def _is_recorded(self, agent: SimulatedAgent) -> None:
        self._contents |= agent.unwritten
        agent.unwritten = {}

    def _is_right(self, row: bytes) -> bool:
        stamp = _stamp(row)
        return row == self._contents.get(stamp) or row in self._copied.get(stamp, ())

    def _present(self, agent: SimulatedAgent) -> set[int]:
        with agent.spool._lock:
            return _stamp_set(row for (row,) in agent.spool._db.execute("SELECT row FROM sample"))

    def _held(self, path: Path) -> set[int]:
        return set(self._rows(path))

    def _rows(self, path: Path, table: str = "sample") -> dict[int, bytes]:
        """Rows by stamp, from a copy of a file that may be open."""
        with contextlib.closing(sqlite3.connect(self._copy(path, self._folder / "look.db"))) as db:
            try:
                return {_stamp(row): row for (row,) in db.execute(f"SELECT row FROM {table}")}
            except sqlite3.OperationalError:  # killed while creating the file
                return {}

    def _quarantined(self, path: Path) -> set[int]:
        return set(self._rows(path, "quarantine"))

    def _copy(self, source: Path, target: Path) -> Path:
        """Copy a database with its log, between transactions."""
        for suffix in ("", "-wal"):
            other = Path(f"{target}{suffix}")
            other.unlink(missing_ok=True)
            with contextlib.suppress(FileNotFoundError):
                shutil.copyfile(f"{source}{suffix}", other)
        return target


def _stamp(row: bytes) -> int:
    return int.from_bytes(row[:8], "little")


def _stamp_set(rows) -> set[int]:
    return {_stamp(row) for row in rows}


def _table(rows: list[bytes]) -> Table:
    return np.frombuffer(b"".join(rows), SAMPLE_DTYPE)
