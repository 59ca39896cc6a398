"""Examination of this host's part of a site, in order, as far as options name it.

Positions are judged by a running agent's health: confirmed, refuted or unobservable by fixes.
"""

from __future__ import annotations

import math
import time
from argparse import Namespace
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import zenoh

from protocol.errors import ConfigError, MessageError, SitegridError, StoreError
from protocol.queries.answers import MapInfo
from protocol.site.site_config import SiteConfig
from protocol.site.site_file import load_site
from protocol.version import package_version
from protocol.wire import keys
from protocol.wire.credentials import Identity, load_credentials
from sitegrid.doctor import Finding, Level, disk, network, skipped
from sitegrid.doctor.keys import check_certificate, read_certificate
from sitegrid.follower_choice import Asker, is_answered
from sitegrid.security.join import join

ANYBODY = "doctor"  # any name serves without keys
ASKS_MAP = ("machine", "visitor", "admin")  # roles that may query the map (docs/security.md)
# Checks that need the map server.
OF_SERVER = ("server", "losses", "clock", "time", "writer", "followers", "version", "machines", "permission")
REFUTED = "fixes are further off than the filter expects: look at the variance that the receiver states, and at mounts"
MISSTATED = 2.25  # actual over stated variance beyond chance: errors 1.5 times as large
UNSEEN = "a slow GPS error that is larger than stated would not show: there is one receiver, or several that err alike"


@dataclass(frozen=True)
class Subject:
    """What is examined. machine: empty if these keys send no samples."""

    options: Namespace
    site: str
    machine: str
    identity: Identity | None
    site_file: SiteConfig | None


def examine(arguments: Namespace) -> list[Finding]:
    """Check what the options name."""
    findings, subject = _keys(arguments)
    findings += _network(subject) if subject else [skipped("router", "these keys cannot be used")]
    return findings + _store(arguments.store, arguments.journal, subject.site_file if subject else None)


def _subject(arguments: Namespace, identity: Identity | None) -> Subject:
    site_file = load_site(arguments.site_file) if arguments.site_file else None
    named = site_file.name if site_file else identity.site if identity else "paper"
    machine = arguments.machine or ""
    if not machine and (identity is None or identity.role == "machine"):
        machine = identity.name if identity else ANYBODY
    site = keys.check_name(arguments.site or named, "--site")
    if machine:
        keys.check_name(machine, "--machine")
    return Subject(arguments, site, machine, identity, site_file)


def _keys(arguments: Namespace) -> tuple[list[Finding], Subject | None]:
    """Findings on the keys; if usable, also the subject of the other checks."""
    if arguments.keys is None:
        return [skipped("certificate", "give --keys FOLDER, if the site has keys")], _subject(arguments, None)
    try:
        subject = _subject(arguments, load_credentials(arguments.keys).identity)
        certificate = read_certificate(arguments.keys)
    except ConfigError as error:
        return [Finding(Level.FAIL, "certificate", str(error))], None
    except ModuleNotFoundError:
        return [skipped("certificate", "pip install '.[security]' in the folder of this project")], subject
    site = arguments.site or (subject.site_file.name if subject.site_file else "")
    findings = check_certificate(certificate, datetime.now(UTC), site, arguments.machine or "")
    return findings, subject if findings[0].level != Level.FAIL else None


def _network(subject: Subject) -> list[Finding]:
    link, session = network.open_link(join(subject.options.endpoint, subject.options.keys, network.LINK_S))
    if session is None:
        rest = [skipped(name, "no way to the router") for name in OF_SERVER]
        return [network.check_link(link), *rest, *_spool(subject, None)]
    try:
        return [
            network.check_link(link),
            *_server(subject, session),
            *_spool(subject, session),
        ]
    finally:
        session.close()  # type: ignore[no-untyped-call]


def _server(subject: Subject, session: zenoh.Session) -> list[Finding]:
    role = subject.identity.role if subject.identity else ""
    if role and role not in ASKS_MAP:
        return [skipped(name, f"keys of a {role} may not ask") for name in OF_SERVER]
    try:
        info, asked_ns = network.ask_info(session, subject.site)
    except MessageError as error:
        problem = f"site {subject.site}: the map server's answer cannot be read: {error}"
        unread = Finding(Level.FAIL, "server", problem, "update the older side")
        return [unread, *(skipped(name, "the server's answer cannot be read") for name in OF_SERVER[1:])]
    is_there = info is not None or is_answered(session, keys.map_query(subject.site, "info"))
    findings = [network.check_server(subject.site, info, is_there=is_there, role=role)]
    if info is not None:
        site = subject.site_file
        findings += [
            network.check_losses(info),
            network.check_site(site, info) if site else skipped("site", "give --site-file FILE to compare"),
            network.check_clock(*network.offset_of(info, asked_ns), site),
            network.check_time(info),
            network.check_writers(network.ask_writers(session, subject.site)),
            network.check_followers(Asker(session, "", subject.site, network.ANSWER_S).followers(), info),
            network.check_version(package_version(), info.version),
            network.check_machines(network.ask_machines(session, subject.site)),
        ]
    return [*findings, _permission(subject, session, info)]


def _permission(subject: Subject, session: zenoh.Session, info: MapInfo | None) -> Finding:
    if not subject.machine:
        return skipped("permission", "these keys send no samples")
    if not (site := subject.site_file or (info and info.site)):
        return skipped("permission", "give --site-file FILE, for the server does not say the site's frame")
    keys_folder = subject.options.keys
    answer = network.ask_permission(session, subject.site, subject.machine, site.frame, keys_folder)
    is_there = answer is not None or is_answered(session, keys.ingest(subject.site, subject.machine))
    return network.check_permission(subject.machine, answer, is_there=is_there, has_keys=keys_folder is not None)


def _spool(subject: Subject, session: zenoh.Session | None) -> list[Finding]:
    if (path := subject.options.spool) is None:
        return [skipped("spool", "give --spool FILE")]
    return [*_spool_itself(subject, path, session), disk.check_disk("spool", disk.free_bytes(path))]


def _spool_itself(subject: Subject, path: Path, session: zenoh.Session | None) -> list[Finding]:
    """The file; if open in an agent, its health report and positions."""
    try:
        return [disk.check_spool(disk.read_spool(path), time.time_ns())]
    except disk.InUseError:
        name = subject.machine if subject.machine != ANYBODY else ""
        if session and name and (health := network.receive_health(session, subject.site, name)):
            return [disk.check_health(name, health.values), check_positions(name, health.values)]
        reason = f"{name} sends no health" if session and name else "give --machine NAME to receive its health"
        return [skipped("spool", f"an agent has {path} open, and {reason}")]
    except StoreError as error:
        return [Finding(Level.FAIL, "spool", str(error))]


def _store(folder: Path | None, journal: str, site: SiteConfig | None) -> list[Finding]:
    if folder is None:
        return [skipped("store", "give --store FOLDER, where the map server runs")]
    try:
        store = disk.check_store(disk.read_store(folder, time.time(), journal), site)
    except SitegridError as error:
        store = Finding(Level.FAIL, "store", str(error))
    return [store, disk.check_disk("store", disk.free_bytes(folder))]


def check_positions(machine: str, values: Mapping[str, Any]) -> Finding:
    """An agent's receivers, by its health report of any content."""
    pipeline = values.get("pipeline")
    shown = pipeline.get("consistency") if isinstance(pipeline, Mapping) else None
    receivers = {
        str(name): each
        for name, each in (shown.items() if isinstance(shown, Mapping) else ())
        if isinstance(each, Mapping)
    }
    verdicts = {name: each.get("verdict") for name, each in receivers.items()}
    if not verdicts:
        return skipped("positions", f"{machine} has had too few fixes")
    named = ", ".join(f"{name} {str(verdict).replace('_', ' ')}" for name, verdict in sorted(verdicts.items()))
    if "inconsistent" in verdicts.values():
        return Finding(Level.WARN, "positions", f"{machine}: {named}", REFUTED)
    if misstated := [text for name, each in sorted(receivers.items()) if (text := _misstated(name, each))]:
        return Finding(Level.WARN, "positions", f"{machine}: {', '.join(misstated)}", "set `std` in its config to that")
    unseen = f"; {UNSEEN}" if "consistent" not in verdicts.values() else ""
    return Finding(Level.PASS, "positions", f"{machine}: {named}{unseen}", "")


def _misstated(receiver: str, consistency: Mapping[str, Any]) -> str:
    """A receiver's misstatement of its error; empty if about right."""
    factor = consistency.get("variance_factor")
    if not isinstance(factor, int | float) or not factor > 0 or 1 / MISSTATED < factor < MISSTATED:
        return ""
    return f"the fixes of {receiver} err {math.sqrt(factor):.1f} times as far as stated"
