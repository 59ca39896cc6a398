"""Personal tokens for the page, stored as hashes with a checksum, revocable one by one.

A token has 128 random bits, so plain SHA-256 is safe.
"""

from __future__ import annotations

import hashlib
import hmac
import logging
import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

from protocol.config import from_table, toml_lines
from protocol.errors import ConfigError
from protocol.files import load_sealed_toml, sealed
from sitegrid.security.register import write_private

TOKENS_FILE = "tokens.toml"
log = logging.getLogger("sitegrid.security.tokens")


@dataclass(frozen=True)
class TokenEntry:
    """One token: SHA-256, hex, and expiry."""

    sha256: str
    expires: datetime

    def __post_init__(self) -> None:
        if len(self.sha256) != 64 or set(self.sha256) - set("0123456789abcdef"):
            raise ValueError("sha256: no hash")
        if self.expires.tzinfo is None:
            raise ValueError("expires: no time zone is given")


@dataclass(frozen=True)
class Tokens:
    """Persons who may see the page."""

    names: Mapping[str, TokenEntry] = field(default_factory=dict)

    def person(self, token: str, now: datetime) -> str | None:
        """A token's person; None if unknown or expired."""
        digest = _digest(token)
        holders = [name for name, entry in self.names.items() if hmac.compare_digest(entry.sha256, digest)]
        return next((name for name in holders if self.names[name].expires > now), None)

    def with_new(self, name: str, expires: datetime) -> tuple[Tokens, str]:
        """Replace a person's token; returns the new one, which is not stored."""
        token = secrets.token_urlsafe(16)
        return replace(self, names={**self.names, name: TokenEntry(_digest(token), expires)}), token

    def without(self, name: str) -> Tokens:
        """Remove a person's token; ConfigError without one."""
        if name not in self.names:
            raise ConfigError("web", f"{name!r} has no token")
        return replace(self, names={key: entry for key, entry in self.names.items() if key != name})


def load_tokens(folder: Path) -> Tokens:
    """Tokens of a key folder, empty without a file."""
    path = folder / TOKENS_FILE
    return from_table(Tokens, load_sealed_toml(path), str(path)) if path.is_file() else Tokens()


def save_tokens(folder: Path, tokens: Tokens) -> None:
    """Write the tokens atomically."""
    lines = ["# Who may see the live page. Written by `sitegrid keys`."]
    for name, entry in sorted(tokens.names.items()):
        lines += ["", f"[names.{name}]", *toml_lines({"sha256": entry.sha256})]
        lines += [f"expires = {entry.expires.astimezone(UTC):%Y-%m-%dT%H:%M:%SZ}"]
    write_private(folder / TOKENS_FILE, sealed("\n".join(lines) + "\n").encode())


class TokenFile:
    """Current tokens of a folder: the file is reread on change, so revocations take effect.

    ConfigError without a readable file. If damaged later, it admits nobody, and is logged.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        if not (folder / TOKENS_FILE).is_file():
            problem = f"holds no {TOKENS_FILE}: make a token with `sitegrid keys token NAME --dir {folder}`"
            raise ConfigError(folder, problem)
        self._stamp: tuple[int, int] | None = None
        self._tokens = load_tokens(folder)

    def person(self, token: str) -> str | None:
        """A token's person, or None."""
        path = self._folder / TOKENS_FILE
        status = path.stat() if path.is_file() else None
        stamp = (status.st_mtime_ns, status.st_ino) if status else None
        if stamp != self._stamp:
            self._stamp = stamp
            try:
                self._tokens = load_tokens(self._folder)
            except ConfigError as error:
                log.error("nobody may join: %s", error)
                self._tokens = Tokens()
        return self._tokens.person(token, datetime.now(UTC))


def _digest(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()
