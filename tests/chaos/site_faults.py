"""Faults of processes, links, clocks and disks on a working site."""

from __future__ import annotations

import random
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from enum import Enum

from tests.chaos import stepped_clock
from tests.chaos.chaos_site import HOUR_S, ROUTER, SERVER
from tests.chaos.disk_shim import DiskError, FailingDisk, build
from tests.chaos.net_namespace import OFFICE_IP, Cable, NotPermittedError
from tests.chaos.outcome import FaultOutcome
from tests.chaos.scenario import FaultRun, Spell
from tests.tcp_proxy import FAIR, Proxy, Weather

KILLS = 250  # in the whole suite, at least LEAST
LEAST = 100
FREEZES_S = (1.0, 3.5, 8.0, 13.0)  # around an acknowledgement's timeout (3 s) and a link's lease (10 s)
CABLE_S = (1.0, 4.0, 8.0, 14.0)
MACHINES = "machines"
DRIVES_BEFORE_NS = 105 * 60 * 10**9
STEPS_S = (
    {SERVER: HOUR_S},
    {SERVER: -HOUR_S},
    {MACHINES: HOUR_S},
    {MACHINES: -HOUR_S},
    {SERVER: -HOUR_S, MACHINES: HOUR_S},  # samples from the future, refused until the server is back
)
# Messages of SQLite and the system; such processes must end and are restarted.
EXCUSES = (
    *("disk I/O error", "database or disk is full", "unable to open database file"),
    *("No space left", "Input/output"),
)


class Storm(Enum):
    """Weather and durations [s]: holds around an acknowledgement's timeout and a link's lease."""

    CUT = Weather(cut=True), (0.5, 2.0, 6.0)
    BLACK_HOLE = Weather(hold_there=True, hold_back=True), (1.0, 4.0, 12.0)
    SLOW = Weather(bytes_per_s=4000), (3.0, 6.0)
    LATE_REPLIES = Weather(hold_back=True), (1.0, 4.0, 6.0)
    LATE_REQUESTS = Weather(hold_there=True), (1.0, 4.0)
    LATE_THEN_CUT = Weather(hold_back=True), (2.0, 4.0)


def draw_kills(rng: random.Random, machines: tuple[str, ...], n: int, seconds: float) -> list[tuple[float, str]]:
    """Victims with pauses before each [s], `seconds` in total: bursts and calms."""
    victims = [*machines, *(ROUTER, SERVER) * 2]
    pauses = [rng.expovariate(1.0) ** 2 for _ in range(n)]
    scale = seconds / sum(pauses)
    return [(pause * scale, rng.choice(victims)) for pause in pauses]


def kills(scenario: FaultRun) -> FaultOutcome:
    """Kill -9 agents, server and router in random order, even while starting."""
    n = scenario.strikes or max(LEAST, round(KILLS * scenario.scale))
    with scenario.site() as site:
        plan = draw_kills(scenario.rng, site.machines, n, scenario.seconds)
        scenario.say(f"{n} within {scenario.seconds:.0f} s")
        site.start_all()
        for pause_s, victim in plan:
            site.linger(pause_s)
            site.kill(victim)
        return site.finish(scenario.fault, n)


def freezes(scenario: FaultRun) -> FaultOutcome:
    """SIGSTOP server and router for a while."""

    @contextmanager
    def frozen(victim: str) -> Iterator[None]:
        site.send(victim, signal.SIGSTOP)
        yield
        site.send(victim, signal.SIGCONT)

    def draw(rng: random.Random, n: int) -> Spell:
        victim = (SERVER, ROUTER)[n % 2]
        return Spell(f"{victim} frozen", rng.choice(FREEZES_S), frozen(victim))

    with scenario.site() as site:
        return scenario.strike(site, draw)


def proxy(scenario: FaultRun) -> FaultOutcome:
    """Bad weather between agents or server and router."""
    storms = scenario.rng.sample(list(Storm), len(Storm))

    @contextmanager
    def stormy(side: int, storm: Storm) -> Iterator[None]:
        proxies[side].set(storm.value[0])
        yield
        if storm is Storm.LATE_THEN_CUT:
            proxies[side].set(Weather(cut=True))
        proxies[side].set(FAIR)

    def draw(rng: random.Random, n: int) -> Spell:
        storm, side = storms[n % len(storms)], rng.randrange(2)
        words = f"{storm.name.lower()} at {('agents', 'server')[side]}"
        return Spell(words, rng.choice(storm.value[1]), stormy(side, storm))

    with scenario.site() as site:
        port = int(site.endpoints[ROUTER].rpartition(":")[2])
        with Proxy(port) as of_agents, Proxy(port) as of_server:
            proxies = (of_agents, of_server)
            site.endpoints |= dict.fromkeys(site.machines, of_agents.endpoint) | {SERVER: of_server.endpoint}
            return scenario.strike(site, draw)


def cable(scenario: FaultRun) -> FaultOutcome:
    """Machines in their own network namespace; the link goes down or slow."""

    def draw(rng: random.Random, _: int) -> Spell:
        kbit_s, lasts_s = rng.choice((64, 300)), rng.choice(CABLE_S)
        if rng.random() < 0.4:
            return Spell(f"link at {kbit_s} kbit/s", lasts_s, made.slow(kbit_s))
        return Spell("link down", lasts_s, made.down())

    try:
        with Cable() as made, scenario.site() as site:
            site.endpoints = dict.fromkeys(site.endpoints, f"tcp/{OFFICE_IP}:7447")
            site.prefix = {role: made.inside(made.office) for role in (ROUTER, SERVER)}
            site.prefix |= {machine: made.inside(made.machines) for machine in site.machines}
            site.options[ROUTER] = ("--insecure",)
            return scenario.strike(site, draw)
    except NotPermittedError as error:
        return FaultOutcome(scenario.fault, skipped=str(error))


def clocks(scenario: FaultRun) -> FaultOutcome:
    """Step the wall clock of server or machines by an hour and back; future samples are refused.

    The server is also restarted with its wrong clock: it then archives what looks old.
    """
    counts: list[int] = []

    @contextmanager
    def stepped(steps_s: dict[str, int], *, is_killed: bool) -> Iterator[None]:
        for name, step_s in steps_s.items():
            stepped_clock.write(files[name], step_s * 10**9)
        if is_killed:
            site.kill(SERVER)
        yield
        for path in files.values():
            stepped_clock.write(path, 0)
        counts.append(2 * len(steps_s))

    def draw(rng: random.Random, _: int) -> Spell:
        steps_s = rng.choice(STEPS_S)
        words = "clock of " + ", ".join(f"{name} {step_s:+d} s" for name, step_s in steps_s.items())
        is_killed = SERVER in steps_s and rng.random() < 0.5
        return Spell(words, rng.uniform(1.0, 4.0), stepped(steps_s, is_killed=is_killed))

    with scenario.site(clock="wall", first_ns=time.time_ns() - DRIVES_BEFORE_NS) as site:
        files = {name: site.folder / f"clock-{name}" for name in (SERVER, MACHINES)}
        for name, path in files.items():
            stepped_clock.write(path, 0)
            roles = site.machines if name == MACHINES else (name,)
            site.modules |= dict.fromkeys(roles, ("-m", "tests.chaos.stepped_clock", str(path)))
        return scenario.strike(site, draw, counts)


def disks(scenario: FaultRun) -> FaultOutcome:
    """All writes of store or spools fail for seconds; sometimes the process is killed meanwhile."""
    counts: list[int] = []

    @contextmanager
    def broken(disk: FailingDisk, error: DiskError, victim: str) -> Iterator[None]:
        with disk.failing(error):
            yield
            counts.append(disk.failed)
            if victim:
                site.send(victim, signal.SIGKILL)
        if victim:
            site.kill(victim)

    def draw(rng: random.Random, _: int) -> Spell:
        name, error = rng.choice(tuple(by_name)), rng.choice(tuple(DiskError))
        victim = (SERVER if name == "store" else rng.choice(site.machines)) if rng.random() < 0.3 else ""
        words = f"{name} {error.name.lower()}{f', {victim} killed' if victim else ''}"
        return Spell(words, rng.uniform(0.5, 4.0), broken(by_name[name], error, victim))

    with scenario.site() as site:
        if not (library := build(site.folder)):
            return FaultOutcome(scenario.fault, skipped="no C compiler for the shim")
        top, site.excuses = site.folder, EXCUSES
        by_name = {name: FailingDisk(library, top / name, top / f"{name}.bin") for name in ("store", "spool")}
        site.env = {SERVER: by_name["store"].env, **dict.fromkeys(site.machines, by_name["spool"].env)}
        return scenario.strike(site, draw, counts)
