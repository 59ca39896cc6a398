"""A real log in the demo: replayed by an agent of its own into a site with a map server of its own."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from evaluation.audit import audit_store
from mapserver.config import ServerConfig
from protocol.machine.log_folder import LogFolder
from sitegrid.client import connect
from sitegrid.demo.parts import READY_S, start_server
from sitegrid.demo.plan import DemoPlan
from sitegrid.pictures.draw import draw
from sitegrid.pictures.tracks import TrackRecorder
from sitegrid.process.children import Children, wait_until

LOG_SPEED = 20.0  # times real time


class LogReplay:
    """The agent and the map server of one log."""

    def __init__(self, plan: DemoPlan, log: LogFolder, children: Children) -> None:
        assert plan.manifest is not None
        self._site = log.site
        self._machine = log.machine.name
        self._server = start_server(plan, children, "log-server", plan.manifest)
        self._client = connect(plan.endpoint, log.site.name)
        self._tracks = TrackRecorder(self._client.session, log.site.name)
        files = ("--spool", plan.work / "log.db", "--audit", plan.work / "log.audit")
        source = ("--driver", "replay", "--log", plan.manifest, "--data", log.data, "--speed", LOG_SPEED)
        words = ("agent", "--endpoint", plan.endpoint, *source, *files, "--withhold", "--json")
        self._agent = children.start("log-agent", *words)

    def finish(self, plan: DemoPlan) -> dict[str, Any]:
        """Wait for the agent, draw its map, compare with its audit file."""
        report = self._agent.expect("ended", 300.0)["ended"]
        wait_until(lambda: self._client.info().merged == self._client.info().journalled, READY_S, "log-server")
        picture = plan.out / "log-map.png"
        draw(self._client, picture, None, self._tracks.tracks())
        self._tracks.close()
        self._client.close()
        self._server.stop()
        audits = {self._machine: plan.work / "log.audit"}
        audit = audit_store(audits, plan.work / "store-log-server", self._site, ServerConfig())
        withheld = {f"withheld_{key}": value for key, value in report["holdout"].items()}
        return {"name": self._machine, **asdict(audit), **withheld, "picture": str(picture)}
