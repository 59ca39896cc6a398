"""Signatures of batches: only the machine's own, for its own key, over the very bytes."""

from __future__ import annotations

import pytest

from protocol.errors import ConfigError, MessageError, Refusal
from protocol.wire import keys

signing = pytest.importorskip("sitegrid.security.signing", reason="cryptography is not installed")

KEY = keys.ingest("paper", "loader-1")
BATCH = b"\x83 a batch"


@pytest.fixture(scope="module")
def made() -> dict[str, tuple[bytes, str]]:
    return {name: signing.make_signing_key() for name in ("loader-1", "loader-2")}


@pytest.fixture
def verifier(made):
    return signing.Verifier({name: public for name, (_, public) in made.items()})


def test_a_machine_signs_what_it_sends(made, verifier):
    signature = signing.Signer(made["loader-1"][0]).sign(KEY, BATCH)
    assert len(signature) == 64
    verifier.check("loader-1", KEY, BATCH, signature)


@pytest.mark.parametrize(
    ("machine", "key", "payload"),
    [
        ("loader-1", KEY, BATCH + b"\0"),
        ("loader-1", KEY, BATCH[:-1]),
        ("loader-1", keys.ingest("north", "loader-1"), BATCH),
        ("loader-2", KEY, BATCH),
        ("loader-2", keys.ingest("paper", "loader-2"), BATCH),
    ],
)
def test_nothing_else_passes_with_that_signature(made, verifier, machine: str, key: str, payload: bytes):
    signature = signing.Signer(made["loader-1"][0]).sign(KEY, BATCH)
    with pytest.raises(MessageError, match="is not that of") as caught:
        verifier.check(machine, key, payload, signature)
    assert caught.value.reason == Refusal.WRONG_MACHINE


@pytest.mark.parametrize("bit", [0, 255, 511])
def test_an_altered_signature_is_none(made, verifier, bit: int):
    signature = bytearray(signing.Signer(made["loader-1"][0]).sign(KEY, BATCH))
    signature[bit // 8] ^= 1 << bit % 8
    with pytest.raises(MessageError, match="is not that of"):
        verifier.check("loader-1", KEY, BATCH, bytes(signature))


@pytest.mark.parametrize("signature", [b"x", bytes(63), bytes(64), bytes(65), bytes(4096)])
def test_bytes_that_are_no_signature_are_refused(verifier, signature: bytes):
    with pytest.raises(MessageError, match="is not that of"):
        verifier.check("loader-1", KEY, BATCH, signature)


def test_a_batch_without_signature_and_a_machine_without_key_are_told_apart(verifier):
    with pytest.raises(MessageError, match="is not signed"):
        verifier.check("loader-1", KEY, BATCH, b"")
    with pytest.raises(MessageError, match="no signing key of 'loader-3'"):
        verifier.check("loader-3", keys.ingest("paper", "loader-3"), BATCH, bytes(64))


def test_key_and_payload_do_not_run_into_each_other(made, verifier):
    """The end of the key must not pass for the beginning of the payload."""
    signature = signing.Signer(made["loader-1"][0]).sign(KEY, b"0" + BATCH)
    with pytest.raises(MessageError):
        verifier.check("loader-1", KEY + "0", BATCH, signature)


@pytest.mark.parametrize("pem", [b"", b"nonsense", b"-----BEGIN PRIVATE KEY-----\nMA==\n-----END PRIVATE KEY-----\n"])
def test_a_wrong_private_key_says_what_to_do(pem: bytes):
    with pytest.raises(ConfigError, match="sitegrid keys add --renew"):
        signing.Signer(pem)


@pytest.mark.parametrize("text", ["", "AAAA", "no base64!", "ü"])
def test_a_wrong_public_key_is_named(text: str):
    with pytest.raises(ConfigError, match="signing key of loader-1"):
        signing.Verifier({"loader-1": text})


# --- replies ---------------------------------------------------------------------------------------------------------

REPLY = b"ack"


@pytest.fixture(scope="module")
def server():
    return signing.make_signing_key()


def test_a_reply_is_believed_as_the_answer_to_one_batch_of_one_machine(made, server):
    private, public = server
    verifier = signing.ReplyVerifier([made["loader-1"][1], public])  # of several map servers any may answer
    signature = signing.Signer(private).sign_reply(KEY, BATCH, REPLY)
    assert verifier.is_genuine(KEY, BATCH, REPLY, signature)
    for key, payload, reply in ((f"{KEY}x", BATCH, REPLY), (KEY, BATCH + b"x", REPLY), (KEY, BATCH, b"nak")):
        assert not verifier.is_genuine(key, payload, reply, signature)
    for forged in (b"", bytes(64), signature[:-1], signing.Signer(private).sign(KEY, REPLY)):
        assert not verifier.is_genuine(KEY, BATCH, REPLY, forged)


def test_no_machine_can_sign_a_reply_to_another_one(made, server):
    forged = signing.Signer(made["loader-2"][0]).sign_reply(KEY, BATCH, REPLY)
    assert not signing.ReplyVerifier([server[1]]).is_genuine(KEY, BATCH, REPLY, forged)
