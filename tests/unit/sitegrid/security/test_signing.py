"""Batch signatures: the machine's own, for its own key, over the exact bytes."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from protocol.errors import ConfigError, MessageError, Refusal
from protocol.files import sealed
from protocol.wire import keys
from sitegrid.security.tokens import TOKENS_FILE, TokenFile, Tokens, load_tokens, save_tokens

signing = pytest.importorskip("sitegrid.security.signing", reason="cryptography is not installed")

KEY = keys.ingest("paper", "loader-1")
BATCH = b"\x83 a batch"


@pytest.fixture(scope="module")
def made() -> dict[str, tuple[bytes, str]]:
    return {name: signing.make_signing_key() for name in ("loader-1", "loader-2")}


@pytest.fixture
def verifier(made):
    return signing.Verifier({name: public for name, (_, public) in made.items()})


@pytest.mark.parametrize(
    ("machine", "key", "payload"),
    [
        ("loader-1", KEY, BATCH + b"\0"),
        ("loader-1", keys.ingest("north", "loader-1"), BATCH),
        ("loader-2", KEY, BATCH),
    ],
)
def test_nothing_else_passes_with_that_signature(made, verifier, machine: str, key: str, payload: bytes):
    signature = signing.Signer(made["loader-1"][0]).sign(KEY, BATCH)
    with pytest.raises(MessageError, match="is not that of") as caught:
        verifier.check(machine, key, payload, signature)
    assert caught.value.reason == Refusal.WRONG_MACHINE


def test_a_batch_without_signature_and_a_machine_without_key_are_told_apart(verifier):
    with pytest.raises(MessageError, match="is not signed"):
        verifier.check("loader-1", KEY, BATCH, b"")
    with pytest.raises(MessageError, match="no signing key of 'loader-3'"):
        verifier.check("loader-3", keys.ingest("paper", "loader-3"), BATCH, bytes(64))


def test_key_and_payload_do_not_run_into_each_other(made, verifier):
    """The key's end must not pass for the payload's start."""
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
    verifier = signing.ReplyVerifier([made["loader-1"][1], public])  # any of several map servers may answer
    signature = signing.Signer(private).sign_reply(KEY, BATCH, REPLY)
    assert verifier.is_genuine(KEY, BATCH, REPLY, signature)
    for key, payload, reply in ((f"{KEY}x", BATCH, REPLY), (KEY, BATCH + b"x", REPLY), (KEY, BATCH, b"nak")):
        assert not verifier.is_genuine(key, payload, reply, signature)
    for forged in (b"", bytes(64), signature[:-1], signing.Signer(private).sign(KEY, REPLY)):
        assert not verifier.is_genuine(KEY, BATCH, REPLY, forged)


def test_no_machine_can_sign_a_reply_to_another_one(made, server):
    forged = signing.Signer(made["loader-2"][0]).sign_reply(KEY, BATCH, REPLY)
    assert not signing.ReplyVerifier([server[1]]).is_genuine(KEY, BATCH, REPLY, forged)


NOW = datetime(2026, 5, 1, tzinfo=UTC)
LATER = NOW + timedelta(days=30)


def test_a_token_is_its_persons_until_it_expires():
    tokens, token = Tokens().with_new("anna", LATER)
    assert tokens.person(token, NOW) == "anna"
    assert tokens.person(token, LATER) is None
    assert tokens.person(token[:-1] + "x", NOW) is None
    assert tokens.person("", NOW) is None
    assert len(token) >= 22, "128 bits"


def test_nothing_that_is_kept_is_the_token(tmp_path: Path):
    tokens, token = Tokens().with_new("anna", LATER)
    tokens, other = tokens.with_new("ben", LATER)
    save_tokens(tmp_path, tokens)
    text = (tmp_path / TOKENS_FILE).read_text()
    assert token not in text
    assert other not in text
    assert load_tokens(tmp_path) == tokens
    assert (tmp_path / TOKENS_FILE).stat().st_mode & 0o077 == 0


def test_a_new_token_replaces_the_old_one_and_revoked_ones_count_no_more(tmp_path: Path):
    tokens, first = Tokens().with_new("anna", LATER)
    tokens, second = tokens.with_new("anna", LATER)
    assert (tokens.person(first, NOW), tokens.person(second, NOW)) == (None, "anna")
    assert tokens.without("anna").person(second, NOW) is None
    with pytest.raises(ConfigError, match="'ben' has no token"):
        tokens.without("ben")


def test_a_file_is_read_again_when_it_changes(tmp_path: Path):
    with pytest.raises(ConfigError, match="sitegrid keys token NAME"):
        TokenFile(tmp_path)  # no tokens yet
    tokens, token = Tokens().with_new("anna", datetime.now(UTC) + timedelta(days=1))
    save_tokens(tmp_path, tokens)
    file = TokenFile(tmp_path)
    assert file.person("x") is None
    assert file.person(token) == "anna"
    save_tokens(tmp_path, tokens.without("anna"))
    assert file.person(token) is None


def test_a_file_that_is_damaged_later_lets_nobody_in_and_is_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    tokens, token = Tokens().with_new("anna", datetime.now(UTC) + timedelta(days=1))
    save_tokens(tmp_path, tokens)
    file = TokenFile(tmp_path)
    (tmp_path / TOKENS_FILE).write_text("[")
    assert file.person(token) is None
    assert file.person(token) is None
    assert [TOKENS_FILE in record.getMessage() for record in caplog.records] == [True], "logged once"
    save_tokens(tmp_path, tokens)
    assert file.person(token) == "anna"


@pytest.mark.parametrize(
    "text", ['[names.a]\nsha256 = "x"\nexpires = 2026-01-01T00:00:00Z\n', "[names.a]\n", "names = 3\n", "["]
)
def test_a_damaged_file_is_refused(tmp_path: Path, text: str):
    (tmp_path / TOKENS_FILE).write_text(sealed(text))
    with pytest.raises(ConfigError, match=TOKENS_FILE):
        load_tokens(tmp_path)
