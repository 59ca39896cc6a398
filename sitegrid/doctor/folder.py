"""A folder of `sitegrid init`: files, ports, place and data, checked without starting anything."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

from agents.config import AgentConfig
from agents.drivers.can.config import all_signals
from agents.drivers.line import DECODERS, split_stream
from agents.drivers.tables import CAN, DriverConfig
from agents.drivers.transports import open_transport, why_closed
from protocol.errors import SitegridError, StoreError
from protocol.machine.machine_config import MachineConfig
from protocol.site.site_config import Projection, SiteConfig
from protocol.wire.session import is_free
from sitegrid.doctor import Finding, Level, disk, skipped
from sitegrid.setup.files import PORTS, Folder
from sitegrid.setup.hearing import HeardLine
from sitegrid.setup.hearing_bus import listen_to_bus
from sitegrid.setup.listening import listen_to

LISTEN_S = 2.5  # receivers send every second
FAR_M = 5000.0  # unusually far from the origin
UNFED = "nothing feeds it: name it in `feeds` of a [[driver]], or say `use = false`"


def examine_folder(path: Path) -> list[Finding]:
    """Check a folder; parts needing an unreadable file are skipped."""
    folder = Folder(path)
    try:
        site, machine, config = folder.load()
    except SitegridError as error:
        return [Finding(Level.FAIL, "files", str(error))]
    findings = [Finding(Level.PASS, "files", f"site {site.name}, machine {machine.name}: both files are whole")]
    findings += [*check_sensors(machine, config), _store(folder, site)]
    spool, runs = _spool(folder)
    findings += [spool, disk.check_disk("folder", disk.free_bytes(path))]
    if runs:
        return [*findings, *(skipped(check, "an agent runs in this folder") for check in ("receiver", "ports"))]
    taken = [str(port) for port in PORTS if not is_free(port)]
    return [*findings, *_receivers(site, config), check_ports(taken)]


def _store(folder: Folder, site: SiteConfig) -> Finding:
    if not folder.store.exists():
        return skipped("store", "`sitegrid up` makes it")
    try:
        return disk.check_store(disk.read_store(folder.store, time.time()), site)
    except SitegridError as error:
        return Finding(Level.FAIL, "store", str(error))


def _spool(folder: Folder) -> tuple[Finding, bool]:
    """The spool; whether an agent has it open."""
    if not folder.spool.exists():
        return skipped("spool", "`sitegrid up` makes it"), False
    try:
        return disk.check_spool(disk.read_spool(folder.spool), time.time_ns()), False
    except disk.InUseError:
        return skipped("spool", "an agent runs on it"), True
    except StoreError as error:
        return Finding(Level.FAIL, "spool", str(error)), False


def _receivers(site: SiteConfig, config: AgentConfig) -> list[Finding]:
    """Ports of drivers and corrections."""
    drivers = [driver for driver in config.driver if driver.kind in DECODERS]
    heard = listen_to([driver.address for driver in drivers], LISTEN_S)
    findings = [check_receiver(driver, at_port) for driver, at_port in zip(drivers, heard, strict=True)]
    for driver in (driver for driver in config.driver if driver.kind == CAN):
        at_bus = listen_to_bus(driver.address, LISTEN_S, all_signals(driver.signals, driver.dbc))
        # What it lacks of a whole machine may be fed from elsewhere.
        findings.append(check_receiver(driver, replace(at_bus, problem="") if at_bus.kind else at_bus))
    findings += [check_origin(site, at_port.place) for at_port in heard if at_port.place][:1]
    for address in set(config.corrections.ports) - {driver.address for driver in config.driver}:
        try:
            open_transport(address, config.corrections.baud).close()
        except OSError as error:
            findings.append(Finding(Level.FAIL, "corrections", f"{address}: {why_closed(error)}"))
    return findings or [skipped("receiver", "no [[driver]] reads one")]


def check_sensors(machine: MachineConfig, config: AgentConfig) -> list[Finding]:
    """Whether each sensor is fed and plausibly mounted."""
    fed = {name for driver in config.driver for name in driver.feeds.values()}
    are_ours = bool(config.driver) and all(driver.kind in (*DECODERS, CAN) for driver in config.driver)
    findings = []
    for sensor in machine.sensors:
        if are_ours and sensor.use and sensor.name not in fed:
            findings.append(Finding(Level.WARN, "sensors", f"{sensor.name}: {UNFED}"))
        if sensor.kind == "gps" and not any(sensor.mount.xyz_m):
            advice = "measure it by tape: ahead, left and up of the point on the ground below the rear axle's middle"
            findings.append(Finding(Level.WARN, "sensors", f"{sensor.name}: its mount is 0, 0, 0", advice))
    return findings or [Finding(Level.PASS, "sensors", "each is fed")]


def check_receiver(driver: DriverConfig, heard: HeardLine) -> Finding:
    """Whether the bytes at a driver's port fit its table."""
    where = f"{driver.address}: "
    if heard.kind and heard.kind != driver.kind:
        advice = f'say `kind = "{heard.kind}"`, or set it to send {driver.kind.upper()}'
        return Finding(Level.FAIL, "receiver", f"{where}it sends {heard.kind.upper()}", advice)
    if not heard.kind:
        return Finding(Level.FAIL, "receiver", f"{where}{heard.problem}")
    absent = [key for key in driver.feeds if split_stream(key)[1] not in heard.streams]
    if driver.baud and heard.baud not in (0, driver.baud):
        return Finding(Level.WARN, "receiver", f"{where}it sends at {heard.baud} baud", f"say `baud = {heard.baud}`")
    if absent:
        return Finding(
            Level.WARN, "receiver", f"{where}nothing comes for {', '.join(absent)}", "switch its messages on"
        )
    return Finding(Level.WARN if heard.problem else Level.PASS, "receiver", where + (heard.problem or _fix_of(heard)))


def check_origin(site: SiteConfig, place: tuple[float, ...]) -> Finding:
    """Whether a receiver is near the site's origin."""
    lat_deg, lon_deg, height_m = place
    x_m, y_m, _ = Projection(site).to_map(lat_deg, lon_deg, height_m)
    away_m = max(abs(x_m), abs(y_m))
    if away_m <= FAR_M:
        return Finding(Level.PASS, "origin", f"{away_m:.0f} m from here")
    refused = "" if away_m <= site.extent_m else ", so all fixes are refused (extent_m)"
    advice = f"a site of this place has origin_lat_deg = {lat_deg:.6f}, origin_lon_deg = {lon_deg:.6f}, and a new store"
    level = Level.FAIL if refused else Level.WARN
    return Finding(level, "origin", f"{away_m / 1000:.0f} km from here{refused}", advice)


def check_ports(taken: list[str]) -> Finding:
    """Whether the usual ports are free."""
    if taken:
        return Finding(Level.WARN, "ports", f"taken: {', '.join(taken)}", "`sitegrid up` takes others")
    return Finding(Level.PASS, "ports", "those of router and page are free")


def _fix_of(heard: HeardLine) -> str:
    fix = f"; {heard.quality}, {heard.satellites} satellites" if heard.place else ""
    return f"{heard.kind} feeds {', '.join(heard.streams)}{fix}"
