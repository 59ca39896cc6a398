"""`sitegrid web`: live page and map over HTTP."""

from __future__ import annotations

from argparse import ArgumentParser, ArgumentTypeError, Namespace
from contextlib import ExitStack
from ipaddress import ip_address
from pathlib import Path

from protocol.errors import ConfigError
from protocol.wire.keys import check_name
from sitegrid.options.groups import add_network
from sitegrid.options.values import address
from sitegrid.process.lifetime import return_large_blocks, stop_flag

EXTRA = "web"
HELP = "show the map in browsers, and to other tools over HTTP"


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    add = parser.add_argument
    add_network(parser)
    sites = "a site to show; with =ENDPOINT, by another router; may be repeated (default: that of the keys, else paper)"
    add("--site", type=_site, action="append", metavar="NAME[=ENDPOINT]", dest="sites", help=sites)
    beneath = "outline and base map of each site, as in config/web.toml"
    add("--config", type=Path, metavar="FILE", help=beneath)
    usual = ("127.0.0.1", 8080)
    listen = "address to listen on; port 0 takes a free one (default 127.0.0.1:8080)"
    add("--listen", type=address, default=usual, metavar="[HOST:]PORT", help=listen)
    host = "a name in the address of the page, as that of a proxy; may be repeated (IP addresses, localhost and the"
    add("--host", action="append", default=[], metavar="NAME", dest="hosts", help=f"{host} host's own name count)")
    safety = parser.add_mutually_exclusive_group()
    tokens = "let in only people with a token; FOLDER is that of the site's keys (see `sitegrid keys token`)"
    safety.add_argument("--tokens", type=Path, metavar="FOLDER", help=tokens)
    safety.add_argument("--insecure", action="store_true", help="show the map to other hosts without tokens")
    tls = "serve HTTPS; FOLDER holds cert.pem and key.pem"
    add("--tls", type=Path, metavar="FOLDER", help=tls)


def run(arguments: Namespace) -> int:
    """Serve until stopped."""
    from sitegrid.web.process import serve

    host, port = arguments.listen
    if not (arguments.tokens or arguments.insecure or _is_loopback(host)):
        advice = "give people tokens (`sitegrid keys token`) and pass --tokens, or say --insecure"
        problem = f"{host} is reached from other hosts: {advice}"
        raise ConfigError("--listen", problem)
    stop = stop_flag()
    return_large_blocks()
    with ExitStack() as opened:
        sites = arguments.sites or [(None, None)]
        return serve(opened, [(name, at or arguments.endpoint) for name, at in sites], (host, port), arguments, stop)


def _site(text: str) -> tuple[str, str | None]:
    name, _, endpoint = text.partition("=")
    try:
        return check_name(name, "--site"), endpoint or None
    except ConfigError as error:
        raise ArgumentTypeError(str(error)) from None


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False
