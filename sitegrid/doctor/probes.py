"""What `sitegrid doctor` looks at: the network, keys, files and disks of this host. Nothing here changes anything."""

from __future__ import annotations

import math
import secrets
import shutil
import socket
import sqlite3
import ssl
import time
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import zenoh

from agents.delivery.spool_file import SCHEMA as SPOOL_SCHEMA
from protocol.errors import ConfigError, LinkError, MessageError, StoreError
from protocol.machine.samples import SAMPLE_DTYPE, empty
from protocol.queries.requests import decode_info
from protocol.wire import keys
from protocol.wire.codec import decode_health, decode_reply, encode_batch
from protocol.wire.credentials import AUTHORITY_FILE, CERTIFICATE_FILE, KEY_FILE, SIGNING_FILE, load_credentials
from protocol.wire.messages import Ack, Refused, SampleBatch
from protocol.wire.session import SessionConfig, open_session
from sitegrid.doctor.checks import Certificate, Link, SpoolState, StoreState

ANSWER_S = 5.0
LINK_S = 3.0
KNOWN_S = 1.0  # for the router's news of who answers
HEALTH_S = 3.0  # an agent tells of itself every second
T = TypeVar("T")


# --- network ---------------------------------------------------------------------------------------------------------


def open_link(config: SessionConfig) -> tuple[Link, zenoh.Session | None]:
    """Open a session, and tell how that went."""
    has_keys = config.credentials is not None
    if not _listens(config.endpoint):  # else Zenoh tries until the time is up
        return Link(config.endpoint, None, has_keys=has_keys), None
    start_s = time.perf_counter()
    try:
        session = open_session(config)
    except LinkError:
        return Link(config.endpoint, None, listens=True, has_keys=has_keys), None
    return Link(config.endpoint, time.perf_counter() - start_s, has_keys=has_keys), session


def is_answered(session: zenoh.Session, key: str) -> bool:
    """Whether the router knows of somebody who answers on a key: it says so also where it lets nobody ask."""
    querier: Any = session.declare_querier(key)  # its matching_status is an object (EVIDENCE), declared a bool
    try:
        end_s = time.monotonic() + KNOWN_S
        while not querier.matching_status.matching:
            if time.monotonic() >= end_s:
                return False
            time.sleep(0.02)
        return True
    finally:
        querier.undeclare()


def ask_info(session: zenoh.Session, site: str) -> tuple[dict[str, Any] | None, tuple[int, int]]:
    """The server's `info`, None without an answer, and this host's clock before and after [ns]."""
    before_ns = time.time_ns()
    data = _ask(session, keys.map_query(site, "info"), b"")
    asked_ns = (before_ns, time.time_ns())
    return (decode_info(data) if data else None), asked_ns


def offset_of(info: Mapping[str, Any], asked_ns: tuple[int, int]) -> tuple[float, float] | None:
    """How far this host's clock is ahead of the server's, and how well that is known [s]; None if it does not say."""
    if not isinstance(wall_ns := info.get("wall_ns"), int):
        return None
    before_ns, after_ns = asked_ns
    return ((before_ns + after_ns) / 2 - wall_ns) * 1e-9, (after_ns - before_ns) / 2 * 1e-9


def ask_permission(
    session: zenoh.Session, site: str, machine: str, frame: str, folder: Path | None
) -> Ack | Refused | None:
    """Send an empty batch of a spool that never was: it asks for a watermark, and leaves no trace (docs/protocol.md).

    folder: of the machine's keys, whose signature goes along where there is one.
    """
    key = keys.ingest(site, machine)
    batch = encode_batch(SampleBatch(machine, secrets.randbits(64) or 1, 1, empty(), frame))
    try:
        data = _ask(session, key, batch, _signature(folder, key, batch))
        return decode_reply(data) if data else None
    except MessageError as error:
        return Refused(error.reason, f"its answer cannot be read: {error}")


def hear_health(session: zenoh.Session, site: str, machine: str) -> Mapping[str, Any] | None:
    """What a running agent says of itself; None if nothing is heard."""
    with session.declare_subscriber(keys.health(site, machine), zenoh.handlers.RingChannel(1)) as ear:
        end_s = time.monotonic() + HEALTH_S
        while time.monotonic() < end_s:
            if sample := ear.try_recv():
                try:
                    return decode_health(sample.payload.to_bytes()).values
                except MessageError:
                    return None
            time.sleep(0.05)
    return None


def _ask(session: zenoh.Session, key: str, payload: bytes, attachment: bytes | None = None) -> bytes | None:
    for reply in session.get(key, payload=payload, attachment=attachment, timeout=ANSWER_S):
        if reply.ok is not None:
            return reply.ok.payload.to_bytes()
    return None


def _signature(folder: Path | None, key: str, payload: bytes) -> bytes | None:
    if folder is None or not (folder / SIGNING_FILE).is_file():
        return None
    from sitegrid.security.signing import Signer  # imported here: needs the `security` extra

    return Signer((folder / SIGNING_FILE).read_bytes()).sign(key, payload)


def _listens(endpoint: str) -> bool:
    """Whether somebody takes TCP connections at an endpoint."""
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), LINK_S).close()
    except (OSError, ValueError, OverflowError):
        return False
    return True


# --- keys ------------------------------------------------------------------------------------------------------------


def read_certificate(folder: Path) -> Certificate:
    """What a folder of keys holds; ConfigError where something is missing or cannot be read."""
    from cryptography import x509  # imported here: needs the `security` extra
    from cryptography.exceptions import InvalidSignature
    from cryptography.x509.oid import NameOID

    identity = load_credentials(folder).identity
    try:
        certificate, authority = (
            x509.load_pem_x509_certificate((folder / name).read_bytes()) for name in (CERTIFICATE_FILE, AUTHORITY_FILE)
        )
        names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
        mode = (folder / KEY_FILE).stat().st_mode
        fits = _fits(folder)
    except OSError as error:
        raise ConfigError(folder, f"cannot be read ({error.strerror}): run as the user that it belongs to") from None
    except ValueError as error:
        raise ConfigError(folder, f"holds no usable certificate ({error}): copy the whole folder again") from None
    try:
        certificate.verify_directly_issued_by(authority)
        signed = True
    except (InvalidSignature, ValueError, TypeError):
        signed = False
    valid = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    return Certificate(identity, str(names[0].value) if names else "", *valid, signed, fits, mode)


def _fits(folder: Path) -> bool:
    """Whether the private key is that of the certificate; OpenSSL compares them when it loads both."""
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT).load_cert_chain(folder / CERTIFICATE_FILE, folder / KEY_FILE)
    except ssl.SSLError:
        return False
    return True


# --- disk ------------------------------------------------------------------------------------------------------------


class InUseError(StoreError):
    """An agent has the spool open."""


def free_bytes(path: Path) -> int:
    """Free space for a file or folder that may not be there yet."""
    place = path.absolute()
    while not place.is_dir():
        place = place.parent
    return shutil.disk_usage(place).free


def read_spool(path: Path) -> SpoolState:
    """The state of a spool at rest; StoreError where it cannot be used, InUseError while an agent runs on it."""
    if not path.is_file():
        raise StoreError(path, "no such file; an agent makes it when it starts")
    try:
        with closing(sqlite3.connect(_read_only(path), uri=True, timeout=0.2)) as db:
            return _spool_state(path, db)
    except sqlite3.Error as error:
        if "locked" in str(error):
            raise InUseError(path, "an agent has it open") from None
        raise StoreError(path, f"is no usable spool: {error}") from None


def read_store(folder: Path, now_s: float) -> StoreState:
    """The state of a store, also while a server uses it; StoreError where it cannot be used."""
    from mapserver.evidence import (
        snapshot,  # imported here: needs the `server` extra, which a machine's host does not have
    )
    from mapserver.ingest.store import JOURNAL_FILE
    from mapserver.journal.reader import JournalReader
    from mapserver.journal.schema import SCHEMA

    if not (folder / JOURNAL_FILE).is_file():
        raise StoreError(folder, f"holds no {JOURNAL_FILE}; a server makes it when it starts")
    with JournalReader(folder / JOURNAL_FILE) as journal:
        journal.check()
        last_row, archived = journal.last_row, journal.archived_row
        machines = {machine for machine, _ in journal.watermarks()}
        site, frame = journal.site, journal.frame
    newest = next(iter(snapshot.rows_on_disk(folder)), 0)
    age_s = now_s - (folder / f"snapshot-{newest}.npz").stat().st_mtime if newest else math.inf
    return StoreState(site, frame, SCHEMA, last_row, archived, len(machines), newest, age_s)


def _read_only(path: Path) -> str:
    """A URI that writes nothing. A spool at rest has no write-ahead log: it is read without files beside it."""
    log = path.with_name(f"{path.name}-wal")
    at_rest = not log.exists() or log.stat().st_size == 0
    return f"{path.absolute().as_uri()}?mode=ro" + ("&immutable=1" if at_rest else "")


def _spool_state(path: Path, db: sqlite3.Connection) -> SpoolState:
    (schema,) = db.execute("PRAGMA user_version").fetchone()
    if schema != SPOOL_SCHEMA:
        raise StoreError(path, f"has schema {schema}, this version knows {SPOOL_SCHEMA}; its agent converts older ones")
    (depth,), (aside,) = (db.execute(f"SELECT COUNT(*) FROM {t}").fetchone() for t in ("sample", "aside"))  # noqa: S608
    (dropped,) = db.execute("SELECT value FROM meta WHERE key = 'dropped'").fetchone() or (0,)
    oldest = db.execute("SELECT row FROM sample ORDER BY number LIMIT 1").fetchone()
    oldest_ns = int(np.frombuffer(oldest[0], SAMPLE_DTYPE)["stamp_ns"][0]) if oldest else 0
    return SpoolState(depth, int(dropped), aside, oldest_ns)
