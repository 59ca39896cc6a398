"""The examination of this host's part of a site: probe, check, and collect the findings."""

from __future__ import annotations

import time
from argparse import Namespace
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import zenoh

from protocol.errors import ConfigError, SitegridError, StoreError
from protocol.site.site_config import SiteConfig, load_site
from protocol.version import UNKNOWN, package_version
from protocol.wire import keys
from protocol.wire.credentials import Identity, load_credentials
from protocol.wire.keys import check_name
from sitegrid.doctor import checks, probes
from sitegrid.doctor.checks import ASKS_MAP, Finding, Level, skipped
from sitegrid.security.join import join

ANYBODY = "doctor"  # where there are no keys, every name is as good


@dataclass(frozen=True)
class Patient:
    """What is looked at, as far as it is known. machine: empty where these keys send no samples."""

    endpoint: str
    site: str
    machine: str
    keys: Path | None
    identity: Identity | None
    site_file: SiteConfig | None
    spool: Path | None
    store: Path | None


def examine(arguments: Namespace) -> list[Finding]:
    """Check what is given."""
    findings, patient = _keys(arguments)
    findings += _network(patient) if patient else [skipped("router", "these keys cannot be used")]
    return findings + _store(arguments.store, patient.site_file if patient else None)


def _patient(arguments: Namespace, identity: Identity | None) -> Patient:
    site_file = load_site(arguments.site_file) if arguments.site_file else None
    named = site_file.name if site_file else identity.site if identity else "paper"
    machine = arguments.machine or ""
    if not machine and (identity is None or identity.role == "machine"):
        machine = identity.name if identity else ANYBODY
    site = check_name(arguments.site or named, "--site")
    if machine:
        check_name(machine, "--machine")
    files = (arguments.keys, identity, site_file, arguments.spool, arguments.store)
    return Patient(arguments.endpoint, site, machine, *files)


# --- keys ------------------------------------------------------------------------------------------------------------


def _keys(arguments: Namespace) -> tuple[list[Finding], Patient | None]:
    """Findings on the keys, and with usable ones what else is to be looked at."""
    if arguments.keys is None:
        return [skipped("certificate", "give --keys FOLDER, if the site has keys")], _patient(arguments, None)
    try:
        patient = _patient(arguments, load_credentials(arguments.keys).identity)
        found = probes.read_certificate(arguments.keys)
    except ConfigError as error:
        return [Finding(Level.FAIL, "certificate", str(error))], None
    except ModuleNotFoundError:
        return [skipped("certificate", "pip install 'sitegrid[security]'")], patient
    site = arguments.site or (patient.site_file.name if patient.site_file else "")
    findings = checks.check_certificate(found, datetime.now(UTC), site, arguments.machine or "")
    return findings, patient if findings[0].level != Level.FAIL else None


# --- network ---------------------------------------------------------------------------------------------------------


def _network(patient: Patient) -> list[Finding]:
    link, session = probes.open_link(join(patient.endpoint, patient.keys, probes.LINK_S))
    if session is None:
        rest = [skipped(name, "no way to the router") for name in ("server", "clock", "version", "permission")]
        return [checks.check_link(link), *rest, *_spool(patient, None)]
    try:
        return [checks.check_link(link), *_server(patient, session), *_spool(patient, session)]
    finally:
        session.close()  # type: ignore[no-untyped-call]


def _server(patient: Patient, session: zenoh.Session) -> list[Finding]:
    role = patient.identity.role if patient.identity else ""
    if role and role not in ASKS_MAP:
        return [skipped(name, f"keys of a {role} may not ask") for name in ("server", "clock", "version", "permission")]
    info, asked_ns = probes.ask_info(session, patient.site)
    is_there = info is not None or probes.is_answered(session, keys.map_query(patient.site, "info"))
    findings = [checks.check_server(patient.site, info, is_there=is_there, role=role)]
    if info is not None:
        findings += _compared(patient, info, asked_ns)
    return [*findings, _permission(patient, session, info)]


def _compared(patient: Patient, info: Mapping[str, Any], asked_ns: tuple[int, int]) -> list[Finding]:
    """What only a comparison with the map server shows."""
    site, offset = patient.site_file, probes.offset_of(info, asked_ns)
    version = info.get("version", UNKNOWN)
    return [
        checks.check_site(site, info) if site else skipped("site", "give --site-file FILE to compare"),
        checks.check_clock(*offset, site) if offset else skipped("clock", "the map server does not tell its own"),
        checks.check_version(package_version(), str(version)),
    ]


def _permission(patient: Patient, session: zenoh.Session, info: Mapping[str, Any] | None) -> Finding:
    if not patient.machine:
        return skipped("permission", "these keys send no samples")
    frame = patient.site_file.frame if patient.site_file else checks.table_of(info or {}, "site").get("frame")
    if not frame:
        return skipped("permission", "give --site-file FILE, for the server does not tell the site's frame")
    answer = probes.ask_permission(session, patient.site, patient.machine, frame, patient.keys)
    is_there = answer is not None or probes.is_answered(session, keys.ingest(patient.site, patient.machine))
    return checks.check_permission(patient.machine, answer, is_there=is_there, has_keys=patient.keys is not None)


# --- disk ------------------------------------------------------------------------------------------------------------


def _spool(patient: Patient, session: zenoh.Session | None) -> list[Finding]:
    if patient.spool is None:
        return [skipped("spool", "give --spool FILE")]
    return [_spool_itself(patient, patient.spool, session), _disk("spool", patient.spool)]


def _spool_itself(patient: Patient, path: Path, session: zenoh.Session | None) -> Finding:
    """The file, or while an agent has it open, what that says."""
    try:
        return checks.check_spool(probes.read_spool(path), time.time_ns())
    except probes.InUseError:
        name = patient.machine if patient.machine != ANYBODY else ""
        if session and name and (values := probes.hear_health(session, patient.site, name)) is not None:
            return checks.check_health(name, values)
        who = f"{name} is not heard" if session and name else "give --machine NAME to hear what it says"
        return skipped("spool", f"an agent has {path} open, and {who}")
    except StoreError as error:
        return Finding(Level.FAIL, "spool", str(error))


def _store(folder: Path | None, site: SiteConfig | None) -> list[Finding]:
    if folder is None:
        return [skipped("store", "give --store FOLDER, where the map server runs")]
    try:
        found = checks.check_store(probes.read_store(folder, time.time()), site)
    except SitegridError as error:
        found = Finding(Level.FAIL, "store", str(error))
    return [found, _disk("store", folder)]


def _disk(what: str, path: Path) -> Finding:
    return checks.check_disk(what, probes.free_bytes(path))
