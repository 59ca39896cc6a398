"""Session settings of a command: with keys, or without keys on this host only."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING

from protocol.errors import ConfigError
from protocol.wire.credentials import SERVERS_FILE, SIGNING_FILE, check_valid, load_credentials
from protocol.wire.session import DEFAULT_ENDPOINT, DEFAULT_TLS_ENDPOINT, SessionConfig

if TYPE_CHECKING:
    from sitegrid.security.signing import Signer


def join(
    endpoint: str, keys: Path | None = None, wait_s: float = 5.0, *, role: str = "", name: str = "", site: str = ""
) -> SessionConfig:
    """Session settings for the router at `endpoint`; with keys the default endpoint is the TLS one.

    role, name, site: required of the keys, if given; else ConfigError, because the router would refuse silently.
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


def reply_check(keys: Path | None) -> Callable[[str, bytes, bytes, bytes], bool] | None:
    """Checker of replies to a machine's batches, if its folder has the servers' keys and a signing key."""
    if not keys or not (keys / SIGNING_FILE).is_file() or not (keys / SERVERS_FILE).is_file():
        return None
    from sitegrid.security.signing import ReplyVerifier

    return ReplyVerifier((keys / SERVERS_FILE).read_text(encoding="ascii").split()).is_genuine


def signer(keys: Path | None) -> Signer | None:
    """Signer of a machine's batches or a server's replies, if its folder has a signing key."""
    file = keys / SIGNING_FILE if keys else None
    if not file or not file.is_file():
        return None
    from sitegrid.security.signing import Signer  # `cryptography` is needed with keys only

    return Signer(file.read_bytes())


def with_keys(endpoint: str) -> str:
    """With keys the default endpoint becomes the TLS one."""
    return DEFAULT_TLS_ENDPOINT if endpoint == DEFAULT_ENDPOINT else endpoint


def is_loopback(endpoint: str) -> bool:
    """Whether a TCP endpoint is reachable from this host only; False if uncertain."""
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.rpartition(":")
    if protocol != "tcp" or not port.isdecimal():
        return False
    try:
        return host == "localhost" or ip_address(host.removeprefix("[").removesuffix("]")).is_loopback
    except ValueError:
        return False
