"""A site's key folder: private files, written atomically. Needs `cryptography`.

    KEYS/register.toml     names and roles, from which the router makes its rules
    KEYS/authority/        the authority's certificate and key, which can create any name
    KEYS/<name>/           files for the process of that name only

X.509, P-256 with SHA-256, PKCS #8 keys without password. The router has a server certificate (TLS server
authentication), all others client certificates: a stolen machine cannot pose as the router.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from ipaddress import ip_address
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from protocol.errors import ConfigError
from protocol.files import sealed
from protocol.wire.credentials import (
    AUTHORITY_FILE,
    CERTIFICATE_FILE,
    IDENTITY_FILE,
    KEY_FILE,
    SERVERS_FILE,
    SIGNING_FILE,
)
from sitegrid.security.register import ROUTER, Register, RegisterEntry, common_name, save_register, write_private
from sitegrid.security.signing import make_signing_key

AUTHORITY = "authority"
EARLY = timedelta(minutes=10)  # backdating for clock differences
UNUSED = (
    "content_commitment",
    "key_encipherment",
    "data_encipherment",
    "key_agreement",
    "encipher_only",
    "decipher_only",
)


def make_folder(folder: Path, site: str, now: datetime) -> None:
    """Create the folder with a site's authority."""
    _private_folder(folder)
    write_private(folder / ".gitignore", b"*\n")  # keys belong in no repository
    _private_folder(folder / AUTHORITY)
    authority = make_authority(site, now, now + timedelta(days=3650))
    write_private(folder / AUTHORITY / KEY_FILE, authority.key)
    write_private(folder / AUTHORITY / CERTIFICATE_FILE, authority.certificate)


def certify(folder: Path, register: Register, name: str, role: str, expires: datetime, now: datetime) -> Register:
    """Write a name's folder, then the register, which alone admits names."""
    authority = _authority(folder)
    number = register.next_issue(name)
    hosts = register.hosts if role == ROUTER else ()
    pair = issue(authority, common_name(name, number), now, expires, hosts)
    signing_key, public = _signing_key(folder, register, name, role)
    entry = RegisterEntry(role, pair.serial, expires_at(pair), number, signing=public)
    identity = f'site = "{register.site}"\nname = "{name}"\nrole = "{role}"\nexpires = {entry.expires.isoformat()}\n'
    files = {AUTHORITY_FILE: authority.certificate, CERTIFICATE_FILE: pair.certificate, KEY_FILE: pair.key}
    if signing_key:
        files[SIGNING_FILE] = signing_key
    if role == "machine":
        files[SERVERS_FILE] = "".join(f"{key}\n" for key in register.server_keys()).encode()
    _private_folder(folder / name)
    for file, data in {**files, IDENTITY_FILE: sealed(identity).encode()}.items():
        write_private(folder / name / file, data)
    register = register.with_entry(name, entry)
    save_register(folder, register)
    return register


def _signing_key(folder: Path, register: Register, name: str, role: str) -> tuple[bytes, str]:
    """Signing key, private and public; a map server keeps its own, known to all machines, while its file exists."""
    known, file = register.names.get(name), folder / name / SIGNING_FILE
    if role == "server" and known and known.signing and not known.revoked and file.is_file():
        return file.read_bytes(), known.signing
    return make_signing_key() if role in ("machine", "server") else (b"", "")


def _authority(folder: Path) -> KeyPair:
    place = folder / AUTHORITY
    try:
        return KeyPair((place / CERTIFICATE_FILE).read_bytes(), (place / KEY_FILE).read_bytes())
    except OSError as error:
        raise ConfigError(place, f"cannot be read ({error.strerror}); it lies where `sitegrid keys init` ran") from None


def _private_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
        path.chmod(0o700)
    except OSError as error:
        raise ConfigError(path, f"cannot be made: {error.strerror}") from None


@dataclass(frozen=True)
class KeyPair:
    """Certificate and private key, PEM."""

    certificate: bytes
    key: bytes

    @property
    def serial(self) -> str:
        """Certificate serial number, hex."""
        return f"{_certificate(self).serial_number:x}"


def make_authority(site: str, begins: datetime, expires: datetime) -> KeyPair:
    """Create a site's authority, for certificates only, without sub-authorities."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = _name(f"sitegrid {site} authority")
    builder = _builder(name, name, key, begins, expires, is_authority=True)
    return _pair(builder.sign(key, hashes.SHA256()), key)


def issue(
    authority: KeyPair, common_name: str, begins: datetime, expires: datetime, hosts: Sequence[str] = ()
) -> KeyPair:
    """Create a key and certificate.

    hosts: names and addresses it serves; none: client only.
    """
    key = ec.generate_private_key(ec.SECP256R1())
    issuer = _certificate(authority)
    signer = serialization.load_pem_private_key(authority.key, None)
    assert isinstance(signer, ec.EllipticCurvePrivateKey)
    expires = min(expires, issuer.not_valid_after_utc)
    builder = _builder(_name(common_name), issuer.subject, key, begins, expires, is_authority=False)
    purpose = ExtendedKeyUsageOID.SERVER_AUTH if hosts else ExtendedKeyUsageOID.CLIENT_AUTH
    builder = builder.add_extension(x509.ExtendedKeyUsage([purpose]), critical=False)
    origin = x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key())
    builder = builder.add_extension(origin, critical=False)
    if hosts:
        builder = builder.add_extension(x509.SubjectAlternativeName([_host(h) for h in hosts]), critical=False)
    return _pair(builder.sign(signer, hashes.SHA256()), key)


def expires_at(pair: KeyPair) -> datetime:
    """End of validity, UTC."""
    return _certificate(pair).not_valid_after_utc


def _certificate(pair: KeyPair) -> x509.Certificate:
    return x509.load_pem_x509_certificate(pair.certificate)


def _builder(
    subject: x509.Name,
    issuer: x509.Name,
    key: ec.EllipticCurvePrivateKey,
    begins: datetime,
    expires: datetime,
    *,
    is_authority: bool,
) -> x509.CertificateBuilder:
    builder = x509.CertificateBuilder().subject_name(subject).issuer_name(issuer).public_key(key.public_key())
    builder = builder.serial_number(x509.random_serial_number())
    builder = builder.not_valid_before(begins - EARLY).not_valid_after(expires)
    builder = builder.add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    path_length = 0 if is_authority else None
    builder = builder.add_extension(x509.BasicConstraints(ca=is_authority, path_length=path_length), critical=True)
    uses = dict.fromkeys(UNUSED, False) | dict.fromkeys(("key_cert_sign", "crl_sign"), is_authority)
    return builder.add_extension(x509.KeyUsage(digital_signature=not is_authority, **uses), critical=True)


def _name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _host(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _pair(certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey) -> KeyPair:
    pem = serialization.Encoding.PEM
    form, plain = serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    return KeyPair(certificate.public_bytes(pem), key.private_bytes(pem, form, plain))
