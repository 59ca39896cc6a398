import pytest

from protocol.errors import LinkError
from protocol.session import SessionConfig, _settings, free_endpoint, open_session


@pytest.mark.parametrize("mode", ["client", "router"])
def test_nothing_bypasses_the_router(mode):
    settings = _settings(SessionConfig(mode=mode))
    assert settings["transport/shared_memory/enabled"] is False
    assert settings["scouting/multicast/enabled"] is False
    assert settings["scouting/gossip/enabled"] is False


def test_client_listens_nowhere_and_router_at_its_endpoint():
    assert _settings(SessionConfig("tcp/127.0.0.1:1"))["listen/endpoints"] == []
    assert _settings(SessionConfig("tcp/127.0.0.1:1", mode="router"))["listen/endpoints"] == ["tcp/127.0.0.1:1"]


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


@pytest.mark.parametrize(("fields", "words"), [({"mode": "peer"}, "mode"), ({"endpoint": "7447"}, "endpoint")])
def test_wrong_settings_are_named(fields, words):
    with pytest.raises(ValueError, match=words):
        SessionConfig(**fields)
