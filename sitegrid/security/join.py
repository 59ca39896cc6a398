"""Settings with which a command joins the network: with its keys, or without keys and then on this host only."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from ipaddress import ip_address
from pathlib import Path

from protocol.errors import ConfigError
from protocol.wire.credentials import SIGNING_FILE, check_valid, load_credentials
from protocol.wire.session import DEFAULT_ENDPOINT, DEFAULT_TLS_ENDPOINT, SessionConfig


def join(
    endpoint: str, keys: Path | None = None, wait_s: float = 5.0, *, role: str = "", name: str = "", site: str = ""
) -> SessionConfig:
    """Settings of a session with the router at `endpoint`; with keys, the default endpoint is the one with TLS.

    role, name, site: what the keys have to be for, where that matters. ConfigError says so of those that are not:
    the router would refuse them without a word.
    """
    try:
        if keys is None:
            return SessionConfig(endpoint, wait_s=wait_s)
        credentials = load_credentials(keys)
        check_valid(credentials, datetime.now(UTC))
        for what, required in (("role", role), ("name", name), ("site", site)):
            if required and (actual := getattr(credentials.identity, what)) != required:
                raise ConfigError(keys, f"these keys are for {what} {actual!r}, {required!r} is needed")
        return SessionConfig(with_keys(endpoint), wait_s=wait_s, credentials=credentials)
    except ValueError as error:
        raise ConfigError("network", str(error)) from None


def signer(keys: Path | None) -> Callable[[str, bytes], bytes] | None:
    """What signs a machine's batches, from key expression and payload, if its folder of keys has a signing key."""
    file = keys / SIGNING_FILE if keys else None
    if not file or not file.is_file():
        return None
    from sitegrid.security.signing import Signer  # imported here: only machines with keys need `cryptography`

    return Signer(file.read_bytes()).sign


def with_keys(endpoint: str) -> str:
    """The endpoint to use with keys: the default one becomes that with TLS."""
    return DEFAULT_TLS_ENDPOINT if endpoint == DEFAULT_ENDPOINT else endpoint


def is_loopback(endpoint: str) -> bool:
    """Whether only processes of this host reach a TCP endpoint; False where that is not certain."""
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.rpartition(":")
    if protocol != "tcp" or not port.isdecimal():
        return False
    try:
        return host == "localhost" or ip_address(host.removeprefix("[").removesuffix("]")).is_loopback
    except ValueError:
        return False
