"""Tokens of people who may see the page: one per person, kept as hashes behind a checksum, revoked one by one.

A token is 128 random bits, so that a plain SHA-256 of it cannot be turned back.
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
    """One person's token: its SHA-256, hex, and until when it counts."""

    sha256: str
    expires: datetime

    def __post_init__(self) -> None:
        if len(self.sha256) != 64 or set(self.sha256) - set("0123456789abcdef"):
            raise ValueError("sha256: no hash")
        if self.expires.tzinfo is None:
            raise ValueError("expires: no time zone is given")


@dataclass(frozen=True)
class Tokens:
    """Who may see the page."""

    names: Mapping[str, TokenEntry] = field(default_factory=dict)

    def person(self, token: str, now: datetime) -> str | None:
        """Whose token this is; None where it is nobody's, or no longer counts."""
        digest = _digest(token)
        holders = [name for name, entry in self.names.items() if hmac.compare_digest(entry.sha256, digest)]
        return next((name for name in holders if self.names[name].expires > now), None)

    def with_new(self, name: str, expires: datetime) -> tuple[Tokens, str]:
        """With a new token for a person, in place of an older one; and the token, which nothing keeps."""
        token = secrets.token_urlsafe(16)
        return replace(self, names={**self.names, name: TokenEntry(_digest(token), expires)}), token

    def without(self, name: str) -> Tokens:
        """Without a person's token; ConfigError where there is none."""
        if name not in self.names:
            raise ConfigError("web", f"{name!r} has no token")
        return replace(self, names={key: entry for key, entry in self.names.items() if key != name})


def load_tokens(folder: Path) -> Tokens:
    """The tokens in a folder of keys; none where nobody has one yet."""
    path = folder / TOKENS_FILE
    return from_table(Tokens, load_sealed_toml(path), str(path)) if path.is_file() else Tokens()


def save_tokens(folder: Path, tokens: Tokens) -> None:
    """Write the tokens into a folder of keys, whole or not at all."""
    lines = ["# Who may see the live page. Written by `sitegrid keys`."]
    for name, entry in sorted(tokens.names.items()):
        lines += ["", f"[names.{name}]", *toml_lines({"sha256": entry.sha256})]
        lines += [f"expires = {entry.expires.astimezone(UTC):%Y-%m-%dT%H:%M:%SZ}"]
    write_private(folder / TOKENS_FILE, sealed("\n".join(lines) + "\n").encode())


class TokenFile:
    """Tokens of a folder as they are now: the file is read again when it changes, so a revoked one counts no more.

    ConfigError where there is no file that can be read. One that is damaged later lets nobody in, and is logged.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        if not (folder / TOKENS_FILE).is_file():
            problem = f"holds no {TOKENS_FILE}: make a token with `sitegrid keys token NAME --dir {folder}`"
            raise ConfigError(folder, problem)
        self._stamp: tuple[int, int] | None = None
        self._tokens = load_tokens(folder)

    def person(self, token: str) -> str | None:
        """Whose token this is; None where it is nobody's."""
        path = self._folder / TOKENS_FILE
        status = path.stat() if path.is_file() else None
        stamp = (status.st_mtime_ns, status.st_ino) if status else None
        if stamp != self._stamp:
            self._stamp = stamp
            try:
                self._tokens = load_tokens(self._folder)
            except ConfigError as error:
                log.error("nobody is let in: %s", error)
                self._tokens = Tokens()
        return self._tokens.person(token, datetime.now(UTC))


def _digest(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()
