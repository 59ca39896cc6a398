"""The map fed back in real processes: machines draw it, use its lanes, continue without a server."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
import zenoh

from protocol.queries.lanes import LanesQuery
from protocol.wire import keys
from protocol.wire.codec import decode_health
from protocol.wire.session import free_endpoint
from sim.config import SimConfig
from tests.integration.forks import Forks
from tests.integration.site_run import SiteRun, kill  # beside this file
from tests.patience import until

pytestmark = [pytest.mark.processes, pytest.mark.nightly]
# Waits last as long as machines drive: an hour that no machine spends on lanes is a failure.
DRIVEN = SimConfig(scenario="paper_site_driven", machines=4, seconds=3600, speed=3, seed=3, world="fast")


class Driving(SiteRun):
    """A site of another scenario."""

    def start_sim(self, *options: str | Path):
        return super().start_sim("--scenario", self.sim.scenario, *options)


@pytest.mark.timeout(3600)  # a busy host takes 20 minutes
def test_machines_follow_the_lanes_that_they_drew_also_while_the_server_is_down(tmp_path: Path):
    with Forks(tmp_path) as children:
        run = Driving(tmp_path, children, free_endpoint(), DRIVEN)
        _, server, driving = run.start()
        with run.connect() as client:
            heard: dict[str, int] = {}
            used: dict[str, int] = {}

            def note(sample: zenoh.Sample) -> None:
                health = decode_health(sample.payload.to_bytes())
                heard[health.machine] = health.stamp_ns
                if (health.values["lanes"] or {}).get("used"):
                    used[health.machine] = health.stamp_ns

            def follow_for(seconds: float) -> None:
                """Wait until all machines used lanes that much longer in their own time."""
                before = dict(used)
                until(
                    lambda: len(used) == 4 and all(used[m] > before.get(m, 0) + seconds * 1e9 for m in used),
                    "machines on lanes",
                    progress=heard.copy,
                )

            subscriber = client.session.declare_subscriber(keys.health_all(run.site), note)
            follow_for(0)
            assert client.ask(LanesQuery()).tiles
            kill(server)
            follow_for(60)
            run.start_server()
            follow_for(10)
            driving.send(signal.SIGTERM)
            reports = run.delivered(progress=heard.copy)
            subscriber.undeclare()
        assert all(report["lanes"]["squares"] > 20 for report in reports.values())
        assert all(report["lanes"]["counters"]["lanes_bytes"] < 40_000 for report in reports.values())
        assert run.server.stop() == 0
        audit = run.audit()
        assert (audit.lost, audit.double, audit.unrecorded) == (0, 0, 0)
