"""A base station beside machines, as real processes: corrections are used, and fade when the base is killed."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from protocol.site.site_file import load_site
from protocol.wire import keys
from protocol.wire.codec import decode_health
from protocol.wire.correction_codec import decode_correction
from protocol.wire.messages import SiteCorrection
from protocol.wire.session import free_endpoint
from sim.config import SimConfig
from sitegrid import connect
from sitegrid.process.children import Child, Children
from tests.integration.site_run import SiteRun
from tests.patience import PATIENCE_S, until

pytestmark = [pytest.mark.processes, pytest.mark.nightly]
SIM = SimConfig(scenario="base_station", machines=1, seed=3, world="fast", seconds=600.0, speed=6.0)


class BaseRun(SiteRun):
    """A site with one base station."""

    def start_base(self) -> Child:
        words = ("--endpoint", self.endpoint, "--site-file", self.site_file, "--config", self.folder / "base-1.toml")
        base = self.children.start("base-1", "agent", *words, "--json")
        base.expect("ready", PATIENCE_S)
        return base

    def start_sim(self) -> Child:
        options = {
            name: getattr(self.sim, name) for name in ("scenario", "seconds", "speed", "machines", "seed", "world")
        }
        words = [word for name, value in options.items() for word in (f"--{name}", value)]
        return self.children.start("sim", "sim", "--endpoint", self.endpoint, *words, "--json")


@pytest.fixture
def site(tmp_path: Path) -> Iterator[BaseRun]:
    with Children(tmp_path) as children:
        yield BaseRun(tmp_path, children, free_endpoint(), SIM)


@contextlib.contextmanager
def watching(site: BaseRun) -> Iterator[tuple[dict[str, dict[str, Any]], list[SiteCorrection]]]:
    """The newest health of everybody, and what the base says."""
    health: dict[str, dict[str, Any]] = {}
    said: list[SiteCorrection] = []
    frame = load_site(site.site_file).frame

    def on_health(sample: Any) -> None:
        report = decode_health(sample.payload.to_bytes())
        health[report.machine] = dict(report.values)

    with connect(site.endpoint, site.site) as client:
        subscribers = [
            client.session.declare_subscriber(keys.health_all(site.site), on_health),
            client.session.declare_subscriber(
                keys.corrections(site.site, "base-1"),
                lambda sample: said.append(decode_correction(sample.payload.to_bytes(), frame)),
            ),
        ]
        yield health, said
        for subscriber in subscribers:
            subscriber.undeclare()


def of_base(health: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """What the machine makes of the base."""
    report = health.get("loader-1", {}).get("pipeline", {}).get("base")
    return dict(report or {})


def test_machine_uses_a_base_until_that_is_killed(site: BaseRun) -> None:
    site.start_router()
    base = site.start_base()
    site.start_agents()
    with watching(site) as (health, said):
        site.start_sim()
        until(lambda: bool(of_base(health).get("used")), "corrections used")
        assert of_base(health)["age_s"] < 5.0
        assert health["base-1"]["role"] == "base"
        assert health["base-1"]["base"]["counters"]["corrections"] > 0
        assert len(said) > 10
        stamps = [message.correction.stamp_ns for message in said]
        assert stamps == sorted(set(stamps))
        base.send(signal.SIGKILL)
        until(lambda: "s old" in of_base(health).get("why_not", ""), "the silence noticed")
        assert of_base(health)["used"] is False
        again = site.start_base()
        until(lambda: bool(of_base(health).get("used")), "corrections used again")
        again.stop()


def test_second_base_of_a_name_does_not_start(site: BaseRun) -> None:
    site.start_router()
    site.start_base()
    words = ("--endpoint", site.endpoint, "--site-file", site.site_file, "--config", site.folder / "base-1.toml")
    second = site.children.start("second", "agent", *words, "--json")
    until(lambda: second.code is not None, "the second base ended")
    assert second.code == 1
    assert "runs already" in (site.folder / "second.log").read_text(encoding="utf-8")
