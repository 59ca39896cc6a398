"""`python -m tests.page.pictures FOLDER`: the pictures of the live page in docs/web.md.

It runs `sitegrid demo` for machines that drive, and the tests' site of four days of haulers for roads. Needs Chromium,
Playwright, and ten minutes.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from tests.integration.browser_tab import PHONE, Tab, launched
from tests.integration.forks import Forks
from tests.integration.hauling_site import hauling_site
from tests.integration.site_run import kill
from tests.integration.web_site import NAME
from tests.patience import until

DRIVEN_NS = 330e9  # the demo is photographed so late, while its machines still drive
OUTLINE = [[-10, -8], [172, -8], [172, 142], [-2, 142], [-10, 100], [-10, -8]]  # around the haulers' roads [m]


def main() -> None:
    """Write all pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    out = parser.parse_args().out
    for browser in launched():
        with TemporaryDirectory() as folder, demo(Path(folder)) as url:
            of_machines(browser, url, out)
        with TemporaryDirectory() as folder:
            of_roads(browser, Path(folder), out)


@contextlib.contextmanager
def demo(folder: Path) -> Iterator[str]:
    """The address of a demo's page; the demo ends with the block."""
    words = ("demo", "--web", "--headless", "--seconds", "1800", "--out", str(folder))
    with subprocess.Popen([sys.executable, "-m", "sitegrid.cli", *words], stderr=subprocess.PIPE, text=True) as child:
        assert child.stderr
        yield next(line.split()[-1] for line in child.stderr if line.startswith("the map is at"))
        child.terminate()
        child.stderr.read()  # else it waits for a reader


def of_machines(browser: Any, url: str, out: Path) -> None:
    """Pictures of machines that drive."""
    tab = Tab(browser, url).loaded()
    until(lambda: tab.js("sitegrid.site.stamp_ns - sitegrid.site.first_ns") > DRIVEN_NS, "a map")
    tab.js("sitegrid.times.span()")
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
    """A cell that many passed."""
    return list(
        tab.js(
            """(() => {
              const { map } = sitegrid.site, cells = [];
              for (const tile of map.tiles.values()) map.plane(tile, "visits").forEach((visits, i) =>
                cells.push([visits, 64 * tile.x + i % 64 + 0.5, 64 * tile.y + Math.floor(i / 64) + 0.5]));
              return cells.reduce((a, b) => (b[0] > a[0] ? b : a)).slice(1);
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
