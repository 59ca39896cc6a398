"""Faults of the network: a proxy with bad weather on loopback, and a real cable between namespaces."""

from __future__ import annotations

from contextlib import ExitStack
from enum import Enum
from functools import partial

from tests.chaos.chaos_site import ROUTER, SERVER, ChaosSite
from tests.chaos.net_namespace import OFFICE_IP, Cable, NotPermittedError
from tests.chaos.outcome import FaultOutcome
from tests.chaos.scenario import FaultRun
from tests.chaos.tcp_proxy import FAIR, Proxy, Weather


class Storm(Enum):
    """Weather, and how long it may last [s]: a hold is shorter and longer than an ack's time-out and a link's lease."""

    CUT = Weather(cut=True), (0.5, 2.0, 6.0)
    BLACK_HOLE = Weather(hold_there=True, hold_back=True), (1.0, 4.0, 12.0)
    SLOW = Weather(bytes_per_s=4000), (3.0, 6.0)
    LATE_REPLIES = Weather(hold_back=True), (1.0, 4.0, 6.0)
    LATE_REQUESTS = Weather(hold_there=True), (1.0, 4.0)
    LATE_THEN_CUT = Weather(hold_back=True), (2.0, 4.0)


def proxy(scenario: FaultRun) -> FaultOutcome:
    """Bad weather between agents and router, or between server and router."""
    with scenario.site() as site, ExitStack() as opened:
        port = int(site.endpoints[ROUTER].rpartition(":")[2])
        proxies = [opened.enter_context(Proxy(port)) for _ in range(2)]
        site.endpoints |= dict.fromkeys(site.machines, proxies[0].endpoint) | {SERVER: proxies[1].endpoint}
        site.start_all()
        count = _weather(scenario, site, proxies)
        return site.finish(scenario.fault, count)


def _weather(scenario: FaultRun, site: ChaosSite, proxies: list[Proxy]) -> int:
    rng, left_s, storms = scenario.rng, scenario.seconds, list(Storm)
    rng.shuffle(storms)
    count = 0
    while left_s > 0:
        storm, side = storms[count % len(storms)], rng.randrange(2)
        weather, lengths = storm.value
        pause_s, lasts_s = rng.uniform(0.5, 1.5), min(rng.choice(lengths), max(1.0, left_s))
        scenario.say(f"{storm.name.lower()} at {('agents', 'server')[side]} for {lasts_s:.1f} s")
        site.linger(pause_s)
        with site.fault():
            proxies[side].set(weather)
            site.linger(lasts_s)
            if storm is Storm.LATE_THEN_CUT:
                proxies[side].set(Weather(cut=True))
            proxies[side].set(FAIR)
        left_s, count = left_s - pause_s - lasts_s, count + 1
    return count


def cable(scenario: FaultRun) -> FaultOutcome:
    """Machines in a network namespace of their own, whose link goes down or gets slow."""
    try:
        with Cable() as made, scenario.site() as site:
            return _pull(scenario, site, made)
    except NotPermittedError as error:
        return FaultOutcome(scenario.fault, skipped=str(error))


def _pull(scenario: FaultRun, site: ChaosSite, made: Cable) -> FaultOutcome:
    endpoint = f"tcp/{OFFICE_IP}:7447"
    site.endpoints = dict.fromkeys(site.endpoints, endpoint)
    site.prefix = {role: made.inside(made.office) for role in (ROUTER, SERVER)}
    site.prefix |= {machine: made.inside(made.machines) for machine in site.machines}
    site.options[ROUTER] = ("--insecure",)
    site.start_all()
    rng, left_s, count = scenario.rng, scenario.seconds, 0
    while left_s > 0:
        is_slow, kbit_s, pause_s = rng.random() < 0.4, rng.choice((64, 300)), rng.uniform(0.5, 1.5)
        lasts_s = min(rng.choice((1.0, 4.0, 8.0, 14.0)), max(1.0, left_s))
        scenario.say(f"link {f'at {kbit_s} kbit/s' if is_slow else 'down'} for {lasts_s:.1f} s")
        begin = partial(made.limit, kbit_s) if is_slow else partial(made.set_link, up=False)
        end = partial(made.limit, 0) if is_slow else partial(made.set_link, up=True)
        site.linger(pause_s)
        with site.fault():
            begin()
            site.linger(lasts_s)
            end()
        left_s, count = left_s - pause_s - lasts_s, count + 1
    return site.finish(scenario.fault, count)
