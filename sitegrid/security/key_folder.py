"""The folder of a site's keys: private files, written whole or not at all. Needs `cryptography`.

KEYS/register.toml     who has which role; the router makes its rules from it
KEYS/authority/        the authority's certificate and key: whoever has the key can make any name
KEYS/<name>/           what the process of that name needs, and no other
"""

from __future__ import annotations

from datetime import datetime, timedelta
from pathlib import Path

from protocol.errors import ConfigError
from protocol.files import sealed
from protocol.wire.credentials import (
    AUTHORITY_FILE,
    CERTIFICATE_FILE,
    IDENTITY_FILE,
    KEY_FILE,
    SERVERS_FILE,
    SIGNING_FILE,
)
from sitegrid.security.certificates import KeyPair, expires_at, issue, make_authority
from sitegrid.security.register import ROUTER, Register, RegisterEntry, common_name, save_register, write_private
from sitegrid.security.signing import make_signing_key

AUTHORITY = "authority"
AUTHORITY_DAYS = 3650


def make_folder(folder: Path, site: str, now: datetime) -> None:
    """Make the folder with the authority of a site."""
    _private_folder(folder)
    write_private(folder / ".gitignore", b"*\n")  # keys belong into no repository
    _private_folder(folder / AUTHORITY)
    authority = make_authority(site, now, now + timedelta(days=AUTHORITY_DAYS))
    write_private(folder / AUTHORITY / KEY_FILE, authority.key)
    write_private(folder / AUTHORITY / CERTIFICATE_FILE, authority.certificate)


def certify(folder: Path, register: Register, name: str, role: str, expires: datetime, now: datetime) -> Register:
    """Write the folder of a name, then the register: only what that lists is let in."""
    authority = _authority(folder)
    number = register.next_issue(name)
    hosts = register.hosts if role == ROUTER else ()
    pair = issue(authority, common_name(name, number), now, expires, hosts)
    signing_key, public = _signing_key(folder, register, name, role)
    entry = RegisterEntry(role, pair.serial, expires_at(pair), number, signing=public)
    identity = f'site = "{register.site}"\nname = "{name}"\nrole = "{role}"\nexpires = {entry.expires.isoformat()}\n'
    files = {AUTHORITY_FILE: authority.certificate, CERTIFICATE_FILE: pair.certificate, KEY_FILE: pair.key}
    if signing_key:
        files[SIGNING_FILE] = signing_key
    if role == "machine":
        files[SERVERS_FILE] = "".join(f"{key}\n" for key in register.server_keys()).encode()
    _private_folder(folder / name)
    for file, data in {**files, IDENTITY_FILE: sealed(identity).encode()}.items():
        write_private(folder / name / file, data)
    register = register.with_entry(name, entry)
    save_register(folder, register)
    return register


def _signing_key(folder: Path, register: Register, name: str, role: str) -> tuple[bytes, str]:
    """What it signs with, private and public; a map server keeps its own, which all machines know, while it is here."""
    known, file = register.names.get(name), folder / name / SIGNING_FILE
    if role == "server" and known and known.signing and not known.revoked and file.is_file():
        return file.read_bytes(), known.signing
    return make_signing_key() if role in ("machine", "server") else (b"", "")


def _authority(folder: Path) -> KeyPair:
    place = folder / AUTHORITY
    try:
        return KeyPair((place / CERTIFICATE_FILE).read_bytes(), (place / KEY_FILE).read_bytes())
    except OSError as error:
        raise ConfigError(place, f"cannot be read ({error.strerror}); it lies where `sitegrid keys init` ran") from None


def _private_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
        path.chmod(0o700)
    except OSError as error:
        raise ConfigError(path, f"cannot be made: {error.strerror}") from None
