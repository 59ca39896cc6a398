"""Clock steps of an hour, forth and back, of the server and of the machines."""

from __future__ import annotations

import time

from tests.chaos import stepped_clock
from tests.chaos.chaos_site import HOUR_S, SERVER
from tests.chaos.outcome import FaultOutcome
from tests.chaos.scenario import FaultRun

MACHINES = "machines"
DRIVES_BEFORE_NS = 105 * 60 * 10**9
STEPS_S = (
    {SERVER: HOUR_S},
    {SERVER: -HOUR_S},
    {MACHINES: HOUR_S},
    {MACHINES: -HOUR_S},
    {SERVER: -HOUR_S, MACHINES: HOUR_S},  # samples come from the future, and are refused until the server is back
)


def clocks(scenario: FaultRun) -> FaultOutcome:
    """Step the wall clock of the server or of all machines by an hour, and back; the site refuses what is to come.

    The server is also started anew while its clock is wrong: then it archives what looks old.
    """
    rng, left_s, count = scenario.rng, scenario.seconds, 0
    with scenario.site(clock="wall", first_ns=time.time_ns() - DRIVES_BEFORE_NS) as site:
        files = {name: site.folder / f"clock-{name}" for name in (SERVER, MACHINES)}
        for name, path in files.items():
            stepped_clock.write(path, 0)
            roles = site.machines if name == MACHINES else (name,)
            site.modules |= dict.fromkeys(roles, ("-m", "tests.chaos.stepped_clock", str(path)))
        site.start_all()
        while left_s > 0:
            steps_s, pause_s, lasts_s = rng.choice(STEPS_S), rng.uniform(0.5, 1.5), rng.uniform(1.0, 4.0)
            steps = ", ".join(f"{name} {step_s:+d} s" for name, step_s in steps_s.items())
            scenario.say(f"clock of {steps} for {lasts_s:.1f} s")
            site.linger(pause_s)
            with site.fault():
                for name, step_s in steps_s.items():
                    stepped_clock.write(files[name], step_s * 10**9)
                if SERVER in steps_s and rng.random() < 0.5:
                    site.kill(SERVER)
                site.linger(lasts_s)
                for path in files.values():
                    stepped_clock.write(path, 0)
            left_s, count = left_s - pause_s - lasts_s, count + 2 * len(steps_s)
        return site.finish(scenario.fault, count)
