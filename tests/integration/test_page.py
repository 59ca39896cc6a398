"""The live page in a browser on a running site. Needs Chromium (Debian: `chromium`)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from protocol.machine.samples import empty
from protocol.queries.lanes import LanesQuery, strokes
from protocol.queries.map_tiles import TilesQuery
from protocol.queries.requests import WhyQuery
from protocol.wire import keys
from protocol.wire.codec import encode_batch, encode_health, encode_pose
from protocol.wire.messages import Health, Pose, SampleBatch
from tests.integration.browser_tab import PHONE, WAIT_MS, Tab, axe_script, needs_browser, watched
from tests.integration.forks import Forks
from tests.integration.site_run import kill
from tests.integration.web_site import NAME, START_NS, WebSite
from tests.patience import PATIENCE_S, until
from tests.soak import BATCH_S

pytestmark = needs_browser


@pytest.fixture
def tab(browser, web: WebSite) -> Iterator[Tab]:
    yield from watched(browser, web.url)


def known_place(web: WebSite) -> tuple[float, float]:
    """Centre of a well measured cell."""
    region = web.client.region((0, 0, 300, 300), ["resistance", "visits", "confidence"])
    sure = np.nan_to_num(region["visits"]) * np.nan_to_num(region["confidence"])
    row, column = np.unravel_index(int(sure.argmax()), sure.shape)
    return float(region.x_m[column]), float(region.y_m[row])


def test_the_value_under_the_pointer_is_the_querys(tab: Tab, web: WebSite):
    x_m, y_m = known_place(web)
    value = web.client.point(x_m, y_m, ["resistance", "grade", "visits"])
    for key, name in (("1", "resistance"), ("2", "grade"), ("3", "visits")):
        tab.page.keyboard.press(key)
        tab.page.mouse.move(5, 795)
        tab.page.mouse.move(*tab.pixel_of(x_m, y_m))
        tab.until("document.getElementById('readout').classList.contains('on')")
        tab.until(f"Math.abs(Number(document.getElementById('readout').dataset.value) - {value.values[name]}) < 1e-6")


def test_the_colours_on_the_map_are_those_of_its_cells(tab: Tab, web: WebSite):
    x_m, y_m = known_place(web)
    tab.js("(sitegrid.choices.setShow('unsure', false), sitegrid.choices.setShow('machines', false))")
    left, top = tab.pixel_of(x_m, y_m)
    tab.drawn()
    red, green, blue, _ = tab.js(
        f"[...document.getElementById('map').getContext('2d').getImageData({left:.0f}, {top:.0f}, 1, 1).data]"
    )
    resistance = web.client.point(x_m, y_m, ["resistance"]).values["resistance"]
    expected = tab.js(f"sitegrid.choices.layer.colour({resistance})")
    shown = (red << 16) | (green << 8) | blue
    assert all(abs((shown >> s & 255) - (expected >> s & 255)) <= 6 for s in (0, 8, 16))


def test_lanes_are_drawn_where_machines_drove(tab: Tab, web: WebSite):
    columns = strokes(web.client.ask(LanesQuery()))
    most = int(np.argmax(columns["metres"]))
    tab.js("(sitegrid.choices.setShow('machines', false), sitegrid.choices.setShow('unsure', false))")
    left, top = tab.pixel_of(columns["x_m"][most], columns["y_m"][most])

    def looks() -> bytes:
        frames = tab.js("sitegrid.drawn.frames")
        tab.until(f"sitegrid.drawn.frames > {frames + 1}")
        return tab.page.screenshot(clip={"x": left - 3, "y": top - 3, "width": 6, "height": 6})

    bare = looks()
    with tab.page.expect_response("**/lanes"):
        tab.page.keyboard.press("n")
    until(lambda: looks() != bare, "lanes on the picture")
    tab.page.keyboard.press("n")
    until(lambda: looks() == bare, "a picture without lanes")


def test_a_click_says_why(tab: Tab, web: WebSite):
    x_m, y_m = known_place(web)
    tab.page.mouse.click(*tab.pixel_of(x_m, y_m))
    panel = tab.page.locator("#panel")
    panel.locator(".big b").wait_for(timeout=WAIT_MS)
    why = web.client.ask(WhyQuery(x_m, y_m))
    assert panel.locator(".big b").inner_text() == f"{100 * why.values['resistance']:.1f} %"
    text = panel.inner_text()
    assert all(name in text for name in why.machines)
    assert f"{x_m - 0.5:.0f} to {x_m + 0.5:.0f} m E" in text
    assert "cell=" in tab.page.url or tab.until("location.search.includes('cell=')") is None
    tab.page.keyboard.press("Escape")
    assert panel.is_hidden()


def test_a_click_on_a_machine_says_how_it_does(tab: Tab, web: WebSite):
    status, fault = "samples wait for the map server (312 held)", "/dev/ttyACM0: no such port"
    values = {
        "status": status,
        "problems": [status, fault],
        "heard": ["gps-1"],
        "corrections": {"base": "base-1", "age_s": 2.0},
        "lanes": {"sentence": "on the fleet's lanes, 0.9 m"},
    }
    web.session.put(keys.health(NAME, "no-place-9"), encode_health(Health("no-place-9", web.now_ns, values)))
    x_m, y_m = known_place(web)
    web.session.put(keys.pose(NAME, "here-1"), encode_pose(Pose("here-1", web.now_ns, x_m, y_m, *[0.01] * 5)))
    web.session.put(keys.health(NAME, "here-1"), encode_health(Health("here-1", web.now_ns, {"status": "calibrating"})))
    tab.until("sitegrid.site.machines.has('here-1')")
    tab.page.mouse.click(*tab.pixel_of(x_m, y_m))
    panel = tab.page.locator("#panel .agent")
    panel.first.wait_for(timeout=WAIT_MS)
    assert panel.first.inner_text().startswith("here-1")
    text = panel.filter(has_text="no-place-9").inner_text()
    assert all(
        words in text for words in (status[1:], fault, "not known yet", "base-1, 2.0 s old", "gps-1", "fleet's lanes")
    )
    tab.page.keyboard.press("a")
    assert tab.page.locator("#panel").is_hidden()


def test_ground_where_nobody_was_says_so(tab: Tab):
    tab.page.mouse.click(*tab.pixel_of(*tab.js("sitegrid.site.map.bounds().map((edge) => edge - 3.5).slice(0, 2)")))
    tab.page.locator("#panel .say").wait_for(timeout=WAIT_MS)
    assert "Nobody has driven" in tab.page.locator("#panel").inner_text()


def test_the_slider_shows_the_map_of_its_time(tab: Tab, web: WebSite):
    tab.page.locator("#slider").focus()
    for _ in range(3):
        tab.page.keyboard.press("ArrowLeft")
    tab.until("sitegrid.times.map !== null && sitegrid.times.at !== null")
    at_ns = int(tab.js("String(BigInt(sitegrid.times.at))"))
    tab.until(f"sitegrid.times.map.stamp_ns === {at_ns}")
    tiles = {(tile.x, tile.y) for tile in web.client.ask(TilesQuery(as_of_ns=at_ns)).tiles}
    assert {tuple(map(int, key.split(","))) for key in tab.js("[...sitegrid.times.map.tiles.keys()]")} == tiles
    assert START_NS < at_ns < web.now_ns
    assert "The map as of" in tab.page.locator("#status").inner_text()
    tab.page.keyboard.press("l")
    tab.until("sitegrid.times.at === null && sitegrid.times.map === null")


@pytest.mark.nightly
def test_two_times_stand_beside_each_other_and_are_subtracted(tab: Tab, web: WebSite):
    tab.page.keyboard.press("c")
    tab.until("sitegrid.times.mode === 'beside' && sitegrid.times.otherMap !== null")
    assert tab.page.locator("#sides").inner_text().endswith("now")
    tab.page.mouse.move(640, 300)  # the line is central
    tab.page.mouse.down()
    tab.page.mouse.move(900, 300, steps=4)
    tab.page.mouse.up()
    assert tab.js("sitegrid.times.split") == pytest.approx(900 / 1280, abs=0.01)
    assert tab.page.locator("#panel").is_hidden(), "who drags asks no why"
    tab.page.keyboard.press("c")
    tab.until("sitegrid.times.mode === 'difference' && sitegrid.shown.map().layer.id === 'difference'")
    legend = tab.page.locator("#legend").inner_text()
    assert all(word in legend for word in ("Difference", "a quarter", "four times", "to now", "at one of the times"))
    x_m, y_m = known_place(web)
    column, row = math.floor(x_m), math.floor(y_m)
    other_ns = int(tab.js("String(BigInt(sitegrid.times.other))"))
    then, now = (web.client.point(x_m, y_m, ["resistance"], as_of=ns).values["resistance"] for ns in (other_ns, None))
    shown = tab.js(f"sitegrid.shown.map().map.at({column}, {row}, 'difference')")
    assert shown == pytest.approx(math.log(now / then) / math.log(4), abs=0.03)
    tab.page.mouse.move(*tab.pixel_of(x_m, y_m))
    tab.until(f"document.getElementById('readout').textContent.startsWith('{100 * then:.1f} % → {100 * now:.1f} %')")
    tab.page.keyboard.press("c")
    tab.until("sitegrid.times.mode === 'one'")


@pytest.mark.nightly
def test_the_keyboard_alone_is_enough(tab: Tab):
    tab.page.keyboard.press("Tab")
    assert tab.js("document.activeElement.className") == "skip"
    tab.page.keyboard.press("Enter")
    tab.page.locator("#map").focus()
    x = tab.js("sitegrid.view.x")
    tab.page.keyboard.press("ArrowRight")
    assert tab.js("sitegrid.view.x") > x
    scale = tab.js("sitegrid.view.scale")
    tab.page.keyboard.press("+")
    assert tab.js("sitegrid.view.scale") > scale
    tab.page.keyboard.press("Enter")
    tab.page.locator("#panel h2").wait_for(timeout=WAIT_MS)
    tab.page.keyboard.press("Escape")
    tab.page.keyboard.press("?")
    assert tab.page.locator("#help").is_visible()
    tab.page.keyboard.press("Escape")
    seen = set()
    for _ in range(40):
        tab.page.keyboard.press("Tab")
        seen.add(
            tab.js("document.activeElement.id || document.activeElement.name || document.activeElement.textContent")
        )
    assert {"map", "fit", "link", "theme", "play", "slider", "compare", "live"} <= seen


@pytest.mark.nightly
def test_a_link_holds_view_layer_and_time(tab: Tab, browser):
    tab.page.keyboard.press("2")
    tab.page.mouse.wheel(0, -400)
    tab.page.keyboard.press("[")
    tab.until(
        "sitegrid.times.map !== null && location.search.includes('layer=grade') && location.search.includes('time=')"
    )
    other = Tab(browser, tab.page.url)
    other.until("window.sitegrid && sitegrid.times.map !== null")
    for value in ("sitegrid.choices.layer.id", "sitegrid.view.scale.toFixed(2)", "String(sitegrid.times.at)"):
        assert other.js(value) == tab.js(value)
    other.close()


@pytest.mark.nightly
def test_a_phone_shows_map_legend_and_panel(browser, web: WebSite):
    tab = Tab(browser, web.url, **PHONE).loaded()
    for name in ("#map", "#legend", "#time", "#slider"):
        assert tab.page.locator(name).is_visible(), name
    assert tab.page.get_by_role("radio", name="Slope").is_hidden()
    tab.page.locator("#drawer").tap()
    tab.page.get_by_text("Slope", exact=True).tap()
    tab.until("sitegrid.choices.layer.id === 'grade'")
    tab.page.locator("#drawer").tap()
    x_m, y_m = known_place(web)
    tab.page.touchscreen.tap(*tab.pixel_of(x_m, y_m))
    tab.page.locator("#panel .big b, #panel .say").first.wait_for(timeout=WAIT_MS)
    small = tab.js(
        "[...document.querySelectorAll('button')].filter((b) => b.offsetParent && b.offsetHeight < 44).map((b) => b.id)"
    )
    assert small == []
    assert tab.js("document.documentElement.scrollWidth") <= 390
    assert tab.complaints == []
    tab.close()


@pytest.mark.nightly
def test_a_server_that_is_gone_is_named_and_comes_back(browser, web: WebSite):
    tab = Tab(browser, web.url).loaded()
    kill(web.server)
    tab.until("document.getElementById('notice').textContent.includes('No map server answers')")
    assert tab.js("sitegrid.site.map.tiles.size") > 0, "what it said last stays"
    tab.page.keyboard.press("[")
    tab.until("document.getElementById('notice').textContent.includes('map of that time could not be read')")
    assert tab.js("[sitegrid.times.at, sitegrid.times.map, sitegrid.times.playing]") == [None, None, 0]
    web.server = web.start_server()
    tab.until("sitegrid.site.state === 'live' && document.getElementById('notice').hidden")
    tab.close()


def seen(tab: Tab, *places: tuple[float, float]) -> bool:
    """Whether places are on the screen, right of the rail."""
    return all(260 < x < 1280 and 0 < y < 720 for x, y in (tab.pixel_of(*place) for place in places))


@pytest.mark.nightly
def test_an_empty_map_says_what_to_do_and_what_comes_is_in_sight_until_the_view_is_moved(browser, tmp_path: Path):
    with Forks(tmp_path) as children:
        web = WebSite(tmp_path, children)
        kill(web.server)
        tab = Tab(browser, web.url)
        tab.until("document.getElementById('notice').textContent.includes('No map server answers')")
        assert "what it said last" not in tab.page.locator("#notice").inner_text(), "it said nothing yet"
        web.server = web.start_server()
        tab.until("document.getElementById('notice').textContent.includes('No ground known yet')")
        assert "sitegrid agent" in tab.page.locator("#notice code").inner_text()

        def machine_at(*place: float) -> None:
            pose = Pose("machine-9", START_NS, *place, 0.0, 2.0, 1.0, 0.0, 1.0)
            web.session.put(keys.pose(NAME, pose.machine), encode_pose(pose))
            tab.until(f"sitegrid.site.machines.get('machine-9')?.x_m === {place[0]}")

        machine_at(400.0, 300.0)
        tab.until("document.getElementById('notice').textContent.includes('Machines are driving')")
        assert "small" in tab.js("document.getElementById('notice').className")
        assert seen(tab, (400, 300))
        web.drive(8)
        tab.until("document.getElementById('notice').hidden && !sitegrid.site.isEmpty && !sitegrid.view.flight")
        west, south, east, north = tab.js("sitegrid.site.map.bounds()")
        assert seen(tab, (400, 300), (west, south), (east, north)), "ground and machines"
        machine_at(-700.0, 900.0)
        tab.until("!sitegrid.view.flight")
        assert seen(tab, (-700, 900), (west, south), (east, north)), "again, with what is new"
        tab.page.mouse.move(640, 300)
        tab.page.mouse.wheel(0, -400)
        tab.until("sitegrid.view.moved")
        moved = tab.js("[sitegrid.view.x, sitegrid.view.y, sitegrid.view.scale]")
        machine_at(3000.0, 900.0)
        tab.drawn()
        assert tab.js("[sitegrid.view.x, sitegrid.view.y, sitegrid.view.scale]") == moved
        tab.close()


def test_without_a_token_nobody_sees_the_map(browser, tmp_path: Path):
    keys = tmp_path / "keys"
    with Forks(tmp_path) as children:
        children.start("init", "keys", "init", "--site", "soak", "--dir", keys).wait(PATIENCE_S)
        token = children.start("token", "keys", "token", "anna", "--dir", keys, "--json").expect("token", PATIENCE_S)[
            "token"
        ]
        web = WebSite(tmp_path, children, "--tokens", keys)
        web.drive(4)
        assert web.get("info").status == 401
        assert web.get("/healthz").status == 200
        assert web.get("info", Authorization=f"Bearer {token}").status == 200
        assert web.get("info", {"token": token}).status == 200
        for name, parameters in (
            ("worklist", {}),
            ("segments", {}),
            ("route", {"line": "80,80;120,120", "unknown": 0.05}),
        ):
            assert web.get(name, parameters).status == 401
            assert web.get(name, {**parameters, "token": token}).status == 200
        tab = Tab(browser, f"{web.url}?token={token}").loaded()
        assert "token" not in tab.page.url, "it stays in no history"
        tab.page.reload()
        tab.loaded()
        tiles = web.get("xyz/resistance.json", {"token": token}).json["tiles"]
        assert tiles[0].endswith(f"/{{z}}/{{x}}/{{y}}.png?token={token}"), (
            "whoever has a token in addresses needs it there"
        )
        children.start("revoke", "keys", "token", "anna", "--revoke", "--dir", keys).wait(PATIENCE_S)
        until(lambda: web.get("info", {"token": token}).status == 401, "the token is revoked")
        tab.until("sitegrid.site.state === 'refused'")
        assert "Ask the office" in tab.page.locator("#notice").inner_text()
        tab.close()


@pytest.mark.nightly
def test_axe_finds_no_fault_on_desk_and_phone_light_and_dark(browser, web: WebSite):
    axe = axe_script()
    for theme, options in itertools.product(("light", "dark"), ({}, PHONE)):
        tab = Tab(browser, f"{web.url}?theme={theme}", bypass_csp=True, **options).loaded()
        assert tab.faults(axe) == []
        for key in ("w", "r", "a", "?"):
            tab.page.keyboard.press(key)
            tab.until("document.querySelector('#panel .asking') === null")
            assert tab.faults(axe) == [], key
        tab.page.keyboard.press("Escape")
        tab.page.keyboard.press("Escape")
        tab.js("sitegrid.times.nextMode(), sitegrid.choices.setPalette('kinds')")
        tab.page.mouse.click(*tab.pixel_of(*known_place(web)))
        tab.page.locator("#panel .big b").wait_for(timeout=WAIT_MS)
        assert tab.faults(axe) == []
        assert tab.complaints == []
        tab.close()


class Sweeper:
    """A machine sweeping an area hourly, half of it paved in between.

    blind_hours: without resistance until then.
    """

    name = "sweeper"

    def __init__(self, blind_hours: float = 0) -> None:
        self._seq, self._blind_hours = 0, blind_hours

    def drive(self, from_s: float, frame: str) -> bytes:
        """The batch of an hour, 900 times slower than the others' seconds."""
        hour = from_s / BATCH_S
        x, y = np.meshgrid(np.arange(20.5, 80), np.arange(20.5, 50))
        rows = empty(x.size)
        rows["x_m"], rows["y_m"] = x.ravel(), y.ravel()
        rows["stamp_ns"] = START_NS + round(hour * 3600e9) + np.arange(len(rows)) * 400_000_000
        rows["cov_xx_m2"] = rows["cov_yy_m2"] = 0.04
        rows["speed_mps"], rows["distance_m"] = 2.5, 1.0
        rows["c_rr"] = np.where((rows["x_m"] > 50) & (hour >= 3), 0.009, 0.04)
        rows["c_rr_var"], rows["grade_var"] = 1e-6, 1e-4
        if hour < self._blind_hours:
            rows["c_rr"] = rows["c_rr_var"] = np.nan
        batch = SampleBatch(self.name, 7, self._seq + 1, rows, frame)
        self._seq += len(rows)
        return encode_batch(batch)


@pytest.mark.nightly
def test_the_page_opens_with_the_layer_that_the_map_knows(browser, tmp_path: Path):
    with Forks(tmp_path) as children:
        web = WebSite(tmp_path, children)
        web.machines = [Sweeper(blind_hours=2)]
        web.drive(2 * BATCH_S)
        tab, asked = Tab(browser, web.url).loaded(), Tab(browser, f"{web.url}?layer=resistance").loaded()
        slope = tab.page.get_by_role("radio", name="Slope")
        tab.until("sitegrid.choices.layer.id === 'grade'")
        assert slope.is_checked()
        assert "level" in tab.page.locator("#legend").inner_text()
        assert asked.js("sitegrid.choices.layer.id") == "resistance", "a link is a choice"
        chosen = Tab(browser, web.url).loaded()
        chosen.page.keyboard.press("3")
        web.drive(BATCH_S)
        tab.until("sitegrid.choices.layer.id === 'resistance'")
        assert not slope.is_checked()
        chosen.until("sitegrid.site.map.knows('resistance')")
        assert chosen.js("sitegrid.choices.layer.id") == "visits"
        for one in (tab, asked, chosen):
            assert one.complaints == []
            one.close()


@pytest.mark.nightly
def test_changed_ground_is_outlined_and_says_what_it_was(browser, tmp_path: Path):
    with Forks(tmp_path) as children:
        web = WebSite(tmp_path, children)
        web.machines = [Sweeper()]
        web.drive(5 * BATCH_S)
        tab = Tab(browser, web.url).loaded()
        tab.until("sitegrid.site.changes.length === 1")
        west, south, east, north = tab.js("sitegrid.site.changes[0].bounds")
        assert (round(west / 5), round(east / 5)) == (10, 16), "the half that was paved"
        tab.page.mouse.click(*tab.pixel_of((west + east) / 2, (south + north) / 2))
        tab.page.locator("#panel .change").wait_for(timeout=WAIT_MS)
        text = tab.page.locator("#panel .change").inner_text()
        assert "Was 4.0 % (dry dirt)" in text
        tab.page.get_by_role("button", name="Compare with before").click()
        tab.until("sitegrid.times.mode === 'beside' && sitegrid.times.otherMap !== null")
        shown = tab.js(f"sitegrid.times.otherMap.at({(west + east) // 2}, {(south + north) // 2}, 'resistance')")
        assert shown == pytest.approx(0.04, rel=0.1), "the map of before the change"
        tab.js(f"sitegrid.times.go({START_NS + 2 * 3600 * 10**9})")
        tab.until("document.querySelector('#panel .big b').textContent === '4.0 %'")  # the panel is of the shown time
        assert tab.complaints == []
        tab.close()
