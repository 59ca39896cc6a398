"""A process's credentials: a folder made by `sitegrid keys`.

identity.toml repeats the certificate's role, name and end as text, to report a wrong or outdated folder; routers do not
answer refused certificates.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from protocol.config import from_table
from protocol.errors import ConfigError
from protocol.files import load_sealed_toml

AUTHORITY_FILE, CERTIFICATE_FILE, KEY_FILE, IDENTITY_FILE = "ca.pem", "cert.pem", "key.pem", "identity.toml"
SIGNING_FILE = "sign.pem"  # of machines and map servers
SERVERS_FILE = "servers.pub"  # of machines: public keys for replies to batches, one a line


@dataclass(frozen=True)
class Identity:
    """A certificate's holder. role: see docs/security.md. expires: end of validity."""

    site: str
    name: str
    role: str
    expires: datetime


@dataclass(frozen=True)
class Credentials:
    """A folder with certificate, private key, authority's certificate, identity."""

    folder: Path
    identity: Identity

    def tls(self, *, listens: bool) -> Mapping[str, object]:
        """Zenoh settings of mutual TLS; links end when a certificate expires."""
        end = "listen" if listens else "connect"
        return {
            "root_ca_certificate": str(self.folder / AUTHORITY_FILE),
            f"{end}_certificate": str(self.folder / CERTIFICATE_FILE),
            f"{end}_private_key": str(self.folder / KEY_FILE),
            "enable_mtls": True,  # at both ends: a client without it shows no certificate
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
        }


def load_credentials(folder: Path) -> Credentials:
    """Read a folder of `sitegrid keys`; ConfigError."""
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
        day = identity.expires.date()  # in its own zone, as conversion fails near the year 1
        advice = f"make a new one with `sitegrid keys add {identity.name} --renew`"
        raise ConfigError(credentials.folder, f"the certificate of {identity.name} expired on {day}; {advice}")
