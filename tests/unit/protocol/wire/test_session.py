import os
from datetime import UTC, datetime
from pathlib import Path

import pytest

from mapserver.query.region_pieces import PIECE_BYTES
from protocol.errors import LinkError
from protocol.wire.credentials import Credentials, Identity
from protocol.wire.session import SessionConfig, _settings, free_endpoint, open_session, use_many_threads

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


def test_a_whole_answer_fits_into_what_a_router_keeps_for_a_link():
    batches = _settings(SessionConfig(mode="router"))["transport/link/tx/queue/size/data"]
    assert batches * 65_000 >= PIECE_BYTES + 2**14  # the rest of the answer, and headers
    assert "transport/link/tx/queue/size/data" not in _settings(SessionConfig())


def test_threads_that_were_asked_for_from_outside_stay(monkeypatch):
    monkeypatch.setenv("ZENOH_RUNTIME", "(rx: (worker_threads: 3))")
    use_many_threads()
    assert os.environ["ZENOH_RUNTIME"] == "(rx: (worker_threads: 3))"
    monkeypatch.delenv("ZENOH_RUNTIME")
    use_many_threads()
    assert "worker_threads: 64" in os.environ["ZENOH_RUNTIME"]
    monkeypatch.delenv("ZENOH_RUNTIME")


def test_negative_wait_is_for_ever():
    assert _settings(SessionConfig(wait_s=-1))["connect/timeout_ms"] == -1
    assert _settings(SessionConfig(wait_s=-1))["connect/exit_on_failure"] is False
    assert _settings(SessionConfig(wait_s=0.25))["connect/timeout_ms"] == 250


def test_unreachable_router_says_what_to_do():
    endpoint = free_endpoint()
    with pytest.raises(LinkError, match="sitegrid router") as caught:
        open_session(SessionConfig(endpoint, wait_s=0.2))
    assert str(caught.value).startswith(endpoint)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("endpoint", ["tcp/", "foo/bar", "tcp/256.0.0.1:x"])
def test_odd_endpoint_is_a_link_error(endpoint):
    with pytest.raises(LinkError):
        open_session(SessionConfig(endpoint, wait_s=0.1))


def test_address_that_is_taken_is_a_link_error():
    endpoint = free_endpoint()
    router = open_session(SessionConfig(endpoint, mode="router"))
    try:
        with pytest.raises(LinkError, match="cannot listen"):
            open_session(SessionConfig(endpoint, mode="router"))
        open_session(SessionConfig(endpoint)).close()
    finally:
        router.close()


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
    """Without enable_mtls at the client it would show no certificate; without it at the router none is asked for."""
    tls = _settings(SessionConfig("tls/127.0.0.1:1", mode, credentials=CREDENTIALS))["transport/link/tls"]
    assert tls["enable_mtls"] is tls["verify_name_on_connect"] is tls["close_link_on_expiration"] is True
    assert tls["root_ca_certificate"] == "/keys/a/ca.pem"
    assert (tls[f"{end}_certificate"], tls[f"{end}_private_key"]) == ("/keys/a/cert.pem", "/keys/a/key.pem")
    assert "transport/link/tls" not in _settings(SessionConfig(mode=mode))


def test_only_a_router_takes_rules():
    guard = {"access_control": {"enabled": True}}
    assert _settings(SessionConfig(mode="router", guard=guard))["access_control"] == {"enabled": True}
    assert "access_control" not in _settings(SessionConfig(guard=guard))


def test_with_keys_a_router_that_is_not_there_may_be_one_that_refuses(tmp_path):
    endpoint = free_endpoint().replace("tcp/", "tls/")
    for name in ("ca.pem", "cert.pem", "key.pem"):
        (tmp_path / name).write_text("no certificate")
    with pytest.raises(LinkError, match="do not know each other"):
        open_session(SessionConfig(endpoint, wait_s=0.2, credentials=Credentials(tmp_path, CREDENTIALS.identity)))
