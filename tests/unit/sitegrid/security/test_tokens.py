from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from protocol.errors import ConfigError
from sitegrid.security.tokens import TOKENS_FILE, TokenFile, Tokens, load_tokens, save_tokens

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
        TokenFile(tmp_path)  # nobody has one yet
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
    (tmp_path / TOKENS_FILE).write_text(text)
    with pytest.raises(ConfigError, match=TOKENS_FILE):
        load_tokens(tmp_path)
