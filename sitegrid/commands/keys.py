"""`sitegrid keys`: a site's certificates and name register."""

from __future__ import annotations

import re
from argparse import ArgumentParser, Namespace
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path
from typing import Any

from protocol.errors import ConfigError
from protocol.wire.keys import check_name
from sitegrid.options.groups import add_action
from sitegrid.options.values import FOLDER, days
from sitegrid.process.lifetime import say, tell
from sitegrid.security import register as registers
from sitegrid.security.register import REGISTER_FILE, ROLES, ROUTER, Register, RegisterEntry
from sitegrid.security.tokens import load_tokens, save_tokens

HELP = "make, list and revoke the certificates of a site"
EXTRA = "security"
THIS_HOST = ("localhost", "127.0.0.1")
HOST_LABEL = re.compile(r"[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?")


def add_options(parser: ArgumentParser) -> None:
    """Options of each action."""
    actions = parser.add_subparsers(metavar="ACTION", required=True)
    init = add_action(actions, "init", "make the site's authority, and the keys of its router and map server")
    init.add_argument("--site", default="paper", help="name of the site (default %(default)s)")
    init.add_argument("--host", nargs="+", action="extend", default=[], help="names and addresses of the router")
    add = add_action(actions, "add", "make keys for a machine or another participant")
    add.add_argument("--role", choices=ROLES, help="role, which says what it may do (default machine)")
    renew = "make a new certificate for a name that has one; the old one stays valid"
    add.add_argument("--renew", action="store_true", help=renew)
    revoke = add_action(actions, "revoke", "revoke the access of a name")
    show = add_action(actions, "list", "list who has access, and until when")
    token = add_action(actions, "token", "make a token for a person who may see the map on the web, or revoke it")
    token.add_argument("name", metavar="PERSON")
    token.add_argument("--revoke", action="store_true", help="revoke the person's token, from now on")
    lifetime = "days that the certificate, or token, is valid (default %(default)s)"
    for action in (init, add, token):
        action.add_argument("--days", type=days, default=365, help=lifetime)
    for action in (add, revoke):
        action.add_argument("name", metavar="MACHINE")
    for action, act in ((init, _init), (add, _add), (revoke, _revoke), (token, _token), (show, _list)):
        folder = "folder with all keys of the site (default %(default)s)"
        action.add_argument("--dir", type=FOLDER if action is init else Path, default="keys", help=folder)
        action.set_defaults(act=act)


def run(arguments: Namespace) -> int:
    """Create, revoke or list keys."""
    arguments.act(arguments, datetime.now(UTC).replace(microsecond=0))
    return 0


def _init(arguments: Namespace, now: datetime) -> None:
    """Create authority, router and map server certificates."""
    from sitegrid.security.key_folder import certify, make_folder

    folder, site = arguments.dir, check_name(arguments.site, "--site")
    hosts = tuple(dict.fromkeys((*THIS_HOST, *map(_host, arguments.host))))
    if folder.exists() and any(folder.iterdir()):
        raise ConfigError(folder, "is not empty; name a new folder, or add to this one with `sitegrid keys add`")
    make_folder(folder, site, now)
    register = Register(site, hosts, {})
    for name in (ROUTER, "server"):
        register = certify(folder, register, name, name, now + timedelta(days=arguments.days), now)
    line = f"{folder}: keys of site {site}; the router is reached as {', '.join(hosts)}"
    _tell(arguments, line, site=site, hosts=hosts)


def _host(text: str) -> str:
    try:
        return str(ip_address(text))
    except ValueError:
        if len(text) <= 253 and all(HOST_LABEL.fullmatch(label) for label in text.split(".")):
            return text
    raise ConfigError("--host", f"{text!r} is neither the name of a host nor its address")


def _add(arguments: Namespace, now: datetime) -> None:
    """A certificate for a new or revoked name, or with --renew for an existing one."""
    from sitegrid.security.key_folder import AUTHORITY, certify

    folder, name = arguments.dir, check_name(arguments.name, "keys add")
    register = registers.load_register(folder)
    known = register.names.get(name)
    if name == AUTHORITY:
        raise ConfigError("keys add", f"{name!r} is the folder of the authority; choose another name")
    if arguments.renew and (known is None or known.revoked):
        raise ConfigError("keys add", f"{name!r} has no certificate that could be renewed; leave out --renew")
    if known and not known.revoked and not arguments.renew:
        raise ConfigError("keys add", f"{name!r} has a certificate already; --renew makes it a new one")
    role = _role(arguments, known)
    register = certify(folder, register, name, role, now + timedelta(days=arguments.days), now)
    entry = register.names[name]
    line = f"{folder / name}: keys of {role} {name} until {entry.expires.date()}; give it this folder, then delete it"
    _tell(arguments, line, name=name, role=role, folder=str(folder / name), expires=entry.expires.isoformat())


def _role(arguments: Namespace, known: RegisterEntry | None) -> str:
    """The requested role; a renewal keeps its role."""
    if known is None or known.revoked:
        return str(arguments.role or "machine")
    if arguments.role not in (None, known.role):
        raise ConfigError("--role", f"{arguments.name!r} is a {known.role}; revoke it first, then add it anew")
    return known.role


def _revoke(arguments: Namespace, _: datetime) -> None:
    register = registers.load_register(arguments.dir).without(arguments.name)
    registers.save_register(arguments.dir, register)
    line = (
        f"{arguments.name} may not join any more once the router has this {REGISTER_FILE}; it takes that up by itself"
    )
    _tell(arguments, line, name=arguments.name, revoked=True)


def _token(arguments: Namespace, now: datetime) -> None:
    """Replace a person's token; only a hash is stored."""
    folder, name = arguments.dir, check_name(arguments.name, "keys token")
    registers.load_register(folder)
    tokens = load_tokens(folder)
    if arguments.revoke:
        save_tokens(folder, tokens.without(name))
        _tell(arguments, f"{name} sees nothing more from now on", name=name, revoked=True)
        return
    expires = now + timedelta(days=arguments.days)
    tokens, token = tokens.with_new(name, expires)
    save_tokens(folder, tokens)
    line = f"{name}'s token until {expires.date()}, shown this once: {token}\n"
    line += f"send {name} the address of `sitegrid web` with ?token={token} at its end"
    _tell(arguments, line, name=name, token=token, expires=expires.isoformat())


def _list(arguments: Namespace, now: datetime) -> None:
    register = registers.load_register(arguments.dir)
    rows = [_row(name, entry, now) for name, entry in sorted(register.names.items())]
    people = [
        {"name": name, "role": "token", "expires": entry.expires.isoformat(), "state": _state(entry.expires, now)}
        for name, entry in sorted(load_tokens(arguments.dir).names.items())
    ]
    if arguments.json:
        say({"site": register.site, "hosts": register.hosts, "names": rows, "tokens": people})
        return
    rows += people
    for row in rows:
        tell(f"{row['name']:24} {row['role']:8} {row['expires'][:10]}  {row['state']}")


def _row(name: str, entry: RegisterEntry, now: datetime) -> dict[str, Any]:
    state = "revoked" if entry.revoked else _state(entry.expires, now)
    plain = {"name": name, "role": entry.role, "expires": entry.expires.isoformat(), "state": state}
    return {
        **plain,
        "revoked": entry.revoked,
        "serial": entry.serial,
        "registers.common_name": registers.common_name(name, entry.issue),
    }


def _state(expires: datetime, now: datetime) -> str:
    return "expired" if expires < now else "valid"


def _tell(arguments: Namespace, line: str, **values: Any) -> None:
    say(values) if arguments.json else tell(line)
