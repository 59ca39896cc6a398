"""How soon the live page shows the worklist, the profile of a route and a cheapest line, on the demo's own site.

The demo runs once, with its map server and web server as processes of their own, and stays; a page in Chromium then
opens each panel again and again, each time with another question, so that no copy is confirmed. A time begins with the
act, and ends once the panel is painted.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from lab.speed.measure import Report, machine
from lab.speed.web.pages import CHROMIUM, NO_BROWSER, PAINTED

END_S = 30.0
STAYS = re.compile(r"the map stays at (\S+)")
NAMES = ("worklist", "profile of a line", "cheapest line and its profile")
# From an act to the second picture after its panel has its answer.
SHOWN = """(act) => new Promise((done) => {
  const began = performance.now();
  eval(act);
  const look = () => {
    if (sitegrid.opening || !document.querySelector("#panel .stretch, #profile")) return void setTimeout(look, 1);
    requestAnimationFrame(() => requestAnimationFrame(() => done(performance.now() - began)));
  };
  look();
})"""
# Middles of the two stretches of road that are farthest apart.
FAR = """async () => {
  const { segments } = await (await fetch(sitegrid.path("segments"))).json();
  const places = segments.map(({ line }) => line[Math.floor(line.length / 2)]);
  let best = [0];
  for (const a of places) for (const b of places) {
    const apart = Math.hypot(a[0] - b[0], a[1] - b[1]);
    if (apart > best[0]) best = [apart, a, b];
  }
  return best;
}"""


def run(seconds: float, runs: int) -> Report:
    """Let the demo drive for so many seconds, then open each panel so often. Without a browser, all is missing."""
    report = {"benchmark": "panels", "seconds": seconds, "runs": runs, **machine()}
    if CHROMIUM is None or find_spec("playwright") is None:
        return {**report, "rows": [], "missing": dict.fromkeys(NAMES, NO_BROWSER)}
    with tempfile.TemporaryDirectory() as folder, _demo(Path(folder), seconds) as url:
        apart_m, took_ms = _opened(url, runs)
    rows = [
        {
            "panel": name,
            "first [ms]": round(took_ms[name][0], 1),
            "median [ms]": round(float(np.median(took_ms[name][1:])), 1),
            "slowest [ms]": round(max(took_ms[name][1:]), 1),
        }
        for name in NAMES
    ]
    return {**report, "apart_m": round(apart_m, 1), "rows": rows}


@contextmanager
def _demo(folder: Path, seconds: float) -> Iterator[str]:
    """The demo, once it has driven; gives the address of its page."""
    words = ("demo", "--stay", "--headless", "--seconds", f"{seconds:g}", "--out", str(folder / "demo"))
    command, root = [sys.executable, "-m", "sitegrid.cli", *words], Path(__file__).parents[2]
    with subprocess.Popen(command, cwd=root, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as child:  # noqa: S603
        try:
            assert child.stderr is not None
            shown = next(filter(None, map(STAYS.search, child.stderr)), None)
            if shown is None:
                raise RuntimeError("the demo ended: nothing was measured")
            yield shown[1]
        finally:
            child.terminate()
            try:
                child.communicate(timeout=END_S)
            except subprocess.TimeoutExpired:
                child.kill()


def _opened(url: str, runs: int) -> tuple[float, dict[str, list[float]]]:
    """How far the two ends of the routes are apart [m], and times to each panel [ms], the first one beside."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        # the page's own rules forbid `eval`
        page = browser.new_context(viewport={"width": 1280, "height": 800}, bypass_csp=True).new_page()
        page.goto(url)
        while not page.evaluate(PAINTED):
            page.wait_for_timeout(10)
        apart_m, *ends = page.evaluate(FAR)
        took_ms = {name: [_shown(page, name, ends, i) for i in range(runs + 1)] for name in NAMES}
        browser.close()
    return apart_m, took_ms


def _shown(page: Any, name: str, ends: list[list[float]], number: int) -> float:
    """Milliseconds from an act to its panel; the number makes it another one."""
    if page.evaluate("sitegrid.panel") is not None:
        page.keyboard.press("Escape")
    if name == NAMES[0]:
        act = f"(sitegrid.work.target = {0.02 + 1e-5 * number}, sitegrid.openPanel('work'))"
    else:
        (x_m, y_m), end = ends
        chosen = {"cheapest": name == NAMES[2], "places": [[round(x_m + 0.1 * number, 1), y_m], end]}
        act = f"(Object.assign(sitegrid.route, {json.dumps(chosen)}), sitegrid.openPanel('route'))"
    return float(page.evaluate(SHOWN, act))
