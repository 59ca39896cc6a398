"""Edge cases of routes by client, command and HTTP in real processes: named machines, restart, refusals."""

from __future__ import annotations

import signal
from collections.abc import Callable
from dataclasses import replace

import pytest

from protocol.errors import QueryError
from protocol.queries.route_requests import WayQuery
from protocol.queries.routing import MACHINES, NamedMachine
from sitegrid import Client, RouteAnswer
from tests.command_lines import Said, said
from tests.integration.web_site import NAME, WebSite
from tests.patience import PATIENCE_S

pytestmark = pytest.mark.processes
Place = tuple[float, float]
ROAD: tuple[Place, Place] = ((20.0, 10.0), (150.0, 10.0))
LINE: tuple[Place, ...] = ((40.0, 10.0), (10.0, 40.0), (40.0, 130.0))
ACROSS = [(90.0, float(y)) for y in range(21)]  # a road and its edges
BLOCKED = {"margin": "1", "avoid": ",".join(f"{x:g},{y:g}" for x, y in ACROSS), "unknown": "refuse"}


@pytest.fixture
def site(hauling: WebSite) -> WebSite:
    return hauling


def command(site: WebSite, *words: str) -> Said:
    return said("query", "--endpoint", site.endpoint, "--site", NAME, *words)


def numbers(line: tuple[Place, ...]) -> list[str]:
    return [f"{value:g}" for place in line for value in place]


def asked(site: WebSite, kind: str, places: tuple[Place, ...], values: dict[str, str]) -> dict[str, str]:
    """Command and HTTP refusals of a drive that all three refuse; the command's last line."""
    settings = [word for name, value in values.items() for word in (f"--{name.replace('_', '-')}", *value.split(","))]
    refused = command(site, kind, *numbers(places), *settings)
    assert refused.code in (1, 2), refused.out
    text = ";".join(",".join(numbers((place,))) for place in places)
    ends = dict(zip(("from", "to"), text.split(";"), strict=False))
    answer = site.get(kind, {**({"line": text} if kind == "route" else ends), **values})
    assert answer.status in (400, 413, 414), answer.body
    return {"command": refused.err.strip().splitlines()[-1], "http": answer.json["detail"]}


@pytest.mark.parametrize(
    ("kind", "places", "values", "ask", "words"),
    [
        ("route", ((20.0, 10.0),), {}, lambda c: c.route([(20.0, 10.0)]), "a line has at least two"),
        ("route", (ROAD[0], (9e4, 1.0)), {}, lambda c: c.route([ROAD[0], (9e4, 1.0)]), "is off the site"),
        ("route", ROAD, {"mass": "0"}, lambda c: c.route(ROAD, named(mass_kg=0.0)), "mass"),
        ("route", ROAD, {"efficiency": "0"}, lambda c: c.route(ROAD, named(efficiency=0.0)), "efficiency"),
        ("route", ROAD, {"machine": "digger-7"}, lambda c: c.route(ROAD, "digger-7"), "'digger-7' has sent nothing"),
        ("way", ROAD, BLOCKED, lambda c: blocked(c), "no way: `margin` leaves none"),
        ("way", ROAD, {"max_grade": "0"}, lambda c: c.ask(WayQuery(*ROAD, max_grade=0.0)), "max_grade"),
        (
            "way",
            ((60.0, 40.0), ROAD[1]),
            {"unknown": "refuse"},
            lambda c: c.ask(WayQuery((60.0, 40.0), ROAD[1], unknown="refuse")),
            "parameter `from`: unknown ground",
        ),
    ],
)
def test_bad_input_is_named_alike_at_every_edge(
    site: WebSite,
    kind: str,
    places: tuple[Place, ...],
    values: dict[str, str],
    ask: Callable[[Client], RouteAnswer],
    words: str,
):
    with pytest.raises((QueryError, ValueError), match=words) as refused:
        ask(site.client)
    assert "\n" not in str(refused.value)
    for edge, problem in asked(site, kind, places, values).items():
        assert words in problem, edge


def named(**values: float) -> NamedMachine:
    return NamedMachine("hauler-1", tuple(values.items()))


def blocked(client: Client) -> RouteAnswer:
    return client.ask(WayQuery(*ROAD, margin_m=1.0, avoid=ACROSS, unknown="refuse"))


def test_a_way_is_never_dearer_to_drive_than_straight_on(site: WebSite):
    """Between roads and over unknown ground too, whatever the detour's curves."""
    for ends in (((40.0, 10.0), (40.0, 130.0)), ((150.0, 10.0), (150.0, 70.0)), ((20.0, 70.0), (90.0, 10.0))):
        for cost, total in (("energy", "energy_j"), ("time", "time_s")):
            way = site.client.ask(WayQuery(*ends, cost, machine=MACHINES["truck"]))
            straight = site.client.route(ends, "truck")
            assert getattr(way.totals, total) <= getattr(straight.totals, total)
            again = site.client.route(way.line_m.tolist(), "truck")
            assert again.totals == way.totals
            assert not straight.totals.unknown or straight.totals.unknown_resistance > 0.02


def test_a_route_of_a_named_machine_is_the_first_thing_that_a_server_is_asked_after_a_restart(site: WebSite):
    before = site.client.route(LINE, "hauler-1")
    assert before.machine != MACHINES["loader"], "its samples say what it weighs"
    again = site.client.route(LINE, replace(before.machine))
    assert again.totals == before.totals
    assert site.get("route", {"line": "20,10;150,10", "machine": "hauler-1"}).json["machine"]["mass_kg"] == (
        before.machine.mass_kg
    )
    old = site.server.pid
    site.server.send(signal.SIGKILL)
    site.server.wait(PATIENCE_S)
    site.server = site.start_server()
    assert site.server.pid != old
    after = site.client.route(LINE, "hauler-1")
    assert (after.totals, after.machine, after.merged) == (before.totals, before.machine, before.merged)
