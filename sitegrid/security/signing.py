"""Ed25519 signatures of batches and replies, safe from everyone on the way, the router included.

The signature is the query's attachment; servers without signatures ignore it. Key expression and payload are signed, so
a batch is valid for one machine of one site. Replays are harmless: samples are numbered. A reply is signed with its
batch, so it answers no other. Needs `cryptography`.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
from collections.abc import Iterable, Mapping

from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from protocol.errors import ConfigError, MessageError, Refusal

_CONTEXT = b"sitegrid batch 1\0"  # domain separation
_REPLY_CONTEXT = b"sitegrid reply 1\0"


class Signer:
    """Signs a machine's batches, or a map server's replies.

    private_key: PEM; ConfigError unless Ed25519.
    """

    def __init__(self, private_key: bytes) -> None:
        try:
            key = serialization.load_pem_private_key(private_key, None)
        except (ValueError, TypeError, UnsupportedAlgorithm):
            key = None
        if not isinstance(key, Ed25519PrivateKey):
            raise ConfigError("signing key", "is no Ed25519 key; make new keys with `sitegrid keys add --renew`")
        self._key = key

    def sign(self, key_expression: str, payload: bytes) -> bytes:
        """Signature of a batch sent to a key, 64 bytes."""
        return self._key.sign(_signed(key_expression, payload))

    def sign_reply(self, key_expression: str, payload: bytes, reply: bytes) -> bytes:
        """Signature of the reply to a batch, 64 bytes."""
        return self._key.sign(_signed_reply(key_expression, payload, reply))


class ReplyVerifier:
    """Verifies replies. public_keys: of the site's map servers, base64 of 32 bytes each."""

    def __init__(self, public_keys: Iterable[str]) -> None:
        self._keys = [_public_key("a map server", text) for text in public_keys]

    def is_genuine(self, key_expression: str, payload: bytes, reply: bytes, signature: bytes) -> bool:
        """Whether a map server of the site gave this reply to this batch."""
        signed = _signed_reply(key_expression, payload, reply)
        return any(_fits(key, signature, signed) for key in self._keys)


class Verifier:
    """Verifies batches. public_keys: by machine, base64 of 32 bytes each."""

    def __init__(self, public_keys: Mapping[str, str]) -> None:
        self._keys = {machine: _public_key(machine, text) for machine, text in public_keys.items()}

    def check(self, machine: str, key_expression: str, payload: bytes, signature: bytes) -> None:
        """MessageError unless the machine signed this payload for this key."""
        key = self._keys.get(machine)
        if key is None:
            raise MessageError(Refusal.WRONG_MACHINE, f"no signing key of {machine!r} is in the register")
        if not signature:
            raise MessageError(Refusal.WRONG_MACHINE, "the batch is not signed, and this server asks for it")
        if not _fits(key, signature, _signed(key_expression, payload)):
            problem = f"the signature is not that of {machine!r}; compare its keys with the register"
            raise MessageError(Refusal.WRONG_MACHINE, problem)


def make_signing_key() -> tuple[bytes, str]:
    """A new key: private part as PEM, public part as in the register."""
    key = Ed25519PrivateKey.generate()
    form, plain = serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    private = key.private_bytes(serialization.Encoding.PEM, form, plain)
    return private, base64.b64encode(key.public_key().public_bytes_raw()).decode()


def _public_key(machine: str, text: str) -> Ed25519PublicKey:
    try:
        return Ed25519PublicKey.from_public_bytes(base64.b64decode(text, validate=True))
    except (ValueError, binascii.Error):
        raise ConfigError(f"signing key of {machine}", f"{text!r} is no public key of Ed25519") from None


def _signed(key_expression: str, payload: bytes) -> bytes:
    return _CONTEXT + key_expression.encode() + b"\0" + payload


def _signed_reply(key_expression: str, payload: bytes, reply: bytes) -> bytes:
    return _REPLY_CONTEXT + key_expression.encode() + b"\0" + hashlib.sha256(payload).digest() + reply


def _fits(key: Ed25519PublicKey, signature: bytes, signed: bytes) -> bool:
    try:
        key.verify(signature, signed)
    except InvalidSignature:
        return False
    return True
