"""Credentials of a process: one folder of files that `sitegrid keys` makes. The base install can read it.

identity.toml repeats the certificate's role, name and end as text, so that a wrong or outdated folder is reported at
once: a router that refuses a certificate does not answer at all.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from protocol.config import from_table
from protocol.errors import ConfigError
from protocol.files import load_sealed_toml

AUTHORITY_FILE, CERTIFICATE_FILE, KEY_FILE, IDENTITY_FILE = "ca.pem", "cert.pem", "key.pem", "identity.toml"
SIGNING_FILE = "sign.pem"  # machines and map servers only
SERVERS_FILE = "servers.pub"  # machines only: public keys that replies to batches are signed with, one a line


@dataclass(frozen=True)
class Identity:
    """The holder of a certificate. role: see docs/security.md. expires: the end of its validity."""

    site: str
    name: str
    role: str
    expires: datetime


@dataclass(frozen=True)
class Credentials:
    """A folder with the certificate, its private key, the certificate of the site's authority, and the identity."""

    folder: Path
    identity: Identity

    def tls(self, *, listens: bool) -> Mapping[str, object]:
        """Settings of Zenoh for mutual TLS; a link ends when one of its certificates expires."""
        end = "listen" if listens else "connect"
        return {
            "root_ca_certificate": str(self.folder / AUTHORITY_FILE),
            f"{end}_certificate": str(self.folder / CERTIFICATE_FILE),
            f"{end}_private_key": str(self.folder / KEY_FILE),
            "enable_mtls": True,  # on both ends: a client without it shows no certificate
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
        }


def load_credentials(folder: Path) -> Credentials:
    """Read a folder that `sitegrid keys` made; ConfigError where a file is missing."""
    for name in (IDENTITY_FILE, AUTHORITY_FILE, CERTIFICATE_FILE, KEY_FILE):
        if not (folder / name).is_file():
            raise ConfigError(folder, f"holds no {name}; name the folder of one certificate, as KEYS/loader-1")
    where = folder / IDENTITY_FILE
    identity = from_table(Identity, load_sealed_toml(where), str(where))
    if identity.expires.tzinfo is None:
        raise ConfigError(where, "expires: no time zone is given")
    return Credentials(folder, identity)


def check_valid(credentials: Credentials, now: datetime) -> None:
    """ConfigError if the certificate has expired."""
    identity = credentials.identity
    if now > identity.expires:
        day = identity.expires.date()  # in its own zone: near the year 1 there is no other
        advice = f"make a new one with `sitegrid keys add {identity.name} --renew`"
        raise ConfigError(credentials.folder, f"the certificate of {identity.name} expired on {day}; {advice}")
