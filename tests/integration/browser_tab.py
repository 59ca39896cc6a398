"""The live page in a driven browser, with its complaints. Needs Chromium (Debian: `chromium`)."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from typing import Any

import pytest

from tests.paths import ROOT
from tests.patience import PATIENCE_S

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
NO_BROWSER = "no Chromium: install it, for example with `apt-get install chromium`"
needs_browser = [pytest.mark.processes, pytest.mark.skipif(CHROMIUM is None, reason=NO_BROWSER)]
WAIT_MS = 1000 * PATIENCE_S
PHONE = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
NOBODY = "http://nobody.invalid/**"


def launched() -> Iterator[Any]:
    """A browser for one test."""
    from playwright.sync_api import Error, sync_playwright

    with sync_playwright() as playwright:
        try:  # containers have no user namespaces and little shared memory
            arguments = ["--no-sandbox", "--disable-dev-shm-usage"]
            browser = playwright.chromium.launch(executable_path=CHROMIUM, args=arguments)
        except Error as error:
            pytest.skip(f"Chromium does not start here: {str(error).splitlines()[0]}")
        yield browser
        browser.close()


class Tab:
    """A page and its browser's complaints."""

    def __init__(self, browser: Any, url: str, **options: Any) -> None:
        self.complaints: list[str] = []
        self.asked: list[str] = []
        self.context = browser.new_context(**({"viewport": {"width": 1280, "height": 800}} | options))
        self.page = self.context.new_page()
        self.page.on("console", lambda message: self._note(message.type, message.text))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", lambda request: self.asked.append(request.url))
        # Tests may answer in place of the server. Routes set up after loading miss some requests for a moment (4 times
        # in 150 on a busy host), so requests are intercepted from the start.
        self.page.route(NOBODY, lambda route: route.abort())
        self.page.goto(url)

    def _note(self, kind: str, text: str) -> None:
        if kind in ("error", "warning"):
            self.complaints.append(text)

    def js(self, expression: str) -> Any:
        return self.page.evaluate(expression)

    def until(self, expression: str) -> None:
        """Wait for an expression; the page's rules forbid the browser's own wait."""
        for _ in range(int(WAIT_MS / 50)):
            if self.js(expression):
                return
            self.page.wait_for_timeout(50)
        raise AssertionError(f"did not come true: {expression}; {self.complaints}")

    def drawn(self) -> None:
        """Wait for two animation frames, after earlier requests."""
        self.js("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")

    def loaded(self) -> Tab:
        ready = "sitegrid.site.state === 'live' && sitegrid.times.step_ns"
        self.until(f"window.sitegrid && !sitegrid.site.isEmpty && {ready}")
        return self

    def pixel_of(self, x_m: float, y_m: float) -> tuple[float, float]:
        left, top = self.js(f"sitegrid.view.toScreen({x_m}, {y_m})")
        return left, top

    def faults(self, axe: str) -> list[Any]:
        """axe's findings on a page loaded without its script rules."""
        self.until("document.getAnimations().every((one) => one.playState !== 'running')")
        self.page.evaluate(axe)
        script = "axe.run().then((r) => r.violations.map((v) => [v.id, v.impact, v.nodes.map((n) => n.html)]))"
        return list(self.page.evaluate(script))

    def close(self) -> None:
        self.context.close()


def watched(browser: Any, url: str) -> Iterator[Tab]:
    """A tab for one test, finally free of complaints and foreign requests."""
    tab = Tab(browser, url).loaded()
    yield tab
    assert tab.complaints == []
    assert all(asked.startswith((url, "data:")) for asked in tab.asked), "nobody else was asked"
    tab.close()


def axe_script() -> str:
    """axe-core, as pinned beside eslint; npm installs it, or skip."""
    folder, npm = ROOT / "tests" / "page", shutil.which("npm")
    script = folder / "node_modules" / "axe-core" / "axe.min.js"
    if not script.exists():
        if npm is None:
            pytest.skip("no npm: axe-core is installed by it")
        command = [npm, "ci", "--silent", "--no-audit", "--no-fund", "--prefix", str(folder)]
        if subprocess.run(command, capture_output=True, timeout=PATIENCE_S, check=False).returncode:
            pytest.skip("axe-core cannot be installed here")
    return script.read_text(encoding="utf-8")
