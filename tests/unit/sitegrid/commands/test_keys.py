"""Keys, register, and the router's rules."""

from __future__ import annotations

import inspect
import json
import stat
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path

import pytest
import zenoh

from protocol.errors import ConfigError
from protocol.files import sealed
from protocol.wire import keys
from protocol.wire.codec import MAX_BATCH_BYTES
from protocol.wire.credentials import check_valid, load_credentials
from protocol.wire.session import DEFAULT_ENDPOINT, DEFAULT_TLS_ENDPOINT
from sitegrid.cli import main
from sitegrid.client import connect
from sitegrid.security.access import access_control, router_settings
from sitegrid.security.join import is_loopback, join
from sitegrid.security.register import Register, RegisterEntry, load_register, register_toml
from sitegrid.security.tokens import load_tokens

x509 = pytest.importorskip("cryptography.x509", reason="cryptography is not installed")

NOW = datetime(2026, 1, 31, tzinfo=UTC)
SITE = "paper"
AGENT_FILES = ("--site-file", "config/site.toml", "--config", "config/agent.toml")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "keys"
    assert main(["keys", "init", "--dir", str(made), "--site", SITE, "--host", "10.0.0.5", "router.site"]) == 0
    return made


def act(folder: Path, action: str, *words: str) -> int:
    return main(["keys", action, *words, "--dir", str(folder)])


def certificate(folder: Path, name: str) -> x509.Certificate:
    return x509.load_pem_x509_certificate((folder / name / "cert.pem").read_bytes())


def refused(capsys, folder: Path, action: str, *words: str) -> str:
    """The error's only line."""
    capsys.readouterr()
    assert act(folder, action, *words) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


def test_whoever_asks_with_keys_asks_the_site_of_the_keys(folder: Path, monkeypatch):
    monkeypatch.setattr("sitegrid.client.open_session", lambda _: None)
    other = folder.parent / "quarry"
    assert main(["keys", "init", "--dir", str(other), "--site", "quarry"]) == 0
    assert act(other, "add", "office", "--role", "visitor") == 0
    assert connect(keys=other / "office").site == "quarry"
    assert connect().site == "paper"
    with pytest.raises(ConfigError, match="for site 'quarry', 'pit' is needed"):
        connect(site="pit", keys=other / "office")


# --- certificates ----------------------------------------------------------------------------------------------------


def test_only_the_owner_reads_keys(folder: Path):
    assert act(folder, "add", "loader-1") == 0
    for path in (folder, *folder.rglob("*")):
        assert stat.S_IMODE(path.stat().st_mode) == (0o700 if path.is_dir() else 0o600), path
    assert not list(folder.rglob("*.part"))
    assert (folder / ".gitignore").read_text() == "*\n"
    assert not (folder / "loader-1" / "authority").exists()
    assert (folder / "loader-1" / "ca.pem").read_bytes() == (folder / "authority" / "cert.pem").read_bytes()


def test_certificates_say_who_and_what_for(folder: Path):
    assert act(folder, "add", "loader-1") == 0
    for name, purpose in (("router", "serverAuth"), ("server", "clientAuth"), ("loader-1", "clientAuth")):
        issued = certificate(folder, name)
        assert issued.subject.rfc4514_string() == f"CN={name}"
        assert issued.public_key().curve.name == "secp256r1"
        uses = issued.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
        assert [use._name for use in uses] == [purpose]
        assert not issued.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
        issued.verify_directly_issued_by(certificate(folder, "authority"))
    hosts = certificate(folder, "router").extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert hosts.get_values_for_type(x509.DNSName) == ["localhost", "router.site"]
    assert [str(ip) for ip in hosts.get_values_for_type(x509.IPAddress)] == ["127.0.0.1", "10.0.0.5"]
    with pytest.raises(x509.ExtensionNotFound):
        certificate(folder, "loader-1").extensions.get_extension_for_class(x509.SubjectAlternativeName)


def test_validity_is_ten_years_one_year_or_as_asked(folder: Path):
    assert act(folder, "add", "loader-1", "--days", "5") == 0
    days = {name: lifetime(certificate(folder, name)).days for name in ("authority", "router", "server", "loader-1")}
    assert days == {"authority": 3650, "router": 365, "server": 365, "loader-1": 5}
    assert load_register(folder).names["loader-1"].expires == certificate(folder, "loader-1").not_valid_after_utc
    assert load_credentials(folder / "loader-1").identity.expires == certificate(folder, "loader-1").not_valid_after_utc


def lifetime(issued: x509.Certificate) -> timedelta:
    return issued.not_valid_after_utc - issued.not_valid_before_utc


def test_no_certificate_outlives_its_authority():
    from sitegrid.security.key_folder import expires_at, issue, make_authority

    authority = make_authority(SITE, NOW, NOW + timedelta(days=10))
    assert expires_at(issue(authority, "loader-1", NOW, NOW + timedelta(days=99))) == NOW + timedelta(days=10)


# --- commands --------------------------------------------------------------------------------------------------------


def test_nothing_is_overwritten(folder: Path, capsys):
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    assert "is not empty" in refused(capsys, folder, "init")
    assert "--renew makes it a new one" in refused(capsys, folder, "add", "server")
    assert "--renew makes it a new one" in refused(capsys, folder, "add", "router")
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("name", ["Loader", "a.2", "a/b", "*", "", "a b", "ä"])
def test_odd_names_are_refused(folder: Path, name: str, capsys):
    assert "is not a name" in refused(capsys, folder, "add", name)
    of_authority = refused(capsys, folder, "add", "authority")
    assert "keys add: 'authority' is the folder of the authority; choose another name" in of_authority


@pytest.mark.parametrize("host", ["bad host", "a..b", "-x", "höst", "x" * 64, ""])
def test_an_odd_host_is_refused_before_anything_is_written(tmp_path: Path, host: str, capsys):
    assert main(["keys", "init", "--dir", str(tmp_path / "keys"), f"--host={host}"]) == 1
    assert "neither the name of a host" in capsys.readouterr().err
    assert not (tmp_path / "keys").exists()


def test_renewed_keys_keep_name_and_role(folder: Path, capsys):
    assert act(folder, "add", "guest", "--role", "visitor") == 0
    before = load_register(folder).names["guest"]
    assert act(folder, "add", "guest", "--renew", "--days", "9") == 0
    after = load_register(folder).names["guest"]
    assert (after.role, after.issue) == ("visitor", 1)
    assert after.serial != before.serial
    assert after.expires < before.expires
    assert "is a visitor" in refused(capsys, folder, "add", "guest", "--renew", "--role", "admin")
    assert "leave out --renew" in refused(capsys, folder, "add", "nobody", "--renew")
    assert act(folder, "add", "router", "--renew") == 0
    assert load_register(folder).names["router"].role == "router"
    hosts = certificate(folder, "router").extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert "router.site" in hosts.get_values_for_type(x509.DNSName)


def test_a_revoked_name_comes_back_as_another(folder: Path, capsys):
    assert act(folder, "add", "loader-1") == 0
    for issue in (2, 3):
        assert act(folder, "revoke", "loader-1") == 0
        assert "loader-1" not in load_register(folder).admitted()
        assert "leave out --renew" in refused(capsys, folder, "add", "loader-1", "--renew")
        assert act(folder, "add", "loader-1", "--role", "visitor") == 0
        assert load_register(folder).admitted()["loader-1"].issue == issue
        assert certificate(folder, "loader-1").subject.rfc4514_string() == f"CN=loader-1.{issue}"
    assert load_register(folder).names["loader-1"].role == "visitor"


def test_list_tells_names_roles_expiry_and_state(folder: Path, capsys):
    assert act(folder, "add", "loader-1") == 0
    assert act(folder, "revoke", "loader-1") == 0
    register = load_register(folder)
    old = RegisterEntry("visitor", "1", NOW - timedelta(days=1))
    (folder / "register.toml").write_text(register_toml(register.with_entry("old", old)))
    capsys.readouterr()
    assert act(folder, "list", "--json") == 0
    listed = json.loads(capsys.readouterr().out)
    assert listed["site"] == SITE
    rows = {row["name"]: row for row in listed["names"]}
    states = {name: (row["role"], row["state"], row["revoked"]) for name, row in rows.items()}
    of_site = {name: (name, "valid", False) for name in ("router", "server")}
    assert states == {"loader-1": ("machine", "revoked", True), "old": ("visitor", "expired", False), **of_site}
    assert rows["old"]["expires"] == "2026-01-30T00:00:00+00:00"
    assert act(folder, "list") == 0
    assert "old                      visitor  2026-01-30  expired" in capsys.readouterr().out


# --- the register ----------------------------------------------------------------------------------------------------


def change(path: Path, old: str, new: str) -> None:
    """Change the text and reseal it."""
    _, _, text = path.read_text().partition("\n")
    path.write_text(sealed(text.replace(old, new)))


@pytest.mark.parametrize("place", ["register.toml", "tokens.toml", "server/identity.toml"])
def test_no_flipped_bit_lets_anybody_in(folder: Path, place: str):
    """Bits all over the text files: refused by file name."""
    path = folder / place
    act(folder, "token", "anna")
    loads = {"register.toml": load_register, "tokens.toml": load_tokens, "identity.toml": load_credentials}
    load = partial(loads[path.name], path.parent)
    load()
    whole = path.read_bytes()
    for at in range(0, 8 * len(whole), 37):
        damaged = bytearray(whole)
        damaged[at // 8] ^= 1 << at % 8
        path.write_bytes(damaged)
        with pytest.raises(ConfigError, match=path.name):
            load()


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ('role = "server"', 'role = "king"', "'king' is none of"),
        ("issue = 1", "issue = 0", "issue: 0 is not positive"),
        ("Z\n", "\n", "no time zone"),
        ("[names.server]", '[names."a*"]', "is not a name"),
        ('site = "paper"', 'site = "**"', "is not a name"),
    ],
)
def test_a_wrong_register_is_refused(folder: Path, old: str, new: str, problem: str):
    path = folder / "register.toml"
    change(path, old, new)
    with pytest.raises(ConfigError, match=r"register\.toml") as caught:
        load_register(folder)
    assert problem in str(caught.value)


def test_only_machines_have_signing_keys_and_the_register_knows_them(folder: Path):
    from sitegrid.security.signing import Signer, Verifier

    for name, role in (("loader-1", "machine"), ("guest", "visitor")):
        assert act(folder, "add", name, "--role", role) == 0
    register = load_register(folder)
    assert set(register.signing_keys()) == {"loader-1"}
    assert not (folder / "guest" / "sign.pem").exists()
    signature = Signer((folder / "loader-1" / "sign.pem").read_bytes()).sign("a", b"b")
    Verifier(register.signing_keys()).check("loader-1", "a", b"b", signature)
    assert register.without("loader-1").signing_keys() == {}


def test_a_machine_knows_the_keys_of_the_map_servers_which_outlast_a_new_certificate(folder: Path):
    from sitegrid.security.signing import ReplyVerifier, Signer

    assert act(folder, "add", "loader-1") == 0
    known = (folder / "loader-1" / "servers.pub").read_text().split()
    assert known == load_register(folder).server_keys()
    assert act(folder, "add", "server", "--renew") == 0
    signature = Signer((folder / "server" / "sign.pem").read_bytes()).sign_reply("a", b"b", b"c")
    assert ReplyVerifier(known).is_genuine("a", b"b", b"c", signature)
    assert act(folder, "revoke", "server") == 0
    assert load_register(folder).server_keys() == []
    assert act(folder, "add", "server", "--role", "server") == 0
    assert load_register(folder).server_keys() not in ([], known)  # differs after a theft


# --- rules -----------------------------------------------------------------------------------------------------------

NAMES = {
    "loader-1": "machine",
    "loader-2": "machine",
    "guest": "visitor",
    "boss": "admin",
    "sim": "sim",
    "b1": "corrections",
}
REGISTER = Register(
    SITE, (), {n: RegisterEntry(r, "1", NOW) for n, r in {**NAMES, "server": "server", "f1": "follower"}.items()}
)


def may(name: str, message: str, key: str, flow: str = "ingress", register: Register = REGISTER) -> bool:
    """Whether a name's rules pass a message, by Zenoh's own comparison."""
    control = access_control(register)
    assert (control["enabled"], control["default_permission"]) == (True, "deny")
    mine = {rule for policy in control["policies"] if name in policy["subjects"] for rule in policy["rules"]}
    return any(
        message in rule["messages"] and flow in rule["flows"] and zenoh.KeyExpr(expression).includes(key)
        for rule in control["rules"]
        if rule["id"] in mine
        for expression in rule["key_exprs"]
    )


@pytest.mark.parametrize(
    ("message", "key", "who"),
    [
        ("query", keys.ingest(SITE, "loader-1"), {"loader-1"}),
        ("query", keys.map_query(SITE, "info"), {"loader-1", "loader-2", "guest", "boss"}),
        ("query", keys.map_queries_all(SITE), {"loader-1", "loader-2", "guest", "boss"}),
        ("query", keys.admin(SITE, "trust"), {"boss"}),
        ("query", keys.ingest("north", "loader-1"), set()),
        ("put", keys.pose(SITE, "loader-1"), {"loader-1"}),
        ("put", keys.sensors(SITE, "loader-1"), {"loader-1", "sim"}),
        ("put", keys.changed(SITE), {"server"}),
        ("put", f"sitegrid/{SITE}/map/tile/1/2", {"server"}),
        ("delete", keys.pose(SITE, "loader-1"), set()),
        ("declare_subscriber", keys.sensors(SITE, "loader-1"), {"loader-1"}),
        ("declare_subscriber", keys.poses_all(SITE), {"guest", "boss", "server"}),
        ("declare_subscriber", keys.health_all(SITE), {"guest", "boss", "server", "sim"}),
        ("declare_subscriber", keys.changed(SITE), {"loader-1", "loader-2", "guest", "boss"}),
        ("declare_subscriber", keys.corrections(SITE, "b1"), {"loader-1", "loader-2"}),
        ("put", keys.corrections(SITE, "b1"), {"b1"}),
        ("declare_subscriber", "**", set()),
        ("declare_queryable", keys.ingest_all(SITE), {"server"}),
        ("declare_queryable", keys.map_queries_all(SITE), {"server"}),
        ("declare_queryable", keys.admin_all(SITE), {"server"}),
        ("reply", keys.map_query(SITE, "info"), {"server"}),
        ("query", keys.follower_query(SITE, "f1", "point"), {"loader-1", "loader-2", "guest", "boss"}),
        ("query", keys.follower_owner(SITE, "f1"), {"f1"}),
        ("declare_queryable", keys.follower_queries(SITE, "f1"), {"f1"}),
        ("declare_queryable", keys.follower_owner(SITE, "f1"), {"f1"}),
        ("liveliness_token", keys.follower_alive(SITE, "f1"), {"f1"}),
        ("liveliness_query", keys.followers_alive_all(SITE), {"loader-1", "loader-2", "guest", "boss"}),
        ("liveliness_token", keys.alive(SITE, "loader-1"), {"loader-1"}),
        ("declare_liveliness_subscriber", keys.alive_all(SITE), {"guest", "boss", "server"}),
        ("liveliness_query", keys.alive(SITE, "loader-1"), {"loader-1", "guest", "boss", "server"}),
    ],
)
def test_who_may_what(message: str, key: str, who: set[str]):
    assert {name for name in REGISTER.names if may(name, message, key)} == who


def test_answers_and_events_go_only_to_whom_they_are_for():
    def sent(message: str, key: str) -> set[str]:
        return {name for name in REGISTER.names if may(name, message, key, "egress")}

    assert sent("query", keys.ingest(SITE, "loader-1")) == {"server"}
    assert sent("reply", keys.ingest(SITE, "loader-1")) == {"loader-1"}
    assert sent("reply", keys.admin(SITE, "trust")) == {"boss"}
    assert sent("put", keys.sensors(SITE, "loader-1")) == {"loader-1"}
    assert sent("put", keys.pose(SITE, "loader-1")) == {"guest", "boss", "server"}
    assert sent("declare_queryable", keys.map_queries_all(SITE)) == set(REGISTER.names)


def test_every_key_that_exists_is_granted_to_somebody():
    for name, build in inspect.getmembers(keys, inspect.isfunction):
        parameters = list(inspect.signature(build).parameters)
        if build.__module__ != keys.__name__ or name.startswith("_") or parameters[:1] != ["site"]:
            continue
        values = {
            "site": SITE,
            "machine": "loader-1",
            "base": "b1",
            "query": "info",
            "command": "trust",
            "follower": "f1",
        }
        key = build(**{parameter: values[parameter] for parameter in parameters})
        messages = ("put", "query", "declare_subscriber", "liveliness_token", "liveliness_query", "declare_queryable")
        assert any(may(who, message, key) for who in REGISTER.names for message in messages), f"{name}: {key}"


def test_rules_follow_the_certificate_and_end_with_it():
    register = REGISTER.without("loader-2").with_entry("loader-1", RegisterEntry("machine", "2", NOW, issue=2))
    subjects = {s["id"]: s["cert_common_names"] for s in access_control(register)["subjects"]}
    assert subjects["loader-1"] == ["loader-1.2"]
    assert "loader-2" not in subjects
    assert not may("loader-2", "query", keys.map_query(SITE, "info"), register=register)
    with_router = REGISTER.with_entry("router", RegisterEntry("router", "3", NOW))
    assert "router" not in {s["id"] for s in access_control(with_router)["subjects"]}


def test_limits_never_touch_what_is_acknowledged():
    settings = router_settings(REGISTER)
    for item in settings["downsampling"]:
        assert item["messages"] == ["put"]
        for rule in item["rules"]:
            assert rule["key_expr"] in (keys.poses_all(SITE), keys.health_all(SITE), keys.corrections_all(SITE))
    sizes = {key: item["size_limit"] for item in settings["low_pass_filter"] for key in item["key_exprs"]}
    assert sizes[keys.ingest_all(SITE)] > MAX_BATCH_BYTES
    assert all("reply" not in item["messages"] for item in settings["low_pass_filter"])


# --- joining ---------------------------------------------------------------------------------------------------------


def test_with_keys_the_default_endpoint_has_tls(folder: Path):
    assert join(DEFAULT_ENDPOINT, folder / "server").endpoint == DEFAULT_TLS_ENDPOINT
    assert join("tls/router.site:1", folder / "server").endpoint == "tls/router.site:1"


def test_keys_that_do_not_fit_are_named(folder: Path):
    keys_of = folder / "server"
    for required, problem in (
        ({"role": "machine"}, "for role 'server', 'machine' is needed"),
        ({"name": "loader-1"}, "for name 'server', 'loader-1' is needed"),
        ({"site": "north"}, "for site 'paper', 'north' is needed"),
    ):
        with pytest.raises(ConfigError, match=problem):
            join(DEFAULT_ENDPOINT, keys_of, **required)
    with pytest.raises(ConfigError, match="proves no names"):
        join("tcp/10.0.0.5:7447", keys_of)
    with pytest.raises(ConfigError, match="needs keys"):
        join("tls/10.0.0.5:7447")
    with pytest.raises(ConfigError, match=r"holds no identity.toml; name the folder of one certificate"):
        join(DEFAULT_ENDPOINT, folder)
    (keys_of / "key.pem").unlink()
    with pytest.raises(ConfigError, match=r"holds no key.pem"):
        join(DEFAULT_ENDPOINT, keys_of)


def test_an_expired_certificate_is_named_before_the_router_refuses_it(folder: Path):
    credentials = load_credentials(folder / "server")
    check_valid(credentials, credentials.identity.expires)
    with pytest.raises(ConfigError, match=r"expired on .*; make a new one with `sitegrid keys add server --renew`"):
        check_valid(credentials, credentials.identity.expires + timedelta(seconds=1))
    identity = folder / "server" / "identity.toml"
    change(identity, str(credentials.identity.expires.year), "2020")
    with pytest.raises(ConfigError, match="expired on 2020"):
        join(DEFAULT_ENDPOINT, folder / "server")
    change(identity, "+00:00", "")
    with pytest.raises(ConfigError, match="no time zone"):
        load_credentials(folder / "server")


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (("server", "--site-file", "config/site.toml", "--store", "x"), "for role 'machine', 'server' is needed"),
        (("sim", "--site", SITE), "for role 'machine', 'sim' is needed"),
        (("agent", *AGENT_FILES, "--name", "b", "--spool", "x"), "for name 'a', 'b' is needed"),
        (("trust", "a", "--site", "north"), "for site 'paper', 'north' is needed"),
    ],
)
def test_every_command_looks_at_its_keys(
    folder: Path, root: Path, words: tuple[str, ...], problem: str, monkeypatch, capsys
):
    assert act(folder, "add", "a") == 0
    monkeypatch.chdir(root)
    assert main([words[0], "--keys", str(folder / "a"), *words[1:]]) == 1
    assert problem in capsys.readouterr().err
    assert not (root / "x").exists()


THIS_HOST = ("tcp/127.0.0.1:7447", "tcp/127.9.9.9:0", "tcp/localhost:7447", "tcp/[::1]:7447")
OTHERS = ("tcp/0.0.0.0:7447", "tcp/[::]:7447", "tcp/10.0.0.5:7447", "tcp/router:7447", "tcp/localhost.evil.org:7447")
DOUBTFUL = ("udp/127.0.0.1:7447", "tcp/127.0.0.1:7447#bind=0.0.0.0:7447", "tcp/")


@pytest.mark.parametrize("endpoint", [*THIS_HOST, *OTHERS, *DOUBTFUL])
def test_what_counts_as_this_host(endpoint: str):
    assert is_loopback(endpoint) == (endpoint in THIS_HOST)


def test_the_router_needs_keys_or_this_host(folder: Path, capsys):
    assert main(["router", "--listen", "tcp/0.0.0.0:0"]) == 1
    assert "or say --insecure" in capsys.readouterr().err
    assert main(["router", "--keys", str(folder), "--listen", "tcp/0.0.0.0:0"]) == 1
    assert "proves no names" in capsys.readouterr().err
    assert main(["router", "--keys", str(folder / "router")]) == 1
    assert "holds no register.toml" in capsys.readouterr().err
