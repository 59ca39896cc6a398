"""Faults of strangers: crowds at the web server; machines that scatter, wander or lie."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from datetime import UTC, datetime, timedelta
from functools import partial
from http.client import HTTPException, HTTPSConnection

import numpy as np

from protocol.site.site_file import load_site
from protocol.wire import keys
from protocol.wire.codec import encode_pose
from protocol.wire.messages import Pose
from protocol.wire.session import SessionConfig, free_endpoint, open_session
from sitegrid.security.key_folder import issue, make_authority
from tests.chaos.chaos_site import RESUME_S, ROUTER, SERVER, WEB, ChaosSite
from tests.chaos.guests import Guest, made_up
from tests.chaos.leashed import Process
from tests.chaos.outcome import FaultOutcome
from tests.chaos.reader_faults import MOST_MEMORY, SETTLE_S, Asker
from tests.chaos.recordings import START_NS
from tests.chaos.scenario import FaultRun
from tests.chaos.visitor import KINDS, PATIENCE_S, trusting

ROUND_S = 8.0  # least time between kills of the server
ANSWERS = 5  # per normal visitor's query and round
WEB_MB = 600.0  # cost of all visitors: of 470, large answers take 320 and sockets 150
BATCHES = 400  # per scattering or wandering machine, in the whole suite
GUEST_MB = 60.0  # cost of one of them to the map server
FAR_M, FAR_DEG = 9000.0, 0.05  # from the origin, and in longitude: nobody is there


def visitors(scenario: FaultRun) -> FaultOutcome:
    """Hundreds of sockets of each kind and large queries, with kills of the map server."""
    rounds = max(2, round(scenario.seconds / ROUND_S))
    with scenario.site() as site:
        site.start_all()
        _start_web(site)
        pages = [partial(_get, site, path) for path in ("/healthz", f"/api/v1/sites/{site.name}/point?x=0&y=0")]
        with ExitStack() as opened:
            door, page = (opened.enter_context(closing(Asker(ask))) for ask in pages)
            site.linger(SETTLE_S)
            idle_mb = {role: site.forget_peak_mb(role) for role in (SERVER, WEB)}
            door.forget()
            opened.enter_context(_crowd(site))
            for number in range(rounds):
                scenario.say(f"{', '.join(KINDS)} visitors, round {number + 1} of {rounds}")
                _round(site, (door, page))
                site.outcome.memory_ratio = round(site.peak_mb(SERVER) / idle_mb[SERVER], 2)
                if site.outcome.memory_ratio > MOST_MEMORY:
                    site.problem(f"the map server took {site.outcome.memory_ratio} times its memory")
                site.kill(SERVER)
                site.wait_ready(SERVER)
            grown_mb = site.peak_mb(WEB) - idle_mb[WEB]
            site.outcome.answer_s_max = round(door.longest_s(), 2)
        site.outcome.notes["web server grew [MB]"] = round(grown_mb)
        if grown_mb > WEB_MB:
            site.problem(f"the web server took {grown_mb:.0f} MB more")
        site.stop(WEB)
        return site.finish(scenario.fault, rounds * len(KINDS))


def _round(site: ChaosSite, askers: tuple[Asker, ...]) -> None:
    """Let all machines get acknowledgements and all queries answers."""
    before, answered = site.progress(), [asker.answers + ANSWERS for asker in askers]

    def are_served() -> bool:
        site.tend()
        now = site.progress()
        return all(now.get(name, 0) > before.get(name, 0) for name in site.machines) and all(
            asker.answers >= least for asker, least in zip(askers, answered, strict=True)
        )

    site.linger(ROUND_S)
    site.wait(are_served, RESUME_S, "machines or visitors that behave are not served")


@contextmanager
def _crowd(site: ChaosSite) -> Iterator[None]:
    """Visitors of all kinds, a process each."""
    port = site.options[WEB][1]
    with ExitStack() as ended:
        for network, kind in enumerate(KINDS, 1):
            command = (sys.executable, "-m", "tests.chaos.visitor", kind, str(network), port, site.name)
            running = Process(site.folder / "log" / f"visitor-{kind}", command, {})
            ended.callback(running.end)
        yield


def scatter(scenario: FaultRun) -> FaultOutcome:
    """Machines that scatter samples far away, wander, or state poses of others."""
    rng, batches = np.random.default_rng(scenario.seed), max(40, round(BATCHES * scenario.scale))
    with scenario.site() as site:
        site.start_all()
        _start_web(site)
        site.linger(SETTLE_S)
        idle_mb = site.forget_peak_mb(SERVER)
        refused, shown = 0, set[str]()
        with ExitStack() as opened, closing(open_session(SessionConfig(site.endpoints[ROUTER]))) as session:
            guests = [opened.enter_context(closing(Guest(site, name))) for name in ("scatters", "again", "wanders")]
            place_m = np.full(2, FAR_M)
            for number in range(batches):
                n = int(2 ** rng.uniform(0, 11))
                for guest in guests[:2]:
                    far = rng.uniform(-FAR_M, FAR_M, (2, n))
                    refused += bool(guest.send(made_up(*far, number * 10.0, 1e-3, 2.9, 100.0)))
                track = place_m[:, None] + np.cumsum(rng.normal(0, 2.0, (2, n)), axis=1)
                refused += bool(guests[2].send(made_up(*track, number * 1e6, 300.0, 2.0, 0.0)))
                place_m = track[:, -1]
                for x_m in (FAR_M, 1e308):  # under its own key
                    lie = Pose(site.machines[0], START_NS + number, x_m, *[0.0] * 6)
                    session.put(keys.pose(site.name, "liar"), encode_pose(lie))
                shown |= {name for name, far in _poses(site) if far}
                site.tend()
        grown_mb = site.peak_mb(SERVER) - idle_mb
        site.outcome.notes |= {"refused batches": refused, "map server grew [MB]": round(grown_mb)}
        if grown_mb > GUEST_MB * len(guests):
            site.problem(f"{len(guests)} machines took {grown_mb:.0f} MB of the map server")
        if not refused or b'reason="wrong_machine"' not in _get(site, "/metrics"):
            site.problem("no samples, or no poses, were refused: nothing was tried")
        if shown:
            site.problem(f"the page shows {', '.join(shown)} where nobody is")
        site.stop(WEB)
        return site.finish(scenario.fault, batches * len(guests))


def _start_web(site: ChaosSite) -> None:
    """Start the web server with TLS."""
    now, folder = datetime.now(UTC), site.folder / "tls"
    pair = issue(make_authority(site.name, now, now + timedelta(1)), WEB, now, now + timedelta(1), ("127.0.0.1",))
    folder.mkdir()
    (folder / "cert.pem").write_bytes(pair.certificate)
    (folder / "key.pem").write_bytes(pair.key)
    site.options[WEB] = ("--listen", free_endpoint().rpartition(":")[2], "--tls", str(folder))
    site.start(WEB)
    site.wait_ready(WEB)


def _get(site: ChaosSite, path: str) -> bytes:
    """A normal visitor's answer; HTTPException unless 200."""
    with closing(
        HTTPSConnection("127.0.0.1", int(site.options[WEB][1]), timeout=20 * PATIENCE_S, context=trusting())
    ) as connection:
        connection.request("GET", path)
        response = connection.getresponse()
        if response.status != 200:
            raise HTTPException(f"{path}: {response.status}")
        return response.read()


def _poses(site: ChaosSite) -> Iterator[tuple[str, bool]]:
    """Machines on the page, and whether far from all drives."""
    origin_deg = load_site(site.folder / "site.toml").origin_lon_deg
    for place in json.loads(_get(site, f"/api/v1/sites/{site.name}/features/machines"))["features"]:
        yield place["properties"]["machine"], abs(place["geometry"]["coordinates"][0] - origin_deg) > FAR_DEG
