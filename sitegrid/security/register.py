"""A site's name register (TOML): roles, validity, revocations.

The router's rules follow from it by the certificates' common names. A revoked name that is added again gets a new
common name, so the old certificate stays refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from protocol.config import from_table, toml_lines
from protocol.errors import ConfigError
from protocol.files import load_sealed_toml, sealed, write_whole
from protocol.wire.keys import check_name

REGISTER_FILE = "register.toml"
ROUTER = "router"  # name and role, one per site
ROLES = ("machine", "corrections", "visitor", "server", "follower", "admin", "sim")


@dataclass(frozen=True)
class RegisterEntry:
    """One name.

    serial: of the newest certificate, hex. issue: 1, plus 1 per return from revocation. signing: public key of its
    batches or replies, base64; empty if it sends none.
    """

    role: str
    serial: str
    expires: datetime
    issue: int = 1
    revoked: bool = False
    signing: str = ""

    def __post_init__(self) -> None:
        if self.role not in (*ROLES, ROUTER):
            raise ValueError(f"role: {self.role!r} is none of {', '.join(ROLES)}")
        if self.issue < 1:
            raise ValueError(f"issue: {self.issue} is not positive")
        if self.expires.tzinfo is None:
            raise ValueError("expires: no time zone is given")


@dataclass(frozen=True)
class Register:
    """All names of one site. hosts: the router's names and addresses."""

    site: str
    hosts: tuple[str, ...]
    names: Mapping[str, RegisterEntry]

    def admitted(self) -> dict[str, RegisterEntry]:
        """Names that may connect: neither revoked nor the router."""
        return {name: entry for name, entry in self.names.items() if not entry.revoked and entry.role != ROUTER}

    def signing_keys(self) -> dict[str, str]:
        """Public keys of accepted machines."""
        entries = self.admitted().items()
        return {name: entry.signing for name, entry in entries if entry.signing and entry.role == "machine"}

    def server_keys(self) -> list[str]:
        """Public keys of trusted map servers."""
        return [entry.signing for entry in self.admitted().values() if entry.signing and entry.role == "server"]

    def next_issue(self, name: str) -> int:
        """Issue of a new certificate for this name."""
        known = self.names.get(name)
        return 1 if known is None else known.issue + known.revoked

    def with_entry(self, name: str, entry: RegisterEntry) -> Register:
        """Add or replace a name."""
        return replace(self, names={**self.names, name: entry})

    def without(self, name: str) -> Register:
        """Revoke a name; ConfigError if impossible."""
        entry = self.names.get(name)
        if entry is None:
            raise ConfigError("keys", f"{name!r} is not in the register; see `sitegrid keys list`")
        if entry.role == ROUTER:
            raise ConfigError("keys", "machines trust the router's certificate itself: make a new folder with init")
        return self.with_entry(name, replace(entry, revoked=True))


def common_name(name: str, issue: int) -> str:
    """Common name of a certificate; unique, because names have no dots."""
    return name if issue == 1 else f"{name}.{issue}"


def load_register(folder: Path) -> Register:
    """Read a key folder's register; ConfigError if invalid."""
    path = folder / REGISTER_FILE
    if not path.is_file():
        raise ConfigError(folder, f"holds no {REGISTER_FILE}: make the folder with `sitegrid keys init --dir {folder}`")
    register = from_table(Register, load_sealed_toml(path), str(path))
    for name in (register.site, *register.names):
        check_name(name, str(path))
    return register


def save_register(folder: Path, register: Register) -> None:
    """Write the register atomically."""
    write_private(folder / REGISTER_FILE, register_toml(register).encode())


def write_private(path: Path, data: bytes) -> None:
    """Write an owner-only file atomically; ConfigError on failure."""
    try:
        write_whole(path, data, 0o600)
    except OSError as error:
        raise ConfigError(path, f"cannot be written: {error.strerror}") from None


def register_toml(register: Register) -> str:
    """The register as TOML with a checksum: a flipped bit must admit nobody."""
    lines = ["# Who may join. Written by `sitegrid keys`."]
    lines += toml_lines({"site": register.site, "hosts": list(register.hosts)})
    for name, entry in sorted(register.names.items()):
        lines += ["", f"[names.{name}]", *toml_lines({"role": entry.role, "serial": entry.serial})]
        lines += [f"expires = {entry.expires.astimezone(UTC):%Y-%m-%dT%H:%M:%SZ}"]
        lines += toml_lines({"issue": entry.issue, "revoked": entry.revoked, "signing": entry.signing})
    return sealed("\n".join(lines) + "\n")
