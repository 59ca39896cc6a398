"""The live page's worklist and routes in a browser on a running site. Needs Chromium (Debian: `chromium`)."""

from __future__ import annotations

import contextlib
import itertools
import json
from collections.abc import Iterator
from typing import Any

import pytest

from protocol.queries.roads import WorklistQuery, WorklistRow
from protocol.queries.route_requests import RouteQuery, WayQuery
from protocol.queries.routing import MACHINES
from tests.integration.browser_tab import PHONE, Tab, needs_browser, watched
from tests.integration.hauling_site import DAY_NS, FIRST_NS
from tests.integration.web_site import WebSite

pytestmark = needs_browser
QUIET = "document.querySelector('#panel .asking') === null"


@pytest.fixture
def web(hauling: WebSite) -> WebSite:
    return hauling


@pytest.fixture
def tab(browser, web: WebSite) -> Iterator[Tab]:
    yield from watched(browser, web.url)


def opened(tab: Tab, key: str = "w") -> Any:
    """A key's panel after its answer."""
    tab.page.keyboard.press(key)
    tab.until(f"sitegrid.panel.name !== null && {QUIET}")
    return tab.page.locator("#panel")


def figure(value: float) -> str:
    return f"{value:.2f}" if value < 9.95 else f"{value:.1f}" if value < 99.5 else f"{value:.0f}"


def listed(web: WebSite) -> tuple[WorklistRow, ...]:
    return web.client.ask(WorklistQuery(limit=10)).rows


def row_of(tab: Tab, row: WorklistRow) -> Any:
    return tab.page.locator(f'[id="stretch-{row.segment.id}"]')


# --- where to send the grader


def test_the_ten_stretches_that_cost_most_stand_in_their_order_with_reasons(tab: Tab, web: WebSite):
    panel, rows = opened(tab), listed(web)
    assert panel.locator("h2").inner_text() == "Where to send the grader"
    shown = panel.locator("ol .stretch")
    assert shown.count() == len(rows) == 10
    for i, row in enumerate(rows):
        text = shown.nth(i).inner_text()
        value, low, high = row.kwh_ph
        guess = "~" if row.segment.guessed else ""
        assert f"{guess}{figure(value)}" in text
        assert f"{figure(low)} to {figure(high)}" in text
        assert f"{100 * row.segment.resistance:.1f} %" in text
        assert f"{sum(row.segment.passes_ph):.1f} passes/h" in text
    total = panel.locator(".totals").inner_text()
    assert figure(sum(row.kwh_ph[0] for row in rows)) in total
    days = panel.locator("ol .stretch canvas").first.get_attribute("aria-label")
    assert days == "From 4.0 % on 9 Oct to 5.5 % on 12 Oct"
    assert "+0.5 %/day" in shown.first.inner_text()
    assert "since the first drive" in shown.first.inner_text()
    repaired = panel.locator(".stretch.short").first.inner_text()
    assert "Repaired" in repaired
    assert "5.0 % → 3.0 %" in repaired


def answer_of(web: WebSite) -> dict[str, Any]:
    return web.get("worklist", {"limit": 10}).json


def answers(tab: Tab, resource: str, body: Any, status: int = 200) -> None:
    """Answer in place of the server."""
    tab.page.route(f"**/{resource}?**", lambda route: route.fulfill(status=status, json=body))


def test_a_click_on_a_row_flies_to_its_stretch_beside_the_panel(tab: Tab, web: WebSite):
    opened(tab)
    row = listed(web)[9]
    scale = tab.js("sitegrid.view.scale")
    row_of(tab, row).click()
    tab.until("sitegrid.view.flight === null && sitegrid.view.moved")
    assert tab.js("sitegrid.view.scale") > scale
    for point in row.segment.line:
        left, top = tab.pixel_of(*point)
        assert 250 < left < 1280 - 380
        assert 60 < top < 720


def test_labels_and_numbers_keep_off_each_other_on_phones(browser, web: WebSite):
    places = [row.segment.line[len(row.segment.line) // 2] for row in listed(web)[::3]]
    for width, height in ((390, 844), (320, 640)):
        size = {**PHONE, "viewport": {"width": width, "height": height}}
        tab = Tab(browser, f"{web.url}?panel=work", **size).loaded()
        tab.until(f"sitegrid.work.rows.length === 10 && {QUIET}")
        for i, (x_m, y_m) in enumerate(places):
            pose = {"machine": f"loader-{i}", "x_m": x_m, "y_m": y_m, "heading_rad": 0, "age_s": 0}
            machine = json.dumps({**pose, "cov_xx_m2": 1, "cov_xy_m2": 0, "cov_yy_m2": 1, "track": []})
            tab.js(f"sitegrid.site.machines.set('loader-{i}', {{...{machine}, seen_s: performance.now() / 1000}})")
        tab.js("sitegrid.site.tell('poses')")
        tab.drawn()
        plates = tab.js("sitegrid.plates")
        arrows, others = plates[: len(places)], plates[len(places) :]
        assert others, "numbers and labels"
        for one, other in [*itertools.combinations(others, 2), *itertools.product(arrows, others)]:
            across, down = abs(one["x"] - other["x"]), abs(one["y"] - other["y"])
            assert down >= 20 or across >= (one["width"] + other["width"]) / 2, (width, one, other)
        tab.close()


@pytest.mark.nightly
def test_the_target_is_chosen_and_a_link_keeps_it(tab: Tab, browser, web: WebSite):
    panel = opened(tab)
    tab.page.locator("#target").fill("5")
    tab.page.keyboard.press("Enter")
    rows = web.client.ask(WorklistQuery(0.05, limit=10)).rows
    tab.until(f"sitegrid.work.rows.length === {len(rows)}")
    tab.until("location.search.includes('panel=work') && location.search.includes('target=0.05')")
    shown = panel.inner_text()
    other = Tab(browser, tab.page.url).loaded()
    other.until(f"sitegrid.panel.name === 'work' && {QUIET}")
    assert other.page.locator("#panel").inner_text() == shown
    assert other.js("sitegrid.view.x.toFixed(1)") == tab.js("sitegrid.view.x.toFixed(1)")
    other.close()
    tab.page.locator("#target").fill("29")
    tab.page.keyboard.press("Enter")
    tab.until("document.querySelector('#panel .empty') !== null")
    assert "beyond doubt" in panel.inner_text()
    tab.page.locator("#target").fill("-3")
    tab.page.keyboard.press("Enter")
    assert tab.js("sitegrid.work.target") == 0.29, "what is no target is not asked"


@pytest.mark.nightly
def test_the_list_is_of_the_time_that_is_shown(tab: Tab, web: WebSite):
    panel = opened(tab)
    assert panel.locator(".stretch.short").count() > 0
    at_ns = FIRST_NS + DAY_NS
    tab.js(f"sitegrid.times.go({at_ns})")
    rows = web.client.ask(WorklistQuery(limit=10, as_of_ns=at_ns)).rows
    tab.until(f"sitegrid.times.map !== null && sitegrid.panel.at === {at_ns} && {QUIET}")
    assert panel.locator("ol .stretch").count() == len(rows)
    assert figure(rows[0].kwh_ph[0]) in panel.locator("ol .stretch").first.inner_text()
    assert panel.locator(".stretch.short").count() == 0, "the repair came later"


# --- what a drive costs


def set_places(tab: Tab, *places: tuple[float, float]) -> None:
    for place in places:
        before = tab.js("sitegrid.route.places.length")
        tab.page.mouse.click(*tab.pixel_of(*place))
        tab.until(f"sitegrid.route.places.length !== {before}")
    tab.until(f"{QUIET} && (sitegrid.route.answer !== null || document.querySelector('#panel .failed') !== null)")


def places(tab: Tab) -> list[tuple[float, float]]:
    return [(x, y) for x, y in tab.js("sitegrid.route.places")]


def test_a_line_on_the_map_says_what_its_drive_costs(tab: Tab, web: WebSite):
    panel = opened(tab, "r")
    assert "Click two places or more" in panel.inner_text()
    set_places(tab, (20, 10), (90, 10), (150, 10))
    step_m = tab.js("sitegrid.route.answer.steps.length_m[0]")
    drive = web.client.ask(RouteQuery(tuple(places(tab)), machine=MACHINES["truck"], step_m=step_m))
    totals = panel.locator(".totals").inner_text()
    assert figure(drive.totals.energy_j / 3.6e6) in totals
    assert f"{figure(drive.totals.energy_low_j / 3.6e6)} to {figure(drive.totals.energy_high_j / 3.6e6)}" in totals
    minutes, seconds = divmod(round(drive.totals.time_s), 60)
    assert f"{minutes}:{seconds:02}" in totals
    assert f"{round(drive.totals.length_m)} m" in totals
    tab.page.locator("#machine").select_option("loader")
    tab.until(f"sitegrid.route.machine === 'loader' && {QUIET} && sitegrid.route.answer !== null")
    light = web.client.route(places(tab), MACHINES["loader"])
    assert figure(light.totals.energy_j / 3.6e6) in panel.locator(".totals").inner_text()
    tab.page.locator("#mass").fill("60")
    tab.page.keyboard.press("Enter")
    tab.until(f"sitegrid.route.mass_t === 60 && {QUIET} && sitegrid.route.answer !== null")
    assert tab.js("sitegrid.route.answer.totals.energy_j") > 2 * light.totals.energy_j
    tab.page.locator("#undo").click()
    tab.until(f"sitegrid.route.places.length === 2 && {QUIET}")
    tab.page.locator("#clear").click()
    tab.until(f"sitegrid.route.places.length === 0 && {QUIET}")
    assert "Click two places or more" in panel.inner_text()


@pytest.mark.nightly
def test_the_profile_tells_each_place_by_pointer_and_keys(tab: Tab):
    opened(tab, "r")
    set_places(tab, (20, 10), (20, 40), (60, 70))
    profile, said = tab.page.locator("#profile"), tab.page.locator(".said")
    box = profile.bounding_box()
    tab.page.mouse.move(box["x"] + 37, box["y"] + 40)
    tab.until("sitegrid.route.at !== null")
    assert "± " in said.inner_text()
    assert "km/h" in said.inner_text()
    profile.focus()
    tab.page.keyboard.press("Home")
    assert tab.js("sitegrid.route.at") == tab.js(
        "[sitegrid.route.answer.steps.x_m[0], sitegrid.route.answer.steps.y_m[0]]"
    )
    unknown = tab.js("sitegrid.route.answer.steps.unknown.findIndex((share) => share >= 0.5)")
    for _ in range(unknown):
        tab.page.keyboard.press("ArrowRight")
    assert "nobody drove here" in said.inner_text()
    assert profile.get_attribute("aria-valuetext") == said.inner_text()
    assert "unknown" in tab.page.locator(".unsure").inner_text()
    tab.page.mouse.move(640, 300)
    tab.page.locator("#mass").focus()
    tab.until("sitegrid.route.at === null")


def test_the_cheapest_line_between_two_clicks_is_beside_the_straight_one(tab: Tab, web: WebSite):
    panel = opened(tab, "r")
    tab.page.locator("#drive-cheapest").click()
    tab.until(f"sitegrid.route.cheapest && {QUIET}")
    set_places(tab, (25, 10), (25, 130))
    ends = places(tab)
    cheapest, straight = (
        web.client.ask(WayQuery(*ends, machine=MACHINES["truck"])),
        web.client.route(ends, MACHINES["truck"]),
    )
    assert tab.js("sitegrid.route.answer.line") == cheapest.line_m.tolist()
    assert cheapest.totals.energy_j <= straight.totals.energy_j
    text = panel.inner_text()
    assert figure(cheapest.totals.energy_j / 3.6e6) in text
    more = round(100 * (straight.totals.energy_j / cheapest.totals.energy_j - 1))
    assert (f", {more} % more, with" if more else "The straight line costs the same, with") in text
    tab.page.locator("#cost-time").click()
    tab.until(f"sitegrid.route.cost === 'time' && {QUIET} && sitegrid.route.answer !== null")
    quickest = web.client.ask(WayQuery(*ends, "time", machine=MACHINES["truck"]))
    assert tab.js("sitegrid.route.answer.totals.time_s") == pytest.approx(quickest.totals.time_s, rel=1e-6)
    tab.page.mouse.click(*tab.pixel_of(60, 10))  # a third click starts anew
    tab.until(f"sitegrid.route.places.length === 1 && sitegrid.route.answer === null && {QUIET}")
    set_places(tab, (130, 10))
    assert "The straight line costs the same." in panel.inner_text()


@pytest.mark.parametrize("cheapest", [False, True])
@pytest.mark.nightly
def test_a_link_opens_the_same_drive(tab: Tab, browser, cheapest: bool):
    panel = opened(tab, "r")
    if cheapest:
        tab.page.locator("#drive-cheapest").click()
        tab.page.locator("#cost-time").click()
        tab.until(f"sitegrid.route.cost === 'time' && {QUIET}")
    tab.page.locator("#machine").select_option("empty_truck")
    set_places(tab, (20, 10), (120, 10))
    tab.until("new URLSearchParams(location.search).get('line')?.includes(';')")  # the address follows at rest
    other = Tab(browser, tab.page.url).loaded()
    other.until(f"sitegrid.panel.name === 'route' && {QUIET} && sitegrid.route.answer !== null")
    assert other.page.locator("#panel .totals").inner_text() == panel.locator(".totals").inner_text()
    for name in ("cheapest", "machine", "places"):
        assert other.js(f"sitegrid.route.{name}") == tab.js(f"sitegrid.route.{name}")
    other.close()


# --- what goes wrong


def test_names_from_elsewhere_are_text_and_never_markup(tab: Tab, web: WebSite):
    evil = '"><img src=x onerror="window.hacked = 1"><script>window.hacked = 1</script>'
    answer = answer_of(web)
    for row in answer["rows"]:
        row["segment"]["id"] += evil
    for change in answer["changes"]:
        change["id"] += evil
    answers(tab, "worklist", answer)
    panel = opened(tab)
    assert panel.locator("ol .stretch").count() == 10
    panel.locator("ol .stretch").first.click()
    tab.page.keyboard.press("Escape")
    answers(tab, "route", {"detail": evil, "status": 400}, status=400)
    opened(tab, "r")
    set_places(tab, (20, 10), (90, 10))
    assert evil in panel.locator(".failed").inner_text()
    assert tab.js("window.hacked") is None
    assert tab.js("document.querySelectorAll('#panel img, #panel script').length") == 0
    tab.complaints[:] = [text for text in tab.complaints if "400" not in text]  # the browser's own message


@pytest.mark.parametrize(
    "words",
    [
        "panel=route&line=1e999,NaN;2,3",
        "panel=route&line=" + ";".join(["1,1", "2,2"] * 5000),
        "panel=route&line=%3Cimg%20src=x%3E&machine=%3Cb%3E&mass=-1&cost=money",
        "panel=work&target=NaN",
        "panel=elsewhere&cell=a,b",
    ],
)
@pytest.mark.nightly
def test_a_link_that_makes_no_sense_breaks_nothing(browser, web: WebSite, words: str):
    tab = Tab(browser, f"{web.url}?{words}")
    if len(words) > 32_000:
        assert tab.js("document.body.textContent").count("too_large") == 1
        return tab.close()
    tab.loaded()
    tab.until(QUIET)
    assert tab.js("sitegrid.route.places") == []
    assert tab.js("[sitegrid.route.machine, sitegrid.work.target]") == ["truck", 0.02]
    assert tab.complaints == []
    return tab.close()


@pytest.mark.nightly
def test_a_slow_answer_holds_nothing_up_and_a_late_one_is_dropped(tab: Tab):
    opened(tab, "r")
    held: list[Any] = []

    def hold_the_first(route: Any) -> None:
        if held:
            route.continue_()
        else:
            held.append(route)

    tab.page.route("**/route?**", hold_the_first)
    for place in ((20, 10), (90, 10)):
        tab.page.mouse.click(*tab.pixel_of(*place))
    tab.until("sitegrid.route.places.length === 2")
    tab.until("document.querySelector('#panel .asking') !== null")
    frames, x = tab.js("[sitegrid.drawn.frames, sitegrid.view.x]")
    tab.page.locator("#map").focus()
    tab.page.keyboard.press("ArrowRight")
    tab.until(f"sitegrid.drawn.frames > {frames} && sitegrid.view.x > {x}")
    assert tab.js("document.querySelector('#panel .asking') !== null"), "it says that it works"
    tab.page.mouse.click(*tab.pixel_of(140, 10))
    tab.until(f"{QUIET} && sitegrid.route.answer !== null && sitegrid.route.places.length === 3")
    assert held
    with contextlib.suppress(Exception):  # the page already dropped the query
        held[0].continue_()
    tab.drawn()
    assert tab.js("sitegrid.route.answer.line.length") == 3
