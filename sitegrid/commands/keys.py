"""`sitegrid keys`: the certificates of a site, and the register of who is let in.

KEYS/register.toml     who has which role; the router makes its rules from it
KEYS/authority/        the authority's certificate and key: whoever has the key can make any name
KEYS/<name>/           what the process of that name needs, and no other
"""

from __future__ import annotations

import os
import re
from argparse import Namespace
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path
from typing import Any

from protocol.errors import ConfigError
from protocol.wire.credentials import AUTHORITY_FILE, CERTIFICATE_FILE, IDENTITY_FILE, KEY_FILE, SIGNING_FILE
from protocol.wire.keys import check_name
from sitegrid.process.lifetime import say
from sitegrid.security.certificates import Pair, expires_at, issue, make_authority
from sitegrid.security.register import REGISTER_FILE, ROUTER, Entry, Register, common_name, load_register, register_toml
from sitegrid.security.signing import make_signing_key

AUTHORITY = "authority"
AUTHORITY_DAYS = 3650
THIS_HOST = ("localhost", "127.0.0.1")
HOST_LABEL = re.compile(r"[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?")


def run(arguments: Namespace) -> int:
    """Make, revoke or list keys."""
    _ACTIONS[arguments.action](arguments, datetime.now(UTC).replace(microsecond=0))
    return 0


def _init(arguments: Namespace, now: datetime) -> None:
    """The authority, and the certificates of the router and the map server."""
    folder, site = arguments.dir, check_name(arguments.site, "--site")
    hosts = tuple(dict.fromkeys((*THIS_HOST, *map(_host, arguments.host))))
    if folder.exists() and any(folder.iterdir()):
        raise ConfigError(folder, "is not empty; name a new folder, or add to this one with `sitegrid keys add`")
    _private_folder(folder)
    _write(folder / ".gitignore", b"*\n")  # keys belong into no repository
    _private_folder(folder / AUTHORITY)
    authority = make_authority(site, now, now + timedelta(days=AUTHORITY_DAYS))
    _write(folder / AUTHORITY / KEY_FILE, authority.key)
    _write(folder / AUTHORITY / CERTIFICATE_FILE, authority.certificate)
    register = Register(site, hosts, {})
    for name in (ROUTER, "server"):
        register = _certify(folder, register, name, name, now + timedelta(days=arguments.days), now)
    _tell(
        arguments, f"{folder}: keys of site {site}; the router is reached as {', '.join(hosts)}", site=site, hosts=hosts
    )


def _host(text: str) -> str:
    try:
        return str(ip_address(text))
    except ValueError:
        if len(text) <= 253 and all(HOST_LABEL.fullmatch(label) for label in text.split(".")):
            return text
    raise ConfigError("--host", f"{text!r} is neither the name of a host nor its address")


def _add(arguments: Namespace, now: datetime) -> None:
    """A certificate for a new name, for one that was revoked, or with --renew for one that has it."""
    folder, name = arguments.dir, check_name(arguments.name, "keys add")
    register = load_register(folder)
    known = register.names.get(name)
    if name == AUTHORITY:
        raise ConfigError("keys add", f"{name!r} is the folder of the authority; choose another name")
    if arguments.renew and (known is None or known.revoked):
        raise ConfigError("keys add", f"{name!r} has no certificate that could be renewed; leave out --renew")
    if known and not known.revoked and not arguments.renew:
        raise ConfigError("keys add", f"{name!r} has a certificate already; --renew makes it a new one")
    role = _role(arguments, known)
    register = _certify(folder, register, name, role, now + timedelta(days=arguments.days), now)
    entry = register.names[name]
    line = f"{folder / name}: keys of {role} {name} until {entry.expires.date()}; give it this folder, then delete it"
    _tell(arguments, line, name=name, role=role, folder=str(folder / name), expires=entry.expires.isoformat())


def _role(arguments: Namespace, known: Entry | None) -> str:
    """As asked for; a renewed certificate keeps its role."""
    if known is None or known.revoked:
        return str(arguments.role or "machine")
    if arguments.role not in (None, known.role):
        raise ConfigError("--role", f"{arguments.name!r} is a {known.role}; revoke it first, then add it anew")
    return known.role


def _revoke(arguments: Namespace, _: datetime) -> None:
    register = load_register(arguments.dir).without(arguments.name)
    _write(arguments.dir / REGISTER_FILE, register_toml(register).encode())
    line = f"{arguments.name} is let in no more once the router has this {REGISTER_FILE}; it takes that up by itself"
    _tell(arguments, line, name=arguments.name, revoked=True)


def _list(arguments: Namespace, now: datetime) -> None:
    register = load_register(arguments.dir)
    rows = [_row(name, entry, now) for name, entry in sorted(register.names.items())]
    if arguments.json:
        say({"site": register.site, "hosts": register.hosts, "names": rows})
        return
    for row in rows:
        print(f"{row['name']:24} {row['role']:8} {row['expires'][:10]}  {row['state']}")


def _row(name: str, entry: Entry, now: datetime) -> dict[str, Any]:
    state = "revoked" if entry.revoked else "expired" if entry.expires < now else "valid"
    plain = {"name": name, "role": entry.role, "expires": entry.expires.isoformat(), "state": state}
    return {**plain, "revoked": entry.revoked, "serial": entry.serial, "common_name": common_name(name, entry.issue)}


_ACTIONS = {"init": _init, "add": _add, "revoke": _revoke, "list": _list}


# --- files -----------------------------------------------------------------------------------------------------------


def _certify(folder: Path, register: Register, name: str, role: str, expires: datetime, now: datetime) -> Register:
    """Write the folder of a name, then the register: only what that lists is let in."""
    authority = _authority(folder)
    number = register.next_issue(name)
    hosts = register.hosts if role == ROUTER else ()
    pair = issue(authority, common_name(name, number), now, expires, hosts)
    signing_key, public = make_signing_key() if role == "machine" else (b"", "")
    entry = Entry(role, pair.serial, expires_at(pair), number, signing=public)
    identity = f'site = "{register.site}"\nname = "{name}"\nrole = "{role}"\nexpires = {entry.expires.isoformat()}\n'
    _private_folder(folder / name)
    files = {AUTHORITY_FILE: authority.certificate, CERTIFICATE_FILE: pair.certificate, KEY_FILE: pair.key}
    if signing_key:
        files[SIGNING_FILE] = signing_key
    for file, data in {**files, IDENTITY_FILE: identity.encode()}.items():
        _write(folder / name / file, data)
    register = register.with_entry(name, entry)
    _write(folder / REGISTER_FILE, register_toml(register).encode())
    return register


def _authority(folder: Path) -> Pair:
    place = folder / AUTHORITY
    try:
        return Pair((place / CERTIFICATE_FILE).read_bytes(), (place / KEY_FILE).read_bytes())
    except OSError as error:
        raise ConfigError(place, f"cannot be read ({error.strerror}); it lies where `sitegrid keys init` ran") from None


def _private_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
        path.chmod(0o700)
    except OSError as error:
        raise ConfigError(path, f"cannot be made: {error.strerror}") from None


def _write(path: Path, data: bytes) -> None:
    """Write a file that only its owner reads, wholly or not at all."""
    part = path.with_name(f"{path.name}.part")
    try:
        part.unlink(missing_ok=True)
        with open(part, "xb", opener=lambda name, flags: os.open(name, flags, 0o600)) as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except OSError as error:
        raise ConfigError(path, f"cannot be written: {error.strerror}") from None


def _tell(arguments: Namespace, line: str, **values: Any) -> None:
    say(values) if arguments.json else print(line)
