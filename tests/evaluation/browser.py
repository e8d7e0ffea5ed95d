"""A headless Chromium that opens a file as people would, and what it notices meanwhile."""

import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from playwright.sync_api import Browser, Page, sync_playwright

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
HEIGHT = 900
PATIENCE = 600.0  # for anything, on a machine that does much else [s]


@dataclass
class Opened:
    """A page that is open. console: its lines; requests: all addresses but its own and `data:`."""

    page: Page
    console: list[str] = field(default_factory=list[str])
    requests: list[str] = field(default_factory=list[str])

    def evaluate(self, script: str, argument: object = None) -> Any:
        """The value of an expression, or of a function of `argument`, in the page."""
        return self.page.evaluate(script, argument)

    def wait_until(self, script: str, argument: object = None, seconds: float = PATIENCE) -> None:
        """Wait until that is true.

        Playwright's `wait_for_function` evaluates in the page, which a page may forbid.
        """
        end = time.monotonic() + seconds
        while not self.evaluate(script, argument):
            assert time.monotonic() < end, f"not within {seconds:g} s: {script}"
            self.page.wait_for_timeout(50)


@contextmanager
def chromium() -> Iterator[Browser]:
    """One Chromium of the machine; `AssertionError` says what to install where there is none."""
    found = next(filter(None, map(shutil.which, NAMES)), None)
    assert found, f"no Chromium ({', '.join(NAMES)}) on the PATH; as root: .ci/system browser"
    with sync_playwright() as playwright:
        # Its sandbox cannot be had as root, nor in most containers; the pages are our own.
        browser = playwright.chromium.launch(
            executable_path=found, args=["--no-sandbox"], timeout=1000 * PATIENCE
        )
        yield browser
        browser.close()


@contextmanager
def opened(
    browser: Browser, path: Path, width: int, scheme: Literal["light", "dark"] = "light"
) -> Iterator[Opened]:
    """`path` in a window of this width [px], without a network."""
    context = browser.new_context(
        viewport={"width": width, "height": HEIGHT}, color_scheme=scheme, offline=True
    )
    context.set_default_timeout(1000 * PATIENCE)
    page = context.new_page()
    window, own = Opened(page), path.resolve().as_uri()
    page.on("console", lambda message: window.console.append(f"{message.type}: {message.text}"))
    page.on("pageerror", lambda error: window.console.append(str(error)))
    page.on("request", lambda request: _note(window.requests, request.url, own))
    page.goto(own)
    try:
        yield window
    finally:
        context.close()


def _note(requests: list[str], url: str, own: str) -> None:
    if url != own and not url.startswith("data:"):
        requests.append(url)
