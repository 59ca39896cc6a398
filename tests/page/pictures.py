"""`python -m tests.page.pictures URL FOLDER`: the pictures of the live page in docs/web.md.

URL: the page of a demo that has driven for five minutes and still drives (`sitegrid demo --web --seconds 1800`). Roads
are those of the tests' site after four days of haulers. Needs Chromium and Playwright.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from tests.integration.browser_tab import PHONE, Tab, launched
from tests.integration.forks import Forks
from tests.integration.hauling_site import hauling_site
from tests.integration.site_run import kill
from tests.integration.web_site import NAME

OUTLINE = [[4, 3], [166, 3], [166, 120], [148, 137], [4, 137], [4, 3]]  # around the haulers' roads [m]


def main() -> None:
    """Write all pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("url")
    parser.add_argument("out", type=Path)
    arguments = parser.parse_args()
    for browser in launched():
        of_machines(browser, arguments.url, arguments.out)
        with TemporaryDirectory() as folder:
            of_roads(browser, Path(folder), arguments.out)


def of_machines(browser: Any, url: str, out: Path) -> None:
    """Pictures of machines that drive."""
    tab = Tab(browser, url).loaded()
    shoot(tab, out, "light")
    tab.js("sitegrid.choices.toggleTheme()")
    shoot(tab, out, "dark")
    tab.js("sitegrid.choices.toggleTheme()")
    tab.js("sitegrid.times.compareWith(sitegrid.times.timeOf(Math.floor(sitegrid.times.steps / 3)), 'difference')")
    tab.until("sitegrid.times.otherMap !== null")
    shoot(tab, out, "difference")
    tab.js("sitegrid.times.goLive()")
    tab.page.mouse.click(*tab.pixel_of(*commonest_place(tab)))
    tab.page.locator("#panel .big b").wait_for()
    shoot(tab, out, "why")
    tab.close()
    tab = Tab(browser, f"{url}?panel=route&line=100,70;180,50&cost=energy").loaded()
    tab.page.locator("#profile").wait_for()
    shoot(tab, out, "route")
    tab.close()
    phone = Tab(browser, url, **PHONE).loaded()
    shoot(phone, out, "phone")
    phone.close()


def commonest_place(tab: Tab) -> list[float]:
    """A cell in the west, clear of the panel, that many passed."""
    return list(
        tab.js(
            """(() => {
              const { map } = sitegrid.site, cells = [], west = map.bounds()[0];
              for (const tile of map.tiles.values()) map.plane(tile, "visits").forEach((visits, i) =>
                cells.push([visits, 64 * tile.x + i % 64 + 0.5, 64 * tile.y + Math.floor(i / 64) + 0.5]));
              return cells.reduce((a, b) => (b[0] > a[0] && b[1] < west + 100 ? b : a)).slice(1);
            })()"""
        )
    )


def of_roads(browser: Any, folder: Path, out: Path) -> None:
    """Pictures of roads after four days, within the site's outline; and of a map server that is gone."""
    (folder / "site.geojson").write_text(json.dumps({"type": "Polygon", "coordinates": [OUTLINE]}))
    (folder / "web.toml").write_text(f'[{NAME}]\noutline = "site.geojson"\nunits = "metres"\n')
    with Forks(folder) as children:
        web = hauling_site(folder, children)
        web.start_web("--config", folder / "web.toml")
        tab = Tab(browser, f"{web.url}?panel=work").loaded()
        tab.page.locator("ol .stretch").first.hover()
        shoot(tab, out, "work")
        tab.close()
        tab = Tab(browser, web.url).loaded()
        kill(web.server)
        tab.until("document.getElementById('notice').textContent.includes('No map server answers')")
        shoot(tab, out, "away")
        tab.close()


def shoot(tab: Tab, out: Path, name: str) -> None:
    """Photograph the page once it stands still."""
    still = "!sitegrid.view.flight && document.querySelector('#panel .asking') === null"
    tab.until(f"{still} && document.getAnimations().every((one) => one.playState !== 'running')")
    tab.drawn()
    tab.page.screenshot(path=out / f"web-{name}.png")
    print(out / f"web-{name}.png", flush=True)


if __name__ == "__main__":
    main()
