"""`sitegrid router`: the site's router, a Zenoh session in router mode."""

from __future__ import annotations

import logging
import threading
from argparse import ArgumentParser, Namespace
from datetime import UTC, datetime
from pathlib import Path

from protocol.errors import ConfigError
from protocol.wire.credentials import check_valid, load_credentials
from protocol.wire.session import DEFAULT_ENDPOINT, SessionConfig, open_session, use_many_threads
from sitegrid.process.lifetime import say, stop_flag
from sitegrid.process.supervisor import say_ready, turns
from sitegrid.security.access import router_settings
from sitegrid.security.join import is_loopback, with_keys
from sitegrid.security.register import REGISTER_FILE, ROUTER, Register, load_register

HELP = "run the site's Zenoh router"
log = logging.getLogger("sitegrid.router")


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("--listen", default=DEFAULT_ENDPOINT, help="endpoint to listen on (default %(default)s)")
    safety = parser.add_mutually_exclusive_group()
    keys = "folder with the site's keys; the default endpoint is tls/... then"
    safety.add_argument("--keys", type=Path, metavar="KEYS", help=keys)
    safety.add_argument("--insecure", action="store_true", help="accept connections from other hosts without keys")


def run(arguments: Namespace) -> int:
    """Route until stopped."""
    stop = stop_flag()
    use_many_threads()
    if arguments.keys:
        _route_guarded(arguments.keys, with_keys(arguments.listen), stop)
    else:
        _route_open(arguments.listen, stop, insecure=arguments.insecure)
    return 0


def _route_open(endpoint: str, stop: threading.Event, *, insecure: bool) -> None:
    """Route without keys: everybody may do everything, hence this host only, unless --insecure."""
    on_this_host = is_loopback(endpoint)
    if not (on_this_host or insecure):
        advice = "pass --keys (`sitegrid keys init`), listen on tcp/127.0.0.1:7447, or say --insecure"
        raise ConfigError(endpoint, f"anyone on the network could read and write the map: {advice}")
    session = open_session(SessionConfig(endpoint, mode="router"))
    reach = "this host only" if on_this_host else "open to everyone who gets here"
    say_ready({"ready": "router", "endpoint": endpoint, "security": f"none: {reach}"})
    for _ in turns(stop):
        pass
    session.close()  # type: ignore[no-untyped-call]


def _route_guarded(folder: Path, endpoint: str, stop: threading.Event) -> None:
    """Route with keys; a changed register needs a new session, because Zenoh reads rules on opening.

    All links break for half a second; permitted ones reconnect. An unreadable register changes nothing.
    """
    text, register = _text(folder), load_register(folder)
    session = open_session(_guarded(folder, endpoint, register))
    say_ready({"ready": "router", "endpoint": endpoint, "security": "mutual TLS", "names": len(register.admitted())})
    for _ in turns(stop):
        if (newer := _text(folder)) == text:
            continue
        text = newer
        try:
            register = load_register(folder)
            config = _guarded(folder, endpoint, register)
        except ConfigError as error:
            log.warning("the rules stay as they were error=%r", str(error))
            continue
        session.close()  # type: ignore[no-untyped-call]
        session = open_session(config)
        say({"reloaded": "rules", "names": len(register.admitted())})
    session.close()  # type: ignore[no-untyped-call]


def _guarded(folder: Path, endpoint: str, register: Register) -> SessionConfig:
    credentials = load_credentials(folder / ROUTER)
    check_valid(credentials, datetime.now(UTC))
    try:
        return SessionConfig(endpoint, mode="router", credentials=credentials, guard=router_settings(register))
    except ValueError as error:
        raise ConfigError("--listen", str(error)) from None


def _text(folder: Path) -> bytes:
    try:
        return (folder / REGISTER_FILE).read_bytes()
    except OSError:
        return b""
