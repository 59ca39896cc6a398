from datetime import UTC, datetime
from pathlib import Path

import pytest

from mapserver.query.region_pieces import PIECE_BYTES
from protocol.errors import LinkError
from protocol.wire.credentials import Credentials, Identity
from protocol.wire.session import SessionConfig, _settings, free_endpoint, open_session

CREDENTIALS = Credentials(Path("/keys/a"), Identity("paper", "a", "machine", datetime(2100, 1, 1, tzinfo=UTC)))


@pytest.mark.parametrize("mode", ["client", "router"])
def test_nothing_bypasses_the_router(mode):
    settings = _settings(SessionConfig(mode=mode))
    assert settings["transport/shared_memory/enabled"] is False
    assert settings["scouting/multicast/enabled"] is False
    assert settings["scouting/gossip/enabled"] is False


def test_client_listens_nowhere_and_router_at_its_endpoint():
    assert _settings(SessionConfig("tcp/127.0.0.1:1"))["listen/endpoints"] == []
    assert _settings(SessionConfig("tcp/127.0.0.1:1", mode="router"))["listen/endpoints"] == ["tcp/127.0.0.1:1"]


@pytest.mark.parametrize(("wait_s", "mode", "wait_ms"), [(2.5, "client", 2500), (0.0, "client", 0), (-1.0, "peer", -1)])
def test_a_client_waits_for_its_router_and_a_peer_connects_in_the_background(wait_s: float, mode: str, wait_ms: int):
    settings = _settings(SessionConfig(wait_s=wait_s))
    assert (settings["mode"], settings["connect/timeout_ms"]) == (mode, wait_ms)
    assert settings["connect/exit_on_failure"] is (mode == "client")


def test_a_whole_answer_fits_into_what_a_router_keeps_for_a_link():
    batches = _settings(SessionConfig(mode="router"))["transport/link/tx/queue/size/data"]
    assert batches * 65_000 >= PIECE_BYTES + 2**14  # the rest of the answer, and headers
    assert "transport/link/tx/queue/size/data" not in _settings(SessionConfig())


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"mode": "peer"}, "mode"),
        ({"endpoint": "7447"}, "endpoint"),
        ({"endpoint": "tls/127.0.0.1:7447"}, "needs keys"),
        ({"endpoint": "tcp/127.0.0.1:7447", "credentials": CREDENTIALS}, "proves no names"),
        ({"endpoint": "quic/127.0.0.1:7447", "credentials": CREDENTIALS}, "proves no names"),
    ],
)
def test_wrong_settings_are_named(fields, words):
    with pytest.raises(ValueError, match=words):
        SessionConfig(**fields)


@pytest.mark.parametrize(("mode", "end"), [("client", "connect"), ("router", "listen")])
def test_both_ends_prove_their_names(mode, end):
    """Without enable_mtls a client shows no certificate, and a router requests none."""
    tls = _settings(SessionConfig("tls/127.0.0.1:1", mode, credentials=CREDENTIALS))["transport/link/tls"]
    assert tls["enable_mtls"] is tls["verify_name_on_connect"] is tls["close_link_on_expiration"] is True
    assert tls["root_ca_certificate"] == "/keys/a/ca.pem"
    assert (tls[f"{end}_certificate"], tls[f"{end}_private_key"]) == ("/keys/a/cert.pem", "/keys/a/key.pem")
    assert "transport/link/tls" not in _settings(SessionConfig(mode=mode))


def test_with_keys_a_router_that_is_not_there_may_be_one_that_refuses(tmp_path):
    endpoint = free_endpoint().replace("tcp/", "tls/")
    for name in ("ca.pem", "cert.pem", "key.pem"):
        (tmp_path / name).write_text("no certificate")
    with pytest.raises(LinkError, match="do not know each other"):
        open_session(SessionConfig(endpoint, wait_s=0.2, credentials=Credentials(tmp_path, CREDENTIALS.identity)))
