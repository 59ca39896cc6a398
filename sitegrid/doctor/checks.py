"""The checks of `sitegrid doctor`: from what was found to a verdict in one line, and what to do. Pure.

What is looked at lies in probes.py. A denial is silent in Zenoh (EVIDENCE), so checks say what none may mean.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from typing import Any

from protocol.site.site_config import SiteConfig
from protocol.version import UNKNOWN
from protocol.wire.credentials import Identity
from protocol.wire.messages import Ack, Refused

EXPIRES_DAYS = 30
OFFSET_S = 1.0  # of two clocks, beyond which the ages on the map are off
FREE_FAIL, FREE_WARN = 64 * 2**20, 2**30
WAITING_S = 3600.0  # samples that are older have not been taken for long
TAIL_ROWS = 20_000  # journal rows that a restart folds in some seconds
ASKS_MAP = ("machine", "visitor", "admin")  # roles that may ask the map (docs/security.md)


class Level(StrEnum):
    """PASS: as it should be. WARN: works, not for long or not well. FAIL: does not work. SKIP: was not looked at."""

    PASS = "PASS"  # noqa: S105 - no password
    WARN = "WARN"
    FAIL = "FAIL"
    SKIP = "-"


@dataclass(frozen=True)
class Finding:
    """One line: what was looked at, what was found, and what to do about it."""

    level: Level
    check: str
    found: str
    advice: str = ""

    def __str__(self) -> str:
        return f"{self.level:4}  {self.check:12}  {self.found}" + (f"; {self.advice}" if self.advice else "")


def table_of(values: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """A table in what others sent, empty where there is none: they may be of another version."""
    found = values.get(name)
    return found if isinstance(found, Mapping) else {}


def skipped(check: str, reason: str) -> Finding:
    """What was not looked at, and why."""
    return Finding(Level.SKIP, check, f"not checked: {reason}")


# --- network ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Link:
    """The way to the router. took_s: to open a session, None if there is none. listens: somebody takes connections."""

    endpoint: str
    took_s: float | None
    listens: bool = False
    has_keys: bool = False


def check_link(link: Link) -> Finding:
    """Whether a session with the router could be opened."""
    if link.took_s is not None:
        return Finding(Level.PASS, "router", f"{link.endpoint} answers in {link.took_s * 1e3:.0f} ms")
    if not link.listens:
        advice = "start `sitegrid router`, or compare --endpoint, cables and firewalls"
        return Finding(Level.FAIL, "router", f"nothing listens at {link.endpoint}", advice)
    advice = "these keys may be of another site, outdated, or not those of its register" if link.has_keys else ""
    advice = advice or "if it asks for keys, pass --keys"
    return Finding(Level.FAIL, "router", f"{link.endpoint} takes connections, but lets this session not in", advice)


def check_server(site: str, info: Mapping[str, Any] | None, *, is_there: bool, role: str = "") -> Finding:
    """Whether the map server answers. is_there: whether the router knows of one, role: what the keys are for."""
    if info is not None:
        samples, cells, row = (info.get(name, "?") for name in ("samples_merged", "cells", "journalled"))
        merged = info.get("merged", row)
        text = f"site {site}: {samples} samples in {cells} cells, journal row {row}"
        return Finding(Level.PASS, "server", text + (f", merged only up to {merged}" if merged != row else ""))
    if is_there:
        problem = f"site {site}: a map server is there, but does not answer"
        advice = "the router denies the question (see `sitegrid keys list`), or the server hangs"
        return Finding(Level.FAIL, "server", problem, advice)
    problem = f"site {site}: the router knows of no map server"
    advice = "start `sitegrid server`, or compare the name of the site"
    if role:
        advice += "; or these keys are revoked, or not in its register, and it shows them nothing"
    return Finding(Level.FAIL, "server", problem, advice)


def check_site(site: SiteConfig, info: Mapping[str, Any]) -> Finding:
    """Whether a site file means the same ground as the server."""
    name, frame = (table_of(info, "site").get(key) for key in ("name", "frame"))
    if (site.name, site.frame) == (name, frame):
        return Finding(Level.PASS, "site", f"{site.name}, frame {site.frame}, as the map server has it")
    found = f"this is {site.name} with frame {site.frame}, the map server has {name} with {frame}"
    return Finding(Level.FAIL, "site", found, "compare name and origin in the site files")


def check_permission(machine: str, answer: Ack | Refused | None, *, is_there: bool, has_keys: bool) -> Finding:
    """Whether batches of a machine are taken, by the answer to an empty one."""
    if isinstance(answer, Ack):
        return Finding(Level.PASS, "permission", f"batches of {machine} are taken")
    if isinstance(answer, Refused):
        found = f"the map server refuses batches of {machine} ({answer.reason}): {answer.problem}"
        return Finding(Level.FAIL, "permission", found)
    if not is_there:
        found = f"nobody takes batches of {machine}"
        return Finding(Level.FAIL, "permission", found, "start `sitegrid server`, or compare the name of the site")
    found = f"a map server is there, but gives no answer to batches of {machine}"
    denied = "the router denies it: a machine may send under the name of its keys alone"
    return Finding(Level.FAIL, "permission", found, denied if has_keys else "the router denies it, or the server hangs")


def check_clock(offset_s: float, error_s: float, site: SiteConfig | None) -> Finding:
    """How far this host's clock is ahead of the server's. error_s: how well that is known."""
    ahead = "ahead of" if offset_s > 0 else "behind"
    found = f"{abs(offset_s):.2f} s {ahead} the map server's clock (+-{error_s:.2f} s)"
    advice = "set both clocks by NTP (chrony, systemd-timesyncd)"
    limit_s = site.clock_tolerance_s if site and site.clock == "wall" else math.inf
    if offset_s - error_s > limit_s:
        return Finding(Level.FAIL, "clock", f"{found}; samples are refused beyond {limit_s:g} s", advice)
    if abs(offset_s) - error_s > OFFSET_S:
        return Finding(Level.WARN, "clock", found, advice)
    return Finding(Level.PASS, "clock", found)


def check_version(own: str, other: str) -> Finding:
    """Whether both sides run the same version; the wire has a version of its own, so others may work, too."""
    if UNKNOWN in (own, other):
        return skipped("version", f"here {own}, map server {other}: one of them runs without being installed")
    if own == other:
        return Finding(Level.PASS, "version", f"{own} on both sides")
    return Finding(Level.WARN, "version", f"here {own}, map server {other}", "update the older side")


# --- keys ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Certificate:
    """What a folder of keys holds.

    common_name: as the certificate says. signed: by the authority beside it. fits: with the private key. mode: of the
    key's file.
    """

    identity: Identity
    common_name: str
    begins: datetime
    expires: datetime
    signed: bool
    fits: bool
    mode: int


def check_certificate(found: Certificate, now: datetime, site: str = "", machine: str = "") -> list[Finding]:
    """Validity, name and chain of a certificate. site, machine: what it is needed for, where that is known."""
    who = f"{found.identity.role} {found.identity.name} of site {found.identity.site}"
    return [_validity(found, now, who), _name(found, site, machine, who), _chain(found)]


def _validity(found: Certificate, now: datetime, who: str) -> Finding:
    advice = f"make a new one with `sitegrid keys add {found.identity.name} --renew`"
    until = f"valid until {found.expires.astimezone(UTC).date()}"
    if now > found.expires:
        return Finding(Level.FAIL, "certificate", f"{who} expired on {found.expires.astimezone(UTC).date()}", advice)
    if now < found.begins:
        begins = f"{found.begins.astimezone(UTC):%Y-%m-%d %H:%M}Z"
        return Finding(Level.FAIL, "certificate", f"{who} is valid from {begins} on", "set this host's clock")
    days = (found.expires - now).days
    if days < EXPIRES_DAYS:
        return Finding(Level.WARN, "certificate", f"{who} is {until}, {days} days more", advice)
    return Finding(Level.PASS, "certificate", f"{who} is {until}")


def _name(found: Certificate, site: str, machine: str, who: str) -> Finding:
    identity = found.identity
    name, _, issue = found.common_name.partition(".")  # a name that came back is numbered (register.common_name)
    if name != identity.name or not (issue.isdecimal() or not issue):
        problem = f"identity.toml says {identity.name}, the certificate {found.common_name}"
        return Finding(Level.FAIL, "name", problem, "the files are of two folders: copy the whole folder again")
    if site and site != identity.site:
        return Finding(
            Level.FAIL, "name", f"the keys are for site {identity.site}, not {site}", "compare --site, --keys"
        )
    if machine and identity.role == "machine" and machine != identity.name:
        return Finding(Level.FAIL, "name", f"the keys are those of {identity.name}, not of {machine}", "compare --keys")
    return Finding(Level.PASS, "name", f"the certificate is that of {who}")


def _chain(found: Certificate) -> Finding:
    advice = "the files are of two folders: copy the whole folder again"
    if not found.signed:
        return Finding(Level.FAIL, "authority", "ca.pem has not signed cert.pem", advice)
    if not found.fits:
        return Finding(Level.FAIL, "authority", "key.pem is not the key of cert.pem", advice)
    if found.mode & 0o077:
        problem = f"key.pem can be read by others (mode {found.mode & 0o777:o})"
        return Finding(Level.WARN, "authority", problem, "chmod 600 key.pem; if it was read, revoke it")
    return Finding(Level.PASS, "authority", "ca.pem has signed cert.pem, and key.pem is its key")


# --- disk ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SpoolState:
    """A spool at rest. oldest_ns: stamp of the oldest sample, 0 for none."""

    depth: int
    dropped: int
    put_aside: int
    oldest_ns: int


@dataclass(frozen=True)
class StoreState:
    """A store. snapshot_row, snapshot_age_s: of the newest snapshot, 0 and infinity where there is none."""

    site: str
    frame: str
    schema: int
    last_row: int
    archived_row: int
    machines: int
    snapshot_row: int
    snapshot_age_s: float


def check_disk(what: str, free: int) -> Finding:
    """Free space where a file grows [bytes]."""
    found = f"{free / 2**30:.1f} GiB are free"
    if free < FREE_FAIL:
        return Finding(Level.FAIL, f"{what} disk", found, "make room now: soon nothing more can be written")
    if free < FREE_WARN:
        return Finding(Level.WARN, f"{what} disk", found, "make room")
    return Finding(Level.PASS, f"{what} disk", found)


def check_spool(state: SpoolState, now_ns: int) -> Finding:
    """Depth, age of the oldest, and what will never reach the server."""
    age_s = (now_ns - state.oldest_ns) * 1e-9 if state.oldest_ns else 0.0
    found = f"{state.depth} samples wait" + (f", the oldest is of {_ago(age_s)}" if state.oldest_ns else "")
    found += f"; {state.dropped} were dropped, {state.put_aside} put aside"
    advice = []
    if state.depth and age_s > WAITING_S:
        advice.append("start its agent, and see what it says of its uplink")
    if state.dropped:
        advice.append("it was full: mend the link, or raise max_samples")
    if state.put_aside:
        advice.append("the map server refused samples: table `quarantine` has them and the reasons")
    return Finding(Level.WARN if advice else Level.PASS, "spool", found, "; ".join(advice))


def check_health(machine: str, values: Mapping[str, Any]) -> Finding:
    """A running agent, by what it says of itself."""
    spool, uplink = (table_of(values, part) for part in ("spool", "uplink"))
    counts = [f"{spool.get(key, '?')} {word}" for key, word in (("depth", "samples wait"), ("dropped", "were dropped"))]
    found = f"{machine} runs: {counts[0]}; {counts[1]}, {spool.get('put_aside', '?')} put aside"
    problems = [uplink.get("problem"), values.get("spool_problem"), values.get("calibration_problem")]
    told = "; ".join(str(problem) for problem in problems if problem)
    lost = any(spool.get(key) for key in ("dropped", "put_aside"))
    return Finding(Level.WARN if told or lost else Level.PASS, "spool", found, told)


def check_store(state: StoreState, site: SiteConfig | None) -> Finding:
    """Whose store it is, and how long a restart takes."""
    rows = f"{state.last_row} rows of {state.machines} machines, {state.archived_row} archived"
    tail = state.last_row - state.snapshot_row
    snapshot = f"snapshot of row {state.snapshot_row}, {_ago(state.snapshot_age_s)}" if state.snapshot_row else ""
    found = f"site {state.site}, schema {state.schema}: {rows}; {snapshot or 'no snapshot'}"
    if site and (site.name, site.frame) != (state.site, state.frame):
        problem = f"it is of site {state.site} with frame {state.frame}, the site file {site.name} with {site.frame}"
        return Finding(Level.FAIL, "store", problem, "choose another --store, or the site file that belongs to it")
    if tail > TAIL_ROWS:
        return Finding(Level.WARN, "store", found, f"a restart folds {tail} rows: see the log for failed snapshots")
    return Finding(Level.PASS, "store", found)


def _ago(age_s: float) -> str:
    """An age as people read it."""
    if age_s < 0:
        return f"{-age_s:.0f} s from now"
    for unit, s in (("d", 86_400), ("h", 3600), ("min", 60)):
        if age_s >= 2 * s:
            return f"{age_s / s:.0f} {unit} ago"
    return f"{age_s:.0f} s ago"
