"""X.509 certificates of one site: the authority's, and those that it signs. Needs `cryptography`; touches no files.

P-256 with SHA-256, PKCS #8 keys without a password. The router's certificate is a server's (TLS server authentication),
all others are clients': a stolen machine cannot act as the router.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from ipaddress import ip_address

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

EARLY = timedelta(minutes=10)  # valid from before now: the clocks of machines differ
UNUSED = (
    "content_commitment",
    "key_encipherment",
    "data_encipherment",
    "key_agreement",
    "encipher_only",
    "decipher_only",
)


@dataclass(frozen=True)
class KeyPair:
    """A certificate and its private key, both PEM."""

    certificate: bytes
    key: bytes

    @property
    def serial(self) -> str:
        """The serial number of the certificate, as hex digits."""
        return f"{_certificate(self).serial_number:x}"


def make_authority(site: str, begins: datetime, expires: datetime) -> KeyPair:
    """Make the authority of a site: it signs certificates, and no further authorities."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = _name(f"sitegrid {site} authority")
    builder = _builder(name, name, key, begins, expires, is_authority=True)
    return _pair(builder.sign(key, hashes.SHA256()), key)


def issue(
    authority: KeyPair, common_name: str, begins: datetime, expires: datetime, hosts: Sequence[str] = ()
) -> KeyPair:
    """Make a key and have the authority sign it.

    hosts: names and addresses that it serves at; none: it only connects.
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
    """The end of a certificate's validity, UTC."""
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
