import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from protocol.errors import ConfigError
from protocol.wire import keys

names = st.from_regex(r"[a-z0-9][a-z0-9_-]{0,62}", fullmatch=True)
OF_MACHINE = (keys.ingest, keys.pose, keys.health, keys.alive, keys.sensors)
ALL = {
    keys.ingest: keys.ingest_all,
    keys.pose: keys.poses_all,
    keys.health: keys.health_all,
    keys.alive: keys.alive_all,
}


@pytest.mark.parametrize("build", OF_MACHINE)
@given(site=names, machine=names)
def test_key_names_its_machine(build, site, machine):
    key = build(site, machine)
    assert keys.machine_of(key) == machine
    assert zenoh.KeyExpr(key).includes(zenoh.KeyExpr(key))  # valid and canonical


@pytest.mark.parametrize("build", ALL)
def test_subscription_matches_every_machine_of_its_site_alone(build):
    every = zenoh.KeyExpr(ALL[build]("paper"))
    assert every.intersects(zenoh.KeyExpr(build("paper", "loader-1")))
    assert not every.intersects(zenoh.KeyExpr(build("other", "loader-1")))
    for other in OF_MACHINE:
        assert other is build or not every.intersects(zenoh.KeyExpr(other("paper", "loader-1")))


@pytest.mark.parametrize(
    "name", ["", "*", "**", "a*", "$*", "a/b", "/", "a b", "A", "é", "a\n", "-a", "_a", "a?", "a#b", "@", "x" * 64]
)
def test_name_that_is_none_is_refused(name):
    for build in (*OF_MACHINE, keys.map_query, keys.admin):
        with pytest.raises(ConfigError, match="is not a name"):
            build("paper", name)
        with pytest.raises(ConfigError, match="is not a name"):
            build(name, "info")
    for build in (*ALL.values(), keys.map_queries_all, keys.admin_all, keys.changed):
        with pytest.raises(ConfigError, match="site"):
            build(name)


@pytest.mark.parametrize(
    "key",
    [
        "",
        "sitegrid",
        "sitegrid/paper/ingest/*",
        "other/paper/ingest/loader-1",
        "sitegrid/paper/map/info",
        "sitegrid/paper/machine//pose",
    ],
)
def test_key_without_a_machine_is_refused(key):
    with pytest.raises(ConfigError):
        keys.machine_of(key)
