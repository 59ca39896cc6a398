"""Keys of a process: validity, name and chain of the certificate."""

from __future__ import annotations

import ssl
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from protocol.errors import ConfigError
from protocol.wire.credentials import AUTHORITY_FILE, CERTIFICATE_FILE, KEY_FILE, Identity, load_credentials
from sitegrid.doctor import Finding, Level

EXPIRES_DAYS = 30


@dataclass(frozen=True)
class Certificate:
    """common_name: as stated. signed: by the authority beside it. fits: the private key. mode: of the key file."""

    identity: Identity
    common_name: str
    begins: datetime
    expires: datetime
    signed: bool
    fits: bool
    mode: int


def read_certificate(folder: Path) -> Certificate:
    """Read a folder of keys; ConfigError if anything is missing or unreadable."""
    from cryptography import x509  # needs the `security` extra
    from cryptography.exceptions import InvalidSignature
    from cryptography.x509.oid import NameOID

    identity, fits, signed = load_credentials(folder).identity, False, False
    try:
        certificate, authority = (
            x509.load_pem_x509_certificate((folder / name).read_bytes()) for name in (CERTIFICATE_FILE, AUTHORITY_FILE)
        )
        names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
        mode = (folder / KEY_FILE).stat().st_mode
        with suppress(ssl.SSLError):  # OpenSSL compares key and certificate on loading
            ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT).load_cert_chain(folder / CERTIFICATE_FILE, folder / KEY_FILE)
            fits = True
    except OSError as error:
        raise ConfigError(folder, f"cannot be read ({error.strerror}): run as the user that it belongs to") from None
    except ValueError as error:
        raise ConfigError(folder, f"holds no usable certificate ({error}): copy the whole folder again") from None
    with suppress(InvalidSignature, ValueError, TypeError):
        certificate.verify_directly_issued_by(authority)
        signed = True
    valid = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    return Certificate(identity, str(names[0].value) if names else "", *valid, signed, fits, mode)


def check_certificate(certificate: Certificate, now: datetime, site: str = "", machine: str = "") -> list[Finding]:
    """Validity, name, chain. site, machine: the certificate's purpose, if known."""
    who = f"{certificate.identity.role} {certificate.identity.name} of site {certificate.identity.site}"
    return [_validity(certificate, now, who), _name(certificate, site, machine, who), _chain(certificate)]


def _validity(certificate: Certificate, now: datetime, who: str) -> Finding:
    advice = f"make a new one with `sitegrid keys add {certificate.identity.name} --renew`"
    last_day = certificate.expires.astimezone(UTC).date()
    if now > certificate.expires:
        return Finding(Level.FAIL, "certificate", f"{who} expired on {last_day}", advice)
    if now < certificate.begins:
        begins = f"{certificate.begins.astimezone(UTC):%Y-%m-%d %H:%M}Z"
        return Finding(Level.FAIL, "certificate", f"{who} is valid from {begins} on", "set this host's clock")
    days = (certificate.expires - now).days
    if days < EXPIRES_DAYS:
        return Finding(Level.WARN, "certificate", f"{who} is valid until {last_day}, {days} days more", advice)
    return Finding(Level.PASS, "certificate", f"{who} is valid until {last_day}")


def _name(certificate: Certificate, site: str, machine: str, who: str) -> Finding:
    identity = certificate.identity
    name, _, issue = certificate.common_name.partition(".")  # re-added names are numbered (register.common_name)
    if name != identity.name or not (issue.isdecimal() or not issue):
        problem = f"identity.toml says {identity.name}, the certificate {certificate.common_name}"
        return Finding(Level.FAIL, "name", problem, "the files are of two folders: copy the whole folder again")
    if site and site != identity.site:
        problem = f"the keys are for site {identity.site}, not {site}"
        return Finding(Level.FAIL, "name", problem, "compare --site, --keys")
    if machine and identity.role == "machine" and machine != identity.name:
        return Finding(Level.FAIL, "name", f"the keys are those of {identity.name}, not of {machine}", "compare --keys")
    return Finding(Level.PASS, "name", f"the certificate is that of {who}")


def _chain(certificate: Certificate) -> Finding:
    advice = "the files are of two folders: copy the whole folder again"
    if not certificate.signed:
        return Finding(Level.FAIL, "authority", "ca.pem has not signed cert.pem", advice)
    if not certificate.fits:
        return Finding(Level.FAIL, "authority", "key.pem is not the key of cert.pem", advice)
    if certificate.mode & 0o077:
        problem = f"key.pem can be read by others (mode {certificate.mode & 0o777:o})"
        return Finding(Level.WARN, "authority", problem, "chmod 600 key.pem; if it was read, revoke it")
    return Finding(Level.PASS, "authority", "ca.pem has signed cert.pem, and key.pem is its key")
