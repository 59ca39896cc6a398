"""One machine's process: driver -> pipeline -> spool -> uplink; also publishes pose and health."""

import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zenoh

from agents.config import AgentConfig
from agents.corrections.delivery import CorrectionsDelivery
from agents.delivery.audit import AuditLog
from agents.delivery.spool import Spool
from agents.delivery.uplink import Uplink
from agents.delivery.uplink_thread import Check, Sign, UplinkThread, linger
from agents.delivery.write_buffer import WriteBuffer
from agents.drivers import Driver
from agents.estimation.calibration_file import CalibrationFile
from agents.holdout import Holdout
from agents.lane_link import LaneLink
from agents.pipeline import Pipeline
from agents.presence import Presence
from agents.recorder import ReadingsRecorder
from agents.sampling import Samples
from agents.status import Status, described
from protocol.errors import StoreError
from protocol.machine.machine_config import MachineConfig
from protocol.site.site_config import SiteConfig
from protocol.wire.owners import Owner

log = logging.getLogger("agents.agent")

EVERY_S = 1.0  # interval of writing samples, each a disk sync, and of showing health
SILENT_S = 10.0  # real time without a new pose after which the smoother is not awaited: the machine may be off


@dataclass(frozen=True)
class Places:
    """Files of an agent; audit and calibration are optional."""

    spool: Path
    audit: Path | None = None
    calibration: Path | None = None


class Agent:
    """Runs one machine until its stream ends or it is stopped."""

    def __init__(
        self,
        session: zenoh.Session,
        site: SiteConfig,
        machine: MachineConfig,
        config: AgentConfig,
        places: Places,
        *,
        withhold: bool = False,
        owner: Owner | None = None,
        corrections: CorrectionsDelivery | None = None,
        sign: Sign | None = None,
        check: Check | None = None,
    ) -> None:
        self._config = config
        self._calibration_file = CalibrationFile(places.calibration, machine.name)
        self._pipeline = Pipeline(site, machine, config.pipeline, self._calibration_file.read())
        self._holdout = Holdout(site, machine, config.holdout) if withhold else None
        self._spool = Spool(places.spool, config.spool, AuditLog(places.audit) if places.audit else None)
        if problem := self._calibration_file.problem:
            log.warning("calibration not used problem=%r", problem)
        if self._spool.damage:
            log.error("recorded samples are gone spool=%s problem=%r", places.spool, self._spool.damage)
        self._presence = Presence(session, site.name, machine.name, owner)
        self._uplink = Uplink(machine.name, site.frame, config.uplink.timeout_s)
        self._uplink_thread = UplinkThread(session, site.name, self._uplink, self._spool, sign, check)
        self._corrections = corrections
        self._recorder = ReadingsRecorder(config.record, site.name, machine) if config.record.folder else None
        self._lane_link = LaneLink(session, site.name) if self._pipeline.lanes else None
        self._unsaved, self._spool_problem = WriteBuffer(), ""
        self._status, self._clocks, self._unsampled = Status(machine), "", ""
        self._faults: dict[str, str] = {}  # of sensors, as last logged
        self._readings = 0
        self._samples = 0
        self._newest_ns = 0
        self._heard_s = self._now_s = 0.0  # time of the last readings, and now

    def run(
        self,
        driver: Driver,
        is_stopped: Callable[[], bool],
        clock: Callable[[], float] = time.monotonic,
        wait: Callable[[float], object] = time.sleep,
        show: Callable[[dict[str, Any]], None] = lambda _: None,
    ) -> dict[str, Any]:
        """Process readings until the stream ends or `is_stopped`; returns a report, which `show` gets each second."""
        second_s = moved_s = self._heard_s = clock()
        while not is_stopped():
            readings = driver.read(0.2)
            if readings is None:
                break
            self._now_s = clock()
            if readings:
                self._heard_s = self._now_s
            if self._step(list(readings)):
                moved_s = clock()
            elif self._pipeline.pose and clock() - moved_s > SILENT_S:
                self._take(self._pipeline.settle())
                moved_s = math.inf  # once: without a pose there is no sample
            if clock() >= second_s:
                second_s = clock() + EVERY_S
                self._write()
                if self._recorder:
                    self._recorder.tend()
                self._consider_offer()
                self._take_lanes()
                self._calibration_file.write(self._pipeline.calibration)
                self._yield_name()
                self._tell_faults()
                self._show(driver, show)
        driver.close()
        self._take(self._pipeline.finish())
        self._write()
        self._calibration_file.write(self._pipeline.calibration)
        self._show(driver, show)
        delivered = linger(self._is_delivered, wait, clock, 0.0 if is_stopped() else self._config.linger_s)
        return {**self._show(driver, lambda _: None), "delivered": delivered}

    def report(self, driver: Driver) -> dict[str, Any]:
        """Health in plain values."""
        known = self._known(driver)
        return described(self._status.judge(known)) | known

    def _known(self, driver: Driver) -> dict[str, Any]:
        uplink, owner = self._uplink, self._presence.owner
        spool = {**self._spool.counters(), "unsaved": len(self._unsaved), "given_up": self._unsaved.given_up}
        self._clocks = self._pipeline.clocks()
        return {
            "host": owner.host,
            "pid": owner.pid,
            "readings": self._readings,
            "samples": self._samples,
            "heard": self._status.heard,
            "acknowledged": max(self._samples - spool["depth"], 0),
            "silent_s": round(self._now_s - self._heard_s, 1),
            "clocks": self._clocks,
            "driver": dict(driver.counters()),
            "driver_problems": list(driver.problems()),
            "pipeline": self._pipeline.health(),
            "spool": spool,
            "spool_problem": self._spool_problem,
            "spool_damage": self._spool.damage,
            "calibration_problem": self._calibration_file.problem,
            "uplink": {
                "problem": uplink.held or uplink.problem,
                "counters": dict(uplink.counters),
                "ack_ms_max": round(uplink.ack_s_max * 1e3),
            },
            "holdout": self._holdout.report() if self._holdout else None,
            "corrections": self._corrections.report() if self._corrections else None,
            "record": self._recorder.report() if self._recorder else None,
            "lanes": self._lanes(),
        }

    def close(self) -> None:
        """Stop the uplink, leave the network, close the spool."""
        if self._corrections:
            self._corrections.close()
        if self._recorder:
            self._recorder.close()
        self._uplink_thread.close()
        self._presence.close()
        self._spool.close()

    def _step(self, readings: list[Any]) -> bool:
        """Process readings; returns whether the pose is new."""
        self._readings += len(readings)
        if readings:
            self._newest_ns = readings[-1].stamp_ns
        if self._recorder:
            self._recorder.take(readings)
        before = self._pipeline.pose
        self._status.take(readings)
        self._take(self._pipeline.step(self._holdout.split(readings) if self._holdout else readings))
        if self._holdout:
            self._holdout.compare(self._pipeline)
        pose = self._pipeline.pose
        if pose:
            self._presence.show_pose(pose)
        return pose is not before

    def _take(self, made: Samples) -> None:
        self._unsaved.add(made.pending, made.final)
        if len(made.pending):
            self._status.sampled()

    def _show(self, driver: Driver, show: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
        """Publish and return a report; log once why samples are missing."""
        clocks, report = self._clocks, self.report(driver)
        if (why := self._status.unsampled) and not self._unsampled:
            log.warning("samples are missing why=%r", why)
        if self._clocks and not clocks:
            log.warning("clocks are apart why=%r", self._clocks)
        self._unsampled = why
        self._presence.show_health(self._newest_ns, report)
        show(report)
        return report

    def _tell_faults(self) -> None:
        """Log sensor faults as they begin and end."""
        before, self._faults = self._faults, self._pipeline.faults
        for name, fault in self._faults.items() - before.items():
            log.warning("a sensor does not count sensor=%s why=%r", name, fault)
        for name in before.keys() - self._faults.keys():
            log.info("a sensor counts again sensor=%s", name)

    def _write(self) -> None:
        """Write to the spool; with a full or failing disk, samples wait in memory."""
        if self._unsaved.is_clean:
            return
        try:
            self._samples += self._unsaved.write(self._spool)
        except StoreError as error:
            self._spool_problem = str(error)
            return
        self._spool_problem = ""
        self._uplink_thread.wake()

    def _consider_offer(self) -> None:
        offer, self._uplink.offer = self._uplink.offer, None  # a lost one comes again
        if offer is not None:
            self._pipeline.consider(offer)

    def _take_lanes(self) -> None:
        """Use the newest lanes around the machine, else the earlier ones."""
        aid, link = self._pipeline.lanes, self._lane_link
        if aid and link and (lanes := link.look(self._pipeline.pose)):
            aid.lanes = lanes

    def _lanes(self) -> dict[str, Any] | None:
        aid, link = self._pipeline.lanes, self._lane_link
        return {**aid.report(), "counters": dict(link.counters)} if aid and link else None

    def _yield_name(self) -> None:
        """Send nothing while an earlier agent of this name runs; samples wait in the spool."""
        rival = self._presence.look_around()
        self._uplink.held = (
            f"another agent of this name runs as {rival}: it sends, this one waits; stop one of them" if rival else ""
        )

    def _is_delivered(self) -> bool:
        self._write()
        return self._unsaved.is_clean and self._spool.is_settled()
