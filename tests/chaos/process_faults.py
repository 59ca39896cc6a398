"""Faults of processes: killed at once, or frozen for a while."""

from __future__ import annotations

import random
import signal

from tests.chaos.chaos_site import ROUTER, SERVER
from tests.chaos.outcome import FaultOutcome
from tests.chaos.scenario import FaultRun

KILLS = 250  # of the whole suite; never fewer than LEAST
LEAST = 100
FREEZES_S = (1.0, 3.5, 8.0, 13.0)  # shorter and longer than an ack's time-out (3 s) and a link's lease (10 s)


def draw_kills(rng: random.Random, machines: tuple[str, ...], n: int, seconds: float) -> list[tuple[float, str]]:
    """Victims, and how long to wait before each [s], together `seconds`: bursts, and calms in which work is done."""
    victims = [*machines, *(ROUTER, SERVER) * 2]
    pauses = [rng.expovariate(1.0) ** 2 for _ in range(n)]
    scale = seconds / sum(pauses)
    return [(pause * scale, rng.choice(victims)) for pause in pauses]


def kills(scenario: FaultRun) -> FaultOutcome:
    """Kill -9 of agents, server and router in random order, also while they start."""
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
    """SIGSTOP of server and router for a while, then SIGCONT."""
    rng, used_s, count = scenario.rng, 0.0, 0
    with scenario.site() as site:
        site.start_all()
        while used_s < scenario.seconds:
            victim, pause_s = (SERVER, ROUTER)[count % 2], rng.uniform(0.5, 1.5)
            lasts_s = min(rng.choice(FREEZES_S), max(1.0, scenario.seconds - used_s))
            scenario.say(f"{victim} frozen for {lasts_s:.1f} s")
            site.linger(pause_s)
            with site.fault():
                site.send(victim, signal.SIGSTOP)
                site.linger(lasts_s)
                site.send(victim, signal.SIGCONT)
            used_s, count = used_s + pause_s + lasts_s, count + 1
        return site.finish(scenario.fault, count)
