"""A base station's process: driver -> corrections -> Zenoh. It shows health, and holds its name, as a machine does."""

import logging
import time
from collections.abc import Callable
from typing import Any

import zenoh

from agents.base_station import BaseStation
from agents.config import AgentConfig
from agents.drivers import Driver
from agents.presence import Presence
from protocol.machine.machine_config import MachineConfig
from protocol.machine.readings import Correction
from protocol.site.site_config import Projection, SiteConfig
from protocol.wire import keys
from protocol.wire.correction_codec import encode_correction
from protocol.wire.messages import SiteCorrection
from protocol.wire.owners import Owner

log = logging.getLogger("agents.base_agent")

HEALTH_S = 1.0


class BaseAgent:
    """Runs one base station until its stream ends or it is stopped."""

    def __init__(
        self,
        session: zenoh.Session,
        site: SiteConfig,
        machine: MachineConfig,
        config: AgentConfig,
        owner: Owner | None = None,
    ) -> None:
        """machine: name and receivers of the base."""
        projection = Projection(site)
        latitude_deg, longitude_deg = config.place
        x_m, y_m, _ = projection.to_map(latitude_deg, longitude_deg, site.origin_height_m)
        self._frame = site.frame
        self._station = BaseStation(machine.name, machine.sensors, (x_m, y_m), projection)
        self._presence = Presence(session, site.name, machine.name, owner)
        drop = zenoh.CongestionControl.DROP  # the next one replaces it
        key = keys.corrections(site.name, machine.name)
        self._publisher = session.declare_publisher(key, congestion_control=drop)
        self._readings = self._newest_ns = 0
        self._rival, self._problem = "", ""

    def run(
        self, driver: Driver, is_stopped: Callable[[], bool], clock: Callable[[], float] = time.monotonic
    ) -> dict[str, Any]:
        """Take readings until the stream ends or `is_stopped`; returns a report in plain values."""
        health_s = clock()
        while not is_stopped():
            readings = driver.read(0.2)
            if readings is None:
                break
            self._readings += len(readings)
            self._newest_ns = max([self._newest_ns, *(r.stamp_ns for r in readings)])
            for correction in self._station.step(readings):
                self._publish(correction)
            if clock() >= health_s:
                health_s = clock() + HEALTH_S
                self._look_around()
                self._presence.show_health(self._newest_ns, self.report(driver))
        driver.close()
        report = self.report(driver)
        self._presence.show_health(self._newest_ns, report)
        return report

    def report(self, driver: Driver) -> dict[str, Any]:
        """Health in plain values."""
        owner = self._presence.owner
        return {
            "role": "base",
            "host": owner.host,
            "pid": owner.pid,
            "readings": self._readings,
            "driver": dict(driver.counters()),
            "base": self._station.health(),
            "held": self._rival,
        }

    def close(self) -> None:
        """Leave the network."""
        self._publisher.undeclare()  # type: ignore[no-untyped-call]
        self._presence.close()

    def _publish(self, correction: Correction) -> None:
        """Say what the base is off; nothing while an earlier agent of its name runs."""
        if not self._rival:
            self._publisher.put(encode_correction(SiteCorrection(self._frame, correction)))

    def _look_around(self) -> None:
        """Log what an operator should mend, once."""
        rival = self._presence.look_around()
        self._rival = f"another agent of this name runs as {rival}: it publishes; stop one of them" if rival else ""
        problem = self._rival or self._station.problem
        if problem and problem != self._problem:
            log.warning("base problem=%r", problem)
        self._problem = problem
