"""compose.yaml's profile `ha` as local processes: writer killed, then the database's primary."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import psycopg
import pytest

from protocol.site.site_file import load_site
from protocol.wire.session import SessionConfig, open_session
from sitegrid import connect
from sitegrid.process.children import Child, Children
from tests.integration import compose_run
from tests.integration.compose_database import DatabaseServer
from tests.patience import PATIENCE_S, until
from tests.postgres_server import cluster_folder
from tests.takeover.senders import Sender
from tests.takeover.site import verdict

pytestmark = [pytest.mark.processes, pytest.mark.nightly]
SERVERS = ("server-a", "server-b")
REPLACED = 3  # exit code after another server took over
ROWS = "SELECT row, record FROM sitegrid.journal ORDER BY row"


class HighlyAvailable:
    """Services of `docker compose --profile ha up follower` and two sending machines."""

    def __init__(self, run: compose_run.ComposeRun, root: Path, children: Children) -> None:
        self.run, self.children, self.folder = run, children, run.folder
        self.site = load_site(root / "config" / "site.toml")
        self.senders: list[Sender] = []
        self.said: dict[int, set[str]] = {}

    def send(self) -> None:
        self.endpoint = f"tcp/127.0.0.1:{self.run.ports['7447']}"
        session = self.children.enter_context(open_session(SessionConfig(self.endpoint)))
        for machine in ("loader-8", "loader-9"):
            sender = Sender(session, self.site, machine, self.folder / f"{machine}.audit", 0.02)
            self.children.callback(sender.end)
            self.senders.append(sender)
            sender.start()

    def server(self, name: str) -> Child:
        child = self.run.started[name]
        assert isinstance(child, Child)
        return child

    def which(self, state: str) -> list[str]:
        """Servers that reported this state."""
        for name in SERVERS:
            said = self.said.setdefault(self.server(name).pid, set())
            said.update(key for line in self.server(name).lines() for key in line)
        return [name for name in SERVERS if state in self.said[self.server(name).pid]]

    def wait_for_acknowledgements(self, beyond: int = 0, count: int = 20) -> float:
        """Wait for each machine's next acknowledgements with an epoch above `beyond`; returns the first's time."""
        before = {one.machine: len(one.acknowledged) for one in self.senders}

        def new(one: Sender) -> list[float]:
            return [ack.at_s for ack in one.acknowledged[before[one.machine] :] if ack.epoch > beyond]

        until(lambda: all(len(new(one)) >= count for one in self.senders), f"batches beyond epoch {beyond}")
        return min(new(one)[0] for one in self.senders)

    def epoch(self) -> int:
        return max(ack.epoch for one in self.senders for ack in one.acknowledged)

    def database(self, port: str) -> psycopg.Connection:
        """As its own user, from this host."""
        url = f"host=127.0.0.1 port={self.run.ports[port]} user=map dbname=sitemap"
        return psycopg.connect(url, autocommit=True)


def test_profile_ha_survives_its_writer_and_its_primary_and_its_follower_answers(
    tmp_path: Path, children: Children, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(root)
    for name, value in compose_run.image_environment(root / "Dockerfile").items():
        monkeypatch.setenv(name, value.replace("/tmp/", f"{tmp_path}/tmp/"))
    services = compose_run.needed(compose_run.load(root / "compose.yaml"), "follower")
    assert list(services) == ["router", "db-a", "db-b", *SERVERS, "follower"]
    databases = children.enter_context(cluster_folder())
    run = compose_run.ComposeRun(services, tmp_path, children, databases)
    site = HighlyAvailable(run, root, children)
    run.up()
    pids = {name: child.pid for name, child in run.started.items()}
    assert len(set(pids.values())) == len(services), f"a process each: {pids}"

    # Two servers start at once on a new database: one serves, one waits.
    until(lambda: len(site.which("ready")) == 1 and len(site.which("standby")) >= 1, "one serves, one waits")
    follower = run.started["follower"]
    assert isinstance(follower, Child)
    assert follower.expect("ready", PATIENCE_S)["name"] == "follower"
    assert all(run.check(name) for name, service in services.items() if "healthcheck" in service)
    site.send()
    site.wait_for_acknowledgements()
    with connect(site.endpoint, site.site.name) as client:
        info = client.info()
        assert (info.replica, info.epoch) == ("synchronous", site.epoch())

        (writer,) = site.which("ready")
        (other,) = {*SERVERS} - {writer}
        epoch, began_s = site.epoch(), time.time()
        site.server(writer).send(signal.SIGKILL)
        took_s = site.wait_for_acknowledgements(beyond=epoch) - began_s
        until(lambda: other in site.which("ready"), "the other one serves")
        assert site.server(writer).wait(PATIENCE_S) == -signal.SIGKILL
        run.start_again(writer)
        until(lambda: writer in site.which("standby"), "the one that was killed waits now")

        epoch, began_s = site.epoch(), time.time()
        primary, replica = run.started["db-a"], run.started["db-b"]
        assert isinstance(primary, DatabaseServer)
        assert isinstance(replica, DatabaseServer)
        primary.send(signal.SIGKILL)
        primary.wait(PATIENCE_S)
        assert services["db-a"]["restart"] == "no", "it has to stay away"
        replica.do("pg_ctl", "promote", "-w", "-D", replica.data)
        with site.database("5433") as db:
            db.execute("ALTER SYSTEM RESET synchronous_standby_names")
            db.execute("SELECT pg_reload_conf()")
        promoted_s = site.wait_for_acknowledgements(beyond=epoch) - began_s

        for sender in site.senders:
            sender.end()
        row = max(ack.row for one in site.senders for ack in one.acknowledged)
        assert client.info(after=row).epoch == site.epoch()
        until(lambda: client.info().replica == "none", "the server sees that its database is alone")

        def follower_has_all() -> bool:
            client.point(1.0, 1.0)
            return (client.origin.follower, client.origin.behind_rows) == ("follower", 0)

        until(follower_has_all, "the follower answers, and lacks nothing")
    with site.database("5433") as db:
        result = verdict(tmp_path, [one.machine for one in site.senders], db.execute(ROWS).fetchall())
    print(f"writer killed: {took_s:.2f} s; primary killed: {promoted_s:.2f} s; {result}; {pids}")
    assert result.is_clean, result
    assert result.acknowledged > 80
    codes = run.down()
    assert codes.pop("db-a") == -signal.SIGKILL
    replaced = [name for name in SERVERS if codes[name] == REPLACED]
    assert len(replaced) <= 1, "the other one took over from it when the primary was gone; compose would start it again"
    assert {code for name, code in codes.items() if name not in replaced} == {0}, codes
