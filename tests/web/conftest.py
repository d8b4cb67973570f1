"""A real browser, and servers for its pages."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, Playwright, Route, expect, sync_playwright

from tests.service.patient import be_patient, patient_server
from tests.service.running import Running
from tests.waiting import PATIENCE_S
from tests.web.login import log_in
from tests.web.scripted import Scripted

CHROMIUM = next(
    (
        path
        for name in ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
        if (path := shutil.which(name))
    ),
    None,
)
# The last ones keep it from calling home, which no test should wait for.
CHROMIUM_OPTIONS = [
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    # This machine by an address that is no secure context, as a server in a network is.
    "--host-resolver-rules=MAP 192.0.2.1 127.0.0.1",
]

expect.set_options(timeout=1e3 * PATIENCE_S)


@pytest.fixture(scope="session")
def playwright() -> Iterator[Playwright]:
    """The one of this process: beside its event loop there can be no other."""
    if CHROMIUM is None:
        pytest.skip("no Chromium; on Debian: sudo apt-get install chromium")
    with sync_playwright() as playwright:
        yield playwright


@pytest.fixture(scope="session")
def browser(playwright: Playwright) -> Iterator[Browser]:
    browser = playwright.chromium.launch(executable_path=CHROMIUM, args=CHROMIUM_OPTIONS)
    yield browser
    browser.close()


@pytest.fixture
def open_page(browser: Browser) -> Iterator[Callable[..., Page]]:
    """Opens a page at a size, with a script and answers of the test's own.

    The test fails if a console complains, unless it may.
    """
    complaints: list[str] = []
    contexts = []

    def open_(
        url: str,
        width: int = 1366,
        height: int = 768,
        *,
        first: str = "",
        answers: dict[str, Callable[[Route], object]] | None = None,
        may_complain: bool = False,
        **options: Any,
    ) -> Page:
        context = browser.new_context(
            viewport={"width": width, "height": height}, accept_downloads=True, **options
        )
        contexts.append(context)
        log_in(context, url)
        page = context.new_page()
        page.set_default_timeout(1e3 * PATIENCE_S)
        if first:
            page.add_init_script(first)
        for part, answer in (answers or {}).items():
            page.route(part, answer)
        if not may_complain:
            page.on("pageerror", lambda error: complaints.append(str(error)))
            page.on(
                "console",
                lambda m: complaints.append(m.text) if m.type in ("error", "warning") else None,
            )
        page.goto(url)
        return page

    yield open_
    for context in contexts:
        # A context that is closed while a page of it begins to load may stay open without end.
        for page in context.pages:
            page.close()
        context.close()
    # A server that was killed on purpose, or refuses, shows up there: that is not the page's fault.
    others = ("ERR_", "WebSocket", "responded with a status of 4")
    ours = [c for c in complaints if not any(text in c for text in others)]
    assert ours == []


@pytest.fixture
def script(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Scripted]]:
    """Starts a server, of these options, and the node of a test."""
    be_patient(monkeypatch)
    started: list[Scripted] = []

    def start(**options: Any) -> Scripted:
        started.append(Scripted(tmp_path, **options))
        return started[-1]

    yield start
    for one in started:
        one.close()


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """A server of a module's own."""
    with patient_server(tmp_path_factory.mktemp("server") / "data") as running:
        yield running


@pytest.fixture
def scripted(script: Callable[..., Scripted]) -> Scripted:
    return script()
