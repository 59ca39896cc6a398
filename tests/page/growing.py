"""`python -m tests.page.growing URL FILE.webp`: an animation of the live page while its map grows.

It opens the page of a site that has stopped (`sitegrid demo --web`), drags the time from the first sample to the
newest, and photographs each step once the tiles of that time are drawn. Needs Chromium, Playwright and Pillow.
"""

from __future__ import annotations

import argparse
import io
from pathlib import Path

from PIL import Image

from tests.integration.browser_tab import Tab, launched

SIZE = {"width": 900, "height": 560}
STEP_MS, END_MS = 300, 3000  # how long a picture stays; the last one


def main() -> None:
    """Write the animation."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("url")
    parser.add_argument("out", type=Path)
    arguments = parser.parse_args()
    for browser in launched():
        tab = Tab(browser, arguments.url, viewport=SIZE).loaded()
        first, *others = [at_step(tab, step) for step in range(tab.js("sitegrid.times.steps") + 1)]
    durations = [*[STEP_MS] * len(others), END_MS]
    first.save(arguments.out, save_all=True, append_images=others, duration=durations, loop=0, quality=70, method=6)
    print(f"{arguments.out}: {len(durations)} pictures, {arguments.out.stat().st_size / 1e6:.2f} MB")


def at_step(tab: Tab, step: int) -> Image.Image:
    """The page with the map as of a step of its time bar, the last of which is now."""
    tab.js(f"sitegrid.times.go(sitegrid.times.timeOf({step}))")
    tab.drawn()
    return Image.open(io.BytesIO(tab.page.screenshot())).convert("RGB")


if __name__ == "__main__":
    main()
