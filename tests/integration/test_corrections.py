"""Corrections through real processes: caster to receiver's port, and health."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from protocol.wire import keys
from protocol.wire.codec import decode_health
from protocol.wire.session import free_endpoint
from sitegrid import connect
from tests.integration.forks import Forks
from tests.integration.site_run import NOBODY_DRIVES, SiteRun
from tests.patience import PATIENCE_S, until
from tests.unit.agents.corrections.caster import Caster, sends
from tests.unit.agents.corrections.test_delivery import SAID, Receiver

pytestmark = pytest.mark.processes


def test_a_caster_s_frames_reach_a_receiver_and_its_refusal_the_health(tmp_path: Path) -> None:
    receiver, health = Receiver(), dict[str, Any]()

    def on_health(sample: Any) -> None:
        health.update(decode_health(sample.payload.to_bytes()).values)

    refusing = Caster(sends(b"HTTP/1.1 401 Unauthorized\r\n\r\n"))
    with Forks(tmp_path) as children, receiver.caster:
        site = SiteRun(tmp_path, children, free_endpoint(), NOBODY_DRIVES)
        table = f'\n[corrections]\nbase = "base-1"\nports = ["{receiver.address}"]\n'
        (config,) = site.configs
        config.write_text(config.read_text(encoding="utf-8") + table, encoding="utf-8")
        relay = tmp_path / "corrections.toml"
        source = f"ntrip://127.0.0.1:{refusing.port}/NORTH"
        relay.write_text(f'name = "base-1"\nsource = "{source}"\nuser = "me"\npassword = "x"\n', encoding="utf-8")
        site.start_router()
        site.start_agents()
        words = ("--endpoint", site.endpoint, "--site-file", site.site_file, "--config", relay, "--json")
        started = children.start("relay", "corrections", *words)
        started.expect("ready", PATIENCE_S)
        with connect(site.endpoint, site.site) as client:
            client.session.declare_subscriber(keys.health(site.site, config.stem), on_health)

            def of_corrections() -> dict[str, Any]:
                return dict(health.get("corrections") or {})

            until(lambda: "refuses NORTH to user 'me'" in of_corrections().get("problem", ""), "a refusal in health")
            assert of_corrections()["age_s"] is None
            refusing.kill()
            with Caster(sends(b"ICY 200 OK\r\n", SAID.frames), port=refusing.port):
                until(lambda: receiver.heard == SAID.frames, "frames at the receiver")
                until(lambda: of_corrections().get("age_s") is not None, "their age in health")
                assert not of_corrections()["problem"]
            until(lambda: "nobody listens" in of_corrections()["problem"], "the dead caster in health")
        assert started.stop() == 0
